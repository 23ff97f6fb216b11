"""A result as a page that stands alone."""

from collections.abc import Sequence
from html import escape
from pathlib import Path

from reactorwatch import html
from reactorwatch.api.report_origin import report_origin
from reactorwatch.figures import Panel
from reactorwatch.records.write import atomic_write


def write_page(file: str | Path, title: str, body: str, panels: Sequence[Panel], source: str) -> None:
    """Write a page with the figures of a result, the result and its origin.

    Args:
        file: the page.
        title: title of the page.
        body: the result as HTML.
        panels: figures.
        source: name of the record.

    Raises:
        InputError: the file cannot be written.
    """
    origin = html.fold("This report", html.table(("", ""), report_origin(Path(source), {}).items()))
    heading = f"<h1>{escape(title)}</h1>"
    figures = map(html.figure, panels)
    text = html.page(title, heading, *figures, f'<div class="wide">{body}</div>', origin)
    with atomic_write(Path(file)) as temporary:
        temporary.write_text(text, encoding="utf-8")
