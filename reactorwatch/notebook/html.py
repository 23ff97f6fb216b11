"""Results as small HTML: a sentence and tables, in the colours of the page around them."""

from collections.abc import Iterable, Sequence
from html import escape

MOST_ROWS = 30
"""Rows of a table that are shown; the others are counted."""

_CELL = "style='text-align:left;padding:.2em .8em .2em 0'"


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


def page(title: str, *parts: str) -> str:
    """A page that stands alone, light or dark as its reader prefers, for the screen and for A4."""
    return "\n".join(
        [
            "<!doctype html>",
            "<html lang='en'><head><meta charset='utf-8'>",
            "<meta name='viewport' content='width=device-width, initial-scale=1'>",
            f"<title>{escape(title)}</title>",
            "<style>:root{color-scheme:light dark}"
            "body{font:16px/1.5 system-ui,sans-serif;max-width:60em;margin:2em auto;padding:0 1em}"
            "img{max-width:100%}td,th{vertical-align:top}@page{size:A4;margin:15mm}</style>",
            "</head><body>",
            f"<h1>{escape(title)}</h1>",
            *parts,
            "</body></html>\n",
        ]
    )
