"""What a control chart is here: one statistic, judged sample by sample against limits.

All charts speak this language: `update(x)` takes the next value, a number or a vector, and returns a `Judgement`; all
that a chart is and remembers is in `state`, and `from_state` goes on where it was, bit for bit. A chart never restarts
by itself after a point that is out: `restart` does, when whoever watches it says that the cause is gone.
"""

from abc import ABC, abstractmethod
from math import isfinite
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.errors import InputError
from reactorwatch.spc.baseline import Baseline
from reactorwatch.stored_state import StoredState

Array = NDArray[np.float64]

LARGEST_VALUE = 1e30
"""Values at or beyond this are refused: their sums could overflow."""


class Judgement(NamedTuple):
    """A chart's view of one sample.

    Attributes:
        statistic: what is plotted.
        centre: where it should be.
        lower_limit: below it, it is out.
        upper_limit: above it, it is out.
        out: whether it is beyond a limit, or against another rule of the chart.
    """

    statistic: float
    centre: float
    lower_limit: float
    upper_limit: float
    out: bool

    @property
    def side(self) -> str:
        """On which side of the centre the statistic is."""
        return "above" if self.statistic > self.centre else "below"


class ChartState(StoredState, frozen=True):
    """All that a chart, or a bank of charts, is and remembers; the base of what each kind stores."""


class Setting(NamedTuple):
    """A number that people can set for a chart: a key of the monitor's settings.

    Attributes:
        key: begins with the chart's name.
        default: its value where the settings give none.
        lower: the smallest value that it can have.
        upper: the largest value that it can have.
    """

    key: str
    default: float
    lower: float
    upper: float


class Shown(NamedTuple):
    """A signal as texts of alarms show it.

    Attributes:
        name: of the signal.
        unit: of its values.
        scale: one standard deviation of its prewhitened residual, in that unit.
        passed: the part of a lasting shift of the signal that its prewhitened residual shows.
    """

    name: str
    unit: str
    scale: float
    passed: float


class Chart(ABC):
    """A control chart: a `SignalChart`, a `JointChart`, or one of the parameters of models.

    Attributes:
        name: in `[monitor] charts`, in the key of its points and in the name of its alarm.
        State: the type of its state.
        has_memory: whether a point depends on samples before it. One point out then raises the alarm; otherwise it
            takes `raise_count` of the last `window`, so that a single outlier raises none.
        settings: its own keys of `[monitor]`.
    """

    name: ClassVar[str]
    State: ClassVar[type[ChartState]]
    has_memory: ClassVar[bool] = True
    settings: ClassVar[tuple[Setting, ...]] = ()

    @classmethod
    @abstractmethod
    def from_state(cls, state: Any) -> Self:
        """The chart that goes on, bit for bit, where `state` was taken.

        Raises:
            ValueError: the state is damaged.
        """

    @property
    @abstractmethod
    def state(self) -> ChartState:
        """A copy of all that it is and remembers."""

    @abstractmethod
    def update(self, x: Any) -> Judgement:
        """Judge the next sample.

        Raises:
            ValueError: it is not finite; the chart's state is as before.
        """

    @abstractmethod
    def restart(self) -> None:
        """Forget the samples seen."""


class SignalChart(Chart):
    """A chart of one signal; a sample is a number. A plant has one for each output."""

    @classmethod
    @abstractmethod
    def design(cls, baseline: Baseline) -> Self:
        """The chart for a training of one signal, whose residual has the mean 0 and the standard deviation 1."""

    def explain(self, judgement: Judgement, signal: Shown) -> tuple[str, dict[str, float]]:
        """The text of an alarm, and each signal's share of it.

        Args:
            judgement: of the newest sample, which is out.
            signal: what the chart is of.
        """
        return f"{signal.name} is {judgement.side} the limit of its {self.name} chart", {signal.name: 1.0}


def describe(judgement: Judgement, unit: str, *sizes: float) -> tuple[str, ...]:
    """Side of the centre on which the statistic is, and sizes in a unit, as texts of alarms have them."""
    return judgement.side, *(format_quantity(size, unit) for size in sizes)


def format_quantity(value: float, unit: str, form: str = ".3g") -> str:
    """A number and its unit, as texts of alarms have it.

    >>> format_quantity(7.25, "K")
    '7.25 K'
    >>> format_quantity(7.25, "", "+.1f")
    '+7.2'

    Args:
        value: the number.
        unit: empty where it is not known; 1 where there is none.
        form: of the number.
    """
    return f"{value:{form}}" if unit in ("", "1") else f"{value:{form}} {unit}"


def finite(x: float) -> float:
    """The value itself.

    Raises:
        ValueError: it is NaN, infinite or beyond 1e30.
    """
    if not abs(x) < LARGEST_VALUE:
        raise ValueError(f"a chart takes finite values below {LARGEST_VALUE:g} in size, got {x}; leave the sample out")
    return x


def vector(x: ArrayLike, dimension: int) -> Array:
    """The sample as an array of shape (dimension,).

    Raises:
        ValueError: it has another shape, or an entry that is NaN, infinite or beyond 1e30.
    """
    values = np.asarray(x, dtype=np.float64)
    if values.shape != (dimension,):
        raise ValueError(f"a sample must have shape ({dimension},), got {values.shape}")
    for value in values.tolist():
        finite(value)
    return values


def positive(name: str, value: float) -> float:
    """The value itself.

    Raises:
        InputError: it is not a positive number.
    """
    if not (value > 0 and isfinite(value)):
        raise InputError(f"{name} must be a positive number, got {value}")
    return float(value)
