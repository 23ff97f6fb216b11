"""Descriptions of plots, independent of the program that draws them.

A run is described segment by segment. A view with the title of an earlier one is the same view, and data with a time
are added to it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from recorder.columns import RunColumns


class Colour(NamedTuple):
    """Red, green and blue, 0 to 255, distinguishable on dark and light ground and by the colour-blind.

    The hues are those of Okabe and Ito, "Color Universal Design" (2008).
    """

    red: int
    green: int
    blue: int


MEASURED = Colour(86, 180, 233)
PREDICTED = Colour(230, 159, 0)
INPUT = Colour(0, 158, 115)
LIMIT = Colour(150, 150, 150)
RESIDUAL = Colour(204, 121, 167)
ALARM = Colour(213, 94, 0)
FAULT = Colour(225, 200, 30)
QUIET = Colour(150, 150, 150)
SETPOINT = Colour(225, 200, 30)
STABLE = Colour(60, 200, 140)
UNSTABLE = Colour(225, 130, 190)
SEVERAL = (MEASURED, PREDICTED, INPUT, RESIDUAL, FAULT, ALARM)
"""Colours of lines of one kind, in order."""


class Series(NamedTuple):
    """A line in a time plot.

    Attributes:
        name: name of the line, unique in its plot.
        time_ns: times, shape (points,), ascending.
        value: values, shape (points,); NaN leaves a gap.
        colour: colour of the line.
        width: width of the line, in points of the screen.
        held: True to draw steps, because a value holds until the next.
        legend: displayed name, where it is not `name`; lines may share one.
    """

    name: str
    time_ns: NDArray[np.int64]
    value: NDArray[np.float64]
    colour: Colour
    width: float = 1.5
    held: bool = False
    legend: str = ""


class TimePlot(NamedTuple):
    """Lines over the time of the run.

    Attributes:
        title: displayed title.
        unit: unit of all lines.
        series: lines, the last on top.
        shown: initial range of values; None for all.
    """

    title: str
    unit: str
    series: tuple[Series, ...]
    shown: tuple[float, float] | None = None


class Event(NamedTuple):
    """A line of text at a time; `kind` is a word."""

    time_ns: int
    kind: str
    text: str
    colour: Colour


class EventLog(NamedTuple):
    """Events, oldest first."""

    title: str
    events: tuple[Event, ...]


class StateLine(NamedTuple):
    """States over time: each word holds from its time on."""

    name: str
    time_ns: tuple[int, ...]
    states: tuple[str, ...]


class StateLines(NamedTuple):
    """Lanes of states over the time of the run; `colours` maps the word of a state to its colour."""

    title: str
    lines: tuple[StateLine, ...]
    colours: Mapping[str, Colour]


class PlanePath(NamedTuple):
    """Line in a plane; `x` and `y` have shape (points,), and NaN leaves a gap."""

    name: str
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    colour: Colour
    width: float = 0.8


class PlaneMark(NamedTuple):
    """Labelled point in a plane."""

    name: str
    x: float
    y: float
    colour: Colour


class Box(NamedTuple):
    """Rectangle in the units of a plane."""

    x_lower: float
    x_upper: float
    y_lower: float
    y_upper: float


class PlanePlot(NamedTuple):
    """Plot of one quantity over another.

    Attributes:
        title: displayed title.
        x_label: label of the x axis, with the unit.
        y_label: label of the y axis, with the unit.
        box: rectangle that sets the scales; that of the first segment counts.
        shown: rectangle that is initially visible.
        time_ns: time of the paths.
        paths: paths in order of time; those of a segment are added.
        curves: present curves; those of a segment replace earlier ones.
        marks: present marks; those of a segment replace earlier ones.
        events: permanent marks.
        note: line of text above the plot.
    """

    title: str
    x_label: str
    y_label: str
    box: Box
    shown: Box
    time_ns: int
    paths: tuple[PlanePath, ...] = ()
    curves: tuple[PlanePath, ...] = ()
    marks: tuple[PlaneMark, ...] = ()
    events: tuple[PlaneMark, ...] = ()
    note: str = ""


class ViewReference(NamedTuple):
    """Copy of a view of another panel, omitted if that panel has none."""

    panel: str
    title: str


View: TypeAlias = TimePlot | EventLog | StateLines | PlanePlot | ViewReference
Arrangement: TypeAlias = Literal["rows", "grid", "beside"]


@dataclass(frozen=True)
class Panel:
    """A tab of the dashboard.

    Attributes:
        title: displayed title.
        draw: returns the views of a run or of a segment; empty without data.
        arranged: one view below the other (`rows`), two in a row (`grid`), or views over time on the left and others
            on the right (`beside`).
    """

    title: str
    draw: Callable[[RunColumns], tuple[View, ...]]
    arranged: Arrangement = "rows"
