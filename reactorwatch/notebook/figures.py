"""Figures of results with matplotlib: panels of time plots over one another."""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.notebook.extra import import_optional

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MEASURED, MODEL, INPUT, ALARM = "#1f77b4", "#ff7f0e", "#2ca02c", "#d62728"
"""Colours by meaning, as in the dashboards."""

WIDTH_IN, PANEL_HEIGHT_IN = 9.0, 1.9


@dataclass(frozen=True)
class Line:
    """A line of a panel.

    Attributes:
        label: text in the legend.
        x: shape (points,).
        y: shape (points,); NaN: a gap.
        colour: colour.
        steps: True if a value is held until the next one.
    """

    label: str
    x: Array
    y: Array
    colour: str = MEASURED
    steps: bool = False


@dataclass(frozen=True)
class Panel:
    """One plot.

    Attributes:
        title: quantity and unit.
        lines: lines from the back to the front.
    """

    title: str
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class Mark:
    """A moment, drawn through all panels.

    Attributes:
        x: the moment.
        label: text in the legend of the first panel; empty: none.
        colour: colour.
        end: end of a span, which is shaded; None: a moment.
    """

    x: float
    label: str = ""
    colour: str = ALARM
    end: float | None = None


@cache
def _figure_class() -> type["Figure"]:
    """A figure that shows itself once in a notebook, whichever backend is active."""
    base = import_optional("matplotlib.figure", "plot()").Figure

    class NotebookFigure(base):  # type: ignore[misc, valid-type] # known at run time only
        def _repr_png_(self) -> bytes:
            return figure_png(self)

    return NotebookFigure


def draw_panels(panels: Sequence[Panel], marks: Sequence[Mark] = (), x_title: str = "min") -> "Figure":
    """Draw panels over one another with one time axis.

    Args:
        panels: panels from the top.
        marks: moments and spans.
        x_title: title of the axis.

    Raises:
        InputError: matplotlib is not installed.
    """
    figure = _figure_class()(figsize=(WIDTH_IN, 0.6 + PANEL_HEIGHT_IN * len(panels)), layout="constrained")
    axes: Any = np.atleast_1d(figure.subplots(len(panels), sharex=True))
    for number, (axis, panel) in enumerate(zip(axes, panels, strict=True)):
        for line in panel.lines:
            style = "steps-post" if line.steps else "default"
            axis.plot(line.x, line.y, color=line.colour, label=line.label, linewidth=0.9, drawstyle=style)
        for mark in marks:
            label = mark.label if number == 0 and mark.label else None
            if mark.end is None:
                axis.axvline(mark.x, color=mark.colour, linestyle="--", linewidth=1.0, label=label)
            else:
                axis.axvspan(mark.x, mark.end, color=mark.colour, alpha=0.12, label=label, linewidth=0)
        axis.set_ylabel(panel.title)
        if len(axis.get_legend_handles_labels()[0]) > 1:
            axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize="small")
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel(x_title)
    return figure


def figure_png(figure: "Figure") -> bytes:
    """A figure as PNG."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=100)
    return file.getvalue()


def figure_html(figure: "Figure", text: str) -> str:
    """A figure as an element of a page that stands alone.

    Args:
        figure: the figure.
        text: description for readers that do not see it.
    """
    data = base64.b64encode(figure_png(figure)).decode()
    return f"<img alt='{escape(text)}' src='data:image/png;base64,{data}'>"
