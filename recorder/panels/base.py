"""What a panel says of a run: plain descriptions, which know nothing of the program that draws them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from recorder.run import Run


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
FAULT = Colour(240, 228, 66)
QUIET = Colour(150, 150, 150)


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


class PlanePath(NamedTuple):
    """A line in a plane, in order of time; NaN leaves a gap."""

    name: str
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    colour: Colour


class PlaneMark(NamedTuple):
    """A point in a plane with its name beside it."""

    name: str
    x: float
    y: float
    colour: Colour


class PlanePlot(NamedTuple):
    """One measured thing over another."""

    title: str
    x_label: str
    y_label: str
    paths: tuple[PlanePath, ...]
    marks: tuple[PlaneMark, ...]


View: TypeAlias = TimePlot | EventLog | PlanePlot


@dataclass(frozen=True)
class Panel:
    """A part of the dashboard.

    Attributes:
        title: as on the screen.
        draw: the views of a run, from top to bottom; none if the run has nothing for it.
    """

    title: str
    draw: Callable[[Run], tuple[View, ...]]
