"""What a panel says of a run: plain descriptions, which know nothing of the program that draws them.

A run is described stretch by stretch. What has a time is added to what there is; a view of the same title is the same
view.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from recorder.columns.run import Run


class Colour(NamedTuple):
    """Red, green and blue, 0 to 255; chosen to be told apart on dark and on light ground, and by the colour-blind.

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
STABLE = Colour(60, 200, 140)
UNSTABLE = Colour(225, 130, 190)
SEVERAL = (MEASURED, PREDICTED, INPUT, RESIDUAL, FAULT, ALARM)
"""For lines that are alike, one after the other."""


class Series(NamedTuple):
    """A line in a time plot.

    Attributes:
        name: of the line, of which there is one in a plot.
        time_ns: shape (points,), ascending.
        value: shape (points,); NaN leaves a gap.
        colour: of the line.
        width: of the line, in points of the screen.
        held: drawn as steps, because the value holds until the next.
        legend: the name for people, where it is not `name`; lines may share one.
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
        title: as on the screen.
        unit: of all its lines.
        series: the lines, the last on top.
        shown: the values between which it opens; None for all.
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
    """What state a thing is in: from each time on, a word."""

    name: str
    time_ns: tuple[int, ...]
    states: tuple[str, ...]


class StateLines(NamedTuple):
    """Lanes over the time of the run, coloured by the state of each; `colours` are by its word."""

    title: str
    lines: tuple[StateLine, ...]
    colours: Mapping[str, Colour]


class PlanePath(NamedTuple):
    """A line in a plane, shape (points,); NaN leaves a gap."""

    name: str
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    colour: Colour
    width: float = 0.8


class PlaneMark(NamedTuple):
    """A point in a plane with its name beside it."""

    name: str
    x: float
    y: float
    colour: Colour


class Box(NamedTuple):
    """A rectangle in a plane, in its units."""

    x_lower: float
    x_upper: float
    y_lower: float
    y_upper: float


class PlanePlot(NamedTuple):
    """One thing over another.

    Attributes:
        title: as on the screen.
        x_label: with the unit.
        y_label: with the unit.
        box: what sets the scales; that of the first stretch counts.
        shown: what it opens on.
        time_ns: that the paths are of.
        paths: in order of time; those of a stretch are added to those before.
        curves: as they are now; those of a stretch take the place of those before.
        marks: likewise.
        events: marks that stay.
        note: a line of text above it.
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


class Again(NamedTuple):
    """A view of another panel, here too, if there is one."""

    panel: str
    title: str


View: TypeAlias = TimePlot | EventLog | StateLines | PlanePlot | Again
Arrangement: TypeAlias = Literal["rows", "grid", "beside"]


@dataclass(frozen=True)
class Panel:
    """A tab of the dashboard.

    Attributes:
        title: as on the screen.
        draw: the views of a run, or of a stretch of it; none if there is nothing for it.
        arranged: one view under the other (`rows`), two in a row (`grid`), or what goes over time at the left and the
            rest at the right (`beside`).
    """

    title: str
    draw: Callable[[Run], tuple[View, ...]]
    arranged: Arrangement = "rows"
