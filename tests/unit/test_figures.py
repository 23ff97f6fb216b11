"""Figures and pages: panels as SVG and with matplotlib, small HTML, and frames; a missing library is one line."""

import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable

import numpy as np
import pytest

from reactorwatch import figures, html
from reactorwatch.errors import InputError
from reactorwatch.figures import COLOURS, Band, Line, Mark, Panel, decimate, draw, panel_svg
from reactorwatch.optional import frame_of_rows, make_frame

X = np.arange(5.0)
MARKS = (Mark(2.0, "alarm", "alarm"), Mark(0.0, "training", "measured", end=1.0))
PANELS = (
    Panel("T, K", (Line("measured", X, X**2), Line("model", X, X, "before"), Band("noise", X, X - 1, X + 1)), MARKS),
    Panel("qc", (Line("qc", X, X, "input", True),), MARKS),
)


@pytest.mark.parametrize(
    ("module", "call"), [("pandas", lambda: make_frame({"a": [1]})), ("matplotlib", lambda: draw(PANELS))]
)
def test_a_missing_library_is_named_with_its_extra(
    module: str, call: Callable[[], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=r"which is not installed: pip install 'reactorwatch\[notebook\]'"):
        call()


def test_a_page_has_its_figures_where_matplotlib_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    page = html.page("x < y", *map(html.figure, PANELS))
    assert page.count("<figure>") == 2
    assert page.startswith("<!doctype html>")
    assert "<title>x &lt; y</title>" in page
    assert "http" not in page


def test_a_drawing_has_a_panel_each_on_one_time_axis_and_marks_in_all_of_them() -> None:
    pytest.importorskip("matplotlib")
    figure = draw(PANELS)
    first, second = figure.axes
    assert [axes.get_ylabel() for axes in figure.axes] == ["T, K", "qc"]
    assert first.get_xlim() == second.get_xlim()
    assert second.get_xlabel() == "min"
    dashed = [line for axes in figure.axes for line in axes.lines if line.get_linestyle() == "--"]
    assert [float(np.asarray(line.get_xdata())[0]) for line in dashed] == [2.0, 2.0]
    legend = first.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["measured", "model", "noise", "alarm", "training"]
    assert figure._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]
    assert figures.figure_png(figure) == figures.figure_png(draw(PANELS))


def test_a_panel_is_the_same_svg_each_time_with_its_lines_bands_and_marks() -> None:
    drawn = panel_svg(PANELS[0])
    assert drawn == panel_svg(PANELS[0])
    assert [(item.tag, item.get("class")) for item in ET.fromstring(drawn)[1]] == [
        ("rect", "band measured"),
        ("polygon", "band expected"),
        ("line", "moment alarm"),
        ("path", "line measured"),
        ("path", "line before"),
    ]
    assert panel_svg(Panel("T", PANELS[0].items, (Mark(9.0),))).count("<line") == 0, "a moment outside is left out"


def test_the_style_sheet_has_each_colour_for_light_and_dark_and_print_is_light() -> None:
    style = html.style()
    for kind, (light, dark) in COLOURS.items():
        assert style.count(f"--{kind}: {light};") >= 1
        assert style.count(f"--{kind}: {dark};") >= 1
        assert f".{kind} {{ --colour: var(--{kind}); }}" in style
    assert "@media screen and (prefers-color-scheme: dark)" in style
    assert style.count("prefers-color-scheme") == 1


def test_text_from_elsewhere_is_no_markup_and_long_tables_are_counted() -> None:
    rows = [("<script>", number) for number in range(html.MOST_ROWS + 3)]
    figure = html.figure(Panel("<script>", (Line("<script>", X, X),), text="<script>"))
    shown = html.table(["a", "b"], rows) + html.headline("a < b") + html.sentence("c & d") + html.fold("<b>", figure)
    ET.fromstring(f"<div>{shown}</div>")  # well-formed
    assert "<script>" not in shown
    assert shown.count("<tr>") == html.MOST_ROWS + 1
    assert "and 3 more" in shown
    assert html.table(["a"], []) == ""


def test_a_frame_has_the_columns_even_without_rows() -> None:
    pytest.importorskip("pandas")
    assert list(frame_of_rows([], ("alarm", "raised_min")).columns) == ["alarm", "raised_min"]
    frame = make_frame({"time_min": X, "T": X**2}, "time_min")
    assert frame.index.name == "time_min"
    assert frame["T"].tolist() == (X**2).tolist()


def test_no_peak_is_lost_where_rows_outnumber_columns() -> None:
    random = np.random.default_rng(3)
    time_min = np.cumsum(random.uniform(0.05, 0.2, 20_000))
    values = random.standard_normal(time_min.size)
    values[random.integers(0, time_min.size, 500)] = np.nan
    times, kept = decimate(time_min, values, 50)
    column = np.floor((time_min - time_min[0]) / (time_min[-1] - time_min[0]) * 50)
    column_kept = np.floor((times - time_min[0]) / (time_min[-1] - time_min[0]) * 50)
    for number in np.unique(column):
        there = values[column == number]
        drawn = kept[column_kept == number]
        assert np.nanmax(drawn) == np.nanmax(there)
        assert np.nanmin(drawn) == np.nanmin(there)
        assert drawn.size <= 2
    assert np.all(np.diff(times) > 0)
    assert np.all(np.isin(kept[np.isfinite(kept)], values))


def test_a_column_without_values_is_a_gap() -> None:
    time_min = np.arange(10_000.0)
    values = np.ones(time_min.size)
    values[4000:6000] = np.nan
    times, kept = decimate(time_min, values, 100)
    assert np.all(np.isnan(kept[(times > 4100) & (times < 5900)]))
    assert np.all(np.isfinite(kept[(times < 3900) | (times > 6100)]))
