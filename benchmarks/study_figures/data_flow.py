"""Figures 21 to 27: the report's block diagrams, as one drawing of the data flow of its scheme and of the monitor."""

from __future__ import annotations

from typing import TYPE_CHECKING

from benchmarks.study_figures.canvas import BLACK, GREY, ORANGE, SKY, panels
from benchmarks.study_figures.figure import Finding
from benchmarks.study_figures.study import Study

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

_REPORT = (
    "qc and C\nof the plant",
    "scaling",
    "lags of\nevery 6th row",
    "pseudo-inverse",
    "model, run on\nits own output",
    "mean +- 3 sigma\nof the residual",
)
_MONITOR = (
    "samples\non the bus",
    "aligned rows,\nsignal checks",
    "filter of the\nequations, or ARX",
    "charts of the\ninnovations",
    "alarms with\non-delay",
    "likely cause",
)


def draw(_study: Study, drawing: Drawing) -> Finding:
    """Both chains of blocks, one above the other."""
    (axes,) = panels(drawing, 1, 1)
    axes.set_axis_off()
    axes.set_xlim(-0.6, 5.6)
    axes.set_ylim(-0.9, 1.7)
    _chain(axes, 1.0, _REPORT, ORANGE, "the report's diagrams: identification, then simulation")
    _chain(axes, 0.0, _MONITOR, SKY, "the monitor")
    text = (
        "The report's appendix has seven block diagrams: for ARX of orders 1 and 2 and for output-error models of "
        "orders 1 to 3 the identification, and for ARX the simulation. They differ in the number of delays alone, and "
        "are one "
        "chain. It is computed by `benchmarks/study_figures/report_scheme.py`; the "
        "monitor's own chain is drawn below it."
    )
    return Finding(text)


def _chain(axes: Axes, height: float, blocks: tuple[str, ...], colour: str, title: str) -> None:
    axes.text(-0.5, height + 0.42, title, fontsize=10, color=BLACK)
    for place, block in enumerate(blocks):
        axes.text(
            place, height, block, ha="center", va="center", fontsize=8.5,
            bbox={"boxstyle": "round,pad=0.45", "facecolor": colour, "edgecolor": "none", "alpha": 0.8},
        )  # fmt: skip
        if place:
            axes.annotate(
                "", (place - 0.42, height), (place - 0.58, height), arrowprops={"arrowstyle": "->", "color": GREY}
            )
