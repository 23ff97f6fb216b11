"""Parts of notebooks: frames, small HTML and figures, each with one line where its library is missing."""

import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable

import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.notebook import html
from reactorwatch.notebook.figures import INPUT, Line, Mark, Panel, draw_panels, figure_html, figure_png
from reactorwatch.notebook.frames import frame_of_rows, make_frame

X = np.arange(5.0)
PANELS = (
    Panel("T, K", (Line("measured", X, X**2), Line("model", X, X))),
    Panel("qc", (Line("qc", X, X, INPUT, True),)),
)


@pytest.mark.parametrize(
    ("module", "call"),
    [("pandas", lambda: make_frame({"a": [1]})), ("matplotlib.figure", lambda: draw_panels(PANELS))],
)
def test_a_missing_library_is_named_with_its_extra(
    module: str, call: Callable[[], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    from reactorwatch.notebook import figures

    figures._figure_class.cache_clear()
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=r"which is not installed: pip install 'reactorwatch\[notebook\]'"):
        call()


def test_a_figure_has_a_panel_each_on_one_time_axis_and_marks_in_all_of_them() -> None:
    pytest.importorskip("matplotlib")
    figure = draw_panels(PANELS, [Mark(2.0, "alarm"), Mark(0.0, "training", end=1.0)])
    first, second = figure.axes
    assert [axis.get_ylabel() for axis in figure.axes] == ["T, K", "qc"]
    assert first.get_xlim() == second.get_xlim()
    assert second.get_xlabel() == "min"
    dashed = [line for axis in figure.axes for line in axis.lines if line.get_linestyle() == "--"]
    assert [float(np.asarray(line.get_xdata())[0]) for line in dashed] == [2.0, 2.0]
    legend = first.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["measured", "model", "alarm", "training"]


def test_a_figure_shows_itself_in_a_notebook_and_on_a_page() -> None:
    pytest.importorskip("matplotlib")
    figure = draw_panels(PANELS)
    assert figure._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]
    assert figure_png(figure) == figure_png(draw_panels(PANELS))
    assert figure_html(figure, "T over time").startswith("<img alt='T over time' src='data:image/png;base64,")


def test_text_from_elsewhere_is_no_markup_and_long_tables_are_counted() -> None:
    rows = [("<script>", number) for number in range(html.MOST_ROWS + 3)]
    shown = html.table(["a", "b"], rows) + html.headline("a < b") + html.sentence("c & d")
    ET.fromstring(f"<div>{shown}</div>")  # well-formed
    assert "<script>" not in shown
    assert shown.count("<tr>") == html.MOST_ROWS + 1
    assert "and 3 more" in shown
    assert html.table(["a"], []) == ""


def test_a_page_stands_alone() -> None:
    page = html.page("x < y", html.headline("yes"))
    assert page.startswith("<!doctype html>")
    assert "<title>x &lt; y</title>" in page
    assert "http" not in page


def test_a_frame_has_the_columns_even_without_rows() -> None:
    pytest.importorskip("pandas")
    assert list(frame_of_rows([], ("alarm", "raised_min")).columns) == ["alarm", "raised_min"]
    frame = make_frame({"time_min": X, "T": X**2}, "time_min")
    assert frame.index.name == "time_min"
    assert frame["T"].tolist() == (X**2).tolist()
