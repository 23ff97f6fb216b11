"""A result as a page that stands alone."""

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from reactorwatch.api.report_origin import report_origin
from reactorwatch.notebook import html
from reactorwatch.notebook.figures import figure_html
from reactorwatch.records.write import atomic_write

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_page(file: str | Path, title: str, body: str, plot: "Callable[[], Figure]", source: str) -> None:
    """Write a page with a result, its figure and its origin.

    Args:
        file: the page.
        title: title of the page.
        body: the result as HTML.
        plot: function that draws the figure; it is left out, with a note, where matplotlib is not installed.
        source: name of the record.

    Raises:
        InputError: the file cannot be written.
    """
    if find_spec("matplotlib") is None:
        figure = html.sentence("No figure: matplotlib is not installed.")
    else:
        figure = figure_html(plot(), f"Time plots: {title}")
    origin = html.table(("", ""), report_origin(Path(source), {}).items())
    text = html.page(title, body, figure, origin)
    with atomic_write(Path(file)) as temporary:
        temporary.write_text(text, encoding="utf-8")
