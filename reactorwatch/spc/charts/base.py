"""Control charts: one statistic each, evaluated sample by sample against limits.

All charts have one interface: `update(x)` takes the next value, a number or a vector, and returns a `Judgement`.
`memory` holds the parameters of a chart and what it remembers, and `resume` makes a chart that goes on from it, bit for
bit. A chart does not restart by itself after a point that is out: its owner calls `restart` when the cause is gone.
"""

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from reactorwatch.spc.baseline import Baseline
from reactorwatch.spc.training_errors import TrainingErrors, relative_rate
from reactorwatch.stored_state import Memory

Array = NDArray[np.float64]

LARGEST_VALUE = 1e30
"""Values at or beyond this are refused: their sums could overflow."""


class Judgement(NamedTuple):
    """Point of a chart for one sample.

    Attributes:
        statistic: plotted value.
        centre: expected value of the statistic.
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
        """Side of the centre on which the statistic is."""
        return "above" if self.statistic > self.centre else "below"


class Setting(NamedTuple):
    """A number that a user can set for a chart: a key of the monitor's settings.

    Attributes:
        key: begins with the chart's name.
        default: value where the settings give none.
        lower: smallest allowed value.
        upper: largest allowed value.
    """

    key: str
    default: float
    lower: float
    upper: float


class SignalSetting(NamedTuple):
    """Signals that a user must name for a chart: a key of the monitor's settings.

    Attributes:
        key: begins with the chart's name.
        most: largest number of signals.
    """

    key: str
    most: int


class Shown(NamedTuple):
    """A signal as texts of alarms show it.

    Attributes:
        name: name of the signal.
        unit: unit of its values.
        scale: one standard deviation of its prewhitened residual, in that unit.
        passed: the part of a lasting shift of the signal that its prewhitened residual shows.
    """

    name: str
    unit: str
    scale: float
    passed: float

    def describe(self, judgement: Judgement, size: float, allowed: float | None = None, lead: str = "") -> str:
        """Text of a deviation from the model: "T is 3.1 K above what the model expects (allowed: 2 K)".

        Args:
            judgement: point of the chart.
            size: size of the deviation.
            allowed: largest size within the limits; None: not shown.
            lead: words before the size, with a space behind them.
        """
        side = "above" if judgement.statistic > judgement.centre else "below"
        text = f"{self.name} is {lead}{format_quantity(size, self.unit)} {side} what the model expects"
        return text if allowed is None else f"{text} (allowed: {format_quantity(allowed, self.unit)})"


class Chart(ABC):
    """A control chart: a `SignalChart`, a `JointChart`, or one of the parameters of models.

    Attributes:
        name: in `[monitor] charts`, in the key of its points and in the name of its alarm.
        memory: its parameters and what it remembers: what runs, and what is stored; it is changed, never replaced.
        memory_type: the type of its memory.
        has_memory: whether a point depends on samples before it. One point out then raises the alarm; otherwise it
            takes `raise_count` of the last `window`, so that a single outlier raises none.
        settings: keys of `[monitor]` that belong to the chart.
    """

    name: ClassVar[str]
    memory_type: ClassVar[type[Memory]]
    has_memory: ClassVar[bool] = True
    settings: ClassVar[tuple[Setting | SignalSetting, ...]] = ()

    @classmethod
    def detector(cls, baseline: Baseline) -> "tuple[float, float, Array] | None":
        """Weight, limit in standard deviations of the average, and whitening matrix of the chart as a moving average.

        None: it is none, and the power of the monitor is stated without it.

        Args:
            baseline: training of the chart's signals, as for its design.
        """
        return None

    memory: Any

    @classmethod
    def resume(cls, memory: Any) -> Self:
        """Chart that goes on from a memory of `memory_type`, which it updates.

        Raises:
            ValueError: the memory is damaged.
        """
        chart = cls.__new__(cls)
        chart._use(memory)
        return chart

    def _use(self, memory: Any) -> None:
        """Check a memory, and update it from now on."""
        self.memory = memory

    @abstractmethod
    def update(self, x: Any) -> Judgement:
        """Judge the next sample.

        Raises:
            ValueError: it is not finite; the chart's memory is as before.
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

    @classmethod
    def relative_rates(cls, baseline: Baseline, errors: TrainingErrors) -> Array:
        """Rate of false alarms by the errors of the training, relative to the intended one, shape (draws,).

        Of a chart without memory it is that of its single points. A chart that does not define it counts as one of
        individual values.

        Args:
            baseline: training of one signal, as for `design`.
            errors: errors of this signal.
        """
        (learned,) = baseline.learned
        share = 1.0 / baseline.arl0 if cls.has_memory else baseline.point_probability
        return relative_rate(float(-ndtri(0.5 * share)), 1.0, learned, errors)

    def explain(self, judgement: Judgement, signal: Shown) -> tuple[str, dict[str, float]]:
        """The text of an alarm, and each signal's share of it.

        Args:
            judgement: the judgement of the newest sample, which is out.
            signal: the signal of the chart.
        """
        return f"{signal.name} is {judgement.side} the limit of its {self.name} chart", {signal.name: 1.0}


def format_quantity(value: float, unit: str, form: str = ".3g") -> str:
    """A number and its unit, as texts of alarms have it.

    >>> format_quantity(7.25, "K")
    '7.25 K'
    >>> format_quantity(7.25, "", "+.1f")
    '+7.2'

    Args:
        value: the number.
        unit: empty where it is not known; 1 where there is none.
        form: format of the number.
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
