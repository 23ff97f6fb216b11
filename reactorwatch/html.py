"""Results as HTML: for a notebook, in the colours of the page around it, and as pages that stand alone.

All pages have one style sheet, `page.css`: light or dark as their reader prefers, and in colour on A4.
"""

from collections.abc import Iterable, Sequence
from functools import cache
from html import escape
from importlib.resources import files

from reactorwatch.figures import COLOURS, Panel, panel_svg

MOST_ROWS = 30
"""Rows of a table that are shown; the others are counted."""

_CELL = "style='text-align:left;padding:.2em .8em .2em 0'"
_GROUND = {
    "ground": ("#fff", "#14171a"),
    "text": ("#1c1f23", "#e6e9ec"),
    "faint": ("#5f6873", "#a0aab4"),
    "line": ("#d8dde3", "#3a4149"),
    "card": ("#f5f7f9", "#1e2328"),
    "mark": ("#ffe9a8", "#5c4a00"),
    "good": ("#00694e", "#4fd1a5"),
    "bad": ("#b34700", "#ff9a5c"),
}
"""Colours of a page on a light and on a dark ground, beside those of its figures."""


def headline(text: str) -> str:
    """A sentence in bold."""
    return f"<p style='margin:.3em 0'><b>{escape(text)}</b></p>"


def sentence(text: str) -> str:
    """A sentence."""
    return f"<p style='margin:.3em 0'>{escape(text)}</p>"


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table; empty without rows."""
    lines = list(rows)
    if not lines:
        return ""
    parts = ["<table style='border-collapse:collapse;font-size:90%'><thead><tr>"]
    parts += [f"<th {_CELL}>{escape(name)}</th>" for name in header]
    parts.append("</tr></thead><tbody>")
    for line in lines[:MOST_ROWS]:
        parts.append("<tr>" + "".join(f"<td {_CELL}>{escape(str(cell))}</td>" for cell in line) + "</tr>")
    parts.append("</tbody></table>")
    if len(lines) > MOST_ROWS:
        parts.append(sentence(f"and {len(lines) - MOST_ROWS} more"))
    return "".join(parts)


def figure(panel: Panel) -> str:
    """A figure of a page: title, legend and drawing."""
    legend = "".join(
        f' <span class="legend"><span class="key {kind}"></span>{escape(label)}</span>' for label, kind in panel.legend
    )
    return f"<figure><figcaption>{escape(panel.title)}{legend}</figcaption>{panel_svg(panel)}</figure>"


def fold(title: str, body: str) -> str:
    """A section that is closed on the screen and open in print."""
    return f"<details><summary><h2>{escape(title)}</h2></summary>{body}</details>"


@cache
def style() -> str:
    """The style sheet of all pages."""
    light, dark = (
        "".join(f"--{name}: {colours[i]}; " for name, colours in {**_GROUND, **COLOURS}.items()) for i in (0, 1)
    )
    kinds = " ".join(f".{kind} {{ --colour: var(--{kind}); }}" for kind in COLOURS)
    return "\n".join(
        [
            f":root {{ color-scheme: light; {light}}}",
            f"@media screen and (prefers-color-scheme: dark) {{ :root {{ color-scheme: dark; {dark}}} }}",
            kinds,
            files("reactorwatch").joinpath("page.css").read_text(encoding="utf-8"),
        ]
    )


def page(title: str, *parts: str) -> str:
    """A page that stands alone, for the screen and for A4."""
    return "\n".join(
        [
            "<!doctype html>",
            '<html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title>",
            f"<style>\n{style()}</style>",
            "</head><body>",
            *parts,
            "</body></html>\n",
        ]
    )
