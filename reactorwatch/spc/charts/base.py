"""Control charts: one statistic each, evaluated sample by sample against limits.

All charts have one interface: `update(x)` takes the next value, a number or a vector, and returns a `Judgement`.
`memory` holds the parameters of a chart and what it remembers, and `resume` makes a chart that goes on from it, bit for
bit. A chart does not restart by itself after a point that is out: its owner calls `restart` when the cause is gone.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import msgspec
import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri

from reactorwatch.arrays import Array
from reactorwatch.spc.false_alarm_budget import TrainingErrors, relative_rate
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.stored_state import Memory

LARGEST_VALUE = 1e30
"""Values at or beyond this are refused: their sums could overflow."""

MOST_SIGNALS = 100
"""Most signals of a joint chart: so many the run length without a shift is computed for."""

ROWS_A_SIGNAL = 2
"""Rows of the training that a chart of several signals needs for each: with fewer their relations are hardly known."""


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
        text = f"{self.name} is {lead}{format_quantity(size, self.unit)} {judgement.side} what the model expects"
        return text if allowed is None else f"{text} (allowed: {format_quantity(allowed, self.unit)})"


class Baseline(NamedTuple):
    """A training of one or several signals, and how rarely a chart of their residuals may raise a false alarm.

    Attributes:
        learned: the prewhitening of each signal.
        e: prewhitened residuals, shape (rows, signals), of the rows in which no signal is missing.
        memory_sd: standard deviation of each signal that charts with a memory use, see `prewhitening.memory_sds`.
        arl0: run length of the alarm without a fault, in rows.
        point_probability: probability of a single point that is out, of a chart whose alarm takes several points.
        settings: settings of the charts, by key.
    """

    learned: tuple[Prewhitening, ...]
    e: Array
    memory_sd: tuple[float, ...]
    arl0: float
    point_probability: float
    settings: Mapping[str, float]

    def of(self, signals: Sequence[int]) -> "Baseline":
        """The baseline of some of the signals, by their indices."""
        return self._replace(
            learned=tuple(self.learned[index] for index in signals),
            e=complete_rows(self.e, signals),
            memory_sd=tuple(self.memory_sd[index] for index in signals),
        )


class Design(msgspec.Struct, frozen=True):
    """The fastest chart of a kind for a shift, and its run lengths.

    Attributes:
        chart: name in the catalogue.
        parameters: values by the parameter names of the run-length commands.
        arl0: run length without a shift, in samples.
        shift: shift to be detected, in sigma.
        arl: run length at the shift, in samples.
    """

    chart: str
    parameters: Mapping[str, float | int | list[int]]
    arl0: float
    shift: float
    arl: float


class Chart(ABC):
    """A control chart: a `SignalChart`, a `JointChart`, a `ValueChart`, or one of the parameters of models.

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

    @classmethod
    def fastest(cls, arl0: float, shift: float, dimension: int, rules: tuple[int, ...]) -> Design:
        """Design the chart that detects a shift fastest at a run length; only of charts whose run length is computed.

        Args:
            arl0: run length without a shift.
            shift: shift to be detected, in sigma.
            dimension: number of signals, of a joint chart.
            rules: run rules, of a Shewhart chart.

        Raises:
            InputError: no limit gives that run length.
        """
        raise NotImplementedError(cls.name)

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


class JointChart(Chart):
    """A chart of all signals together; a sample is a vector."""

    @classmethod
    @abstractmethod
    def design(cls, baseline: Baseline) -> Self:
        """The chart for a training; there must be no obstacle to it."""

    @classmethod
    @abstractmethod
    def relative_rates(cls, baseline: Baseline, errors: TrainingErrors) -> Array:
        """Rate of false alarms by the errors of the training, relative to the intended one, shape (draws,).

        Of a chart without memory it is that of its single points. `T2.relative_rates` serves for any distance.

        Args:
            baseline: training of the signals, as for `design`.
            errors: errors of these signals.
        """

    @abstractmethod
    def contributions(self, x: ArrayLike) -> Array:
        """Each signal's part of the newest statistic, shape (p,); x is the newest sample."""

    @classmethod
    def obstacle(cls, e: Array, names: Sequence[str]) -> str:
        """The reason why there can be no chart after a training; empty if there can.

        Args:
            e: prewhitened residuals without missing ones, shape (rows, signals).
            names: names of the signals.
        """
        count = len(names)
        if count < 2:
            return "it needs two outputs or more"
        if count > MOST_SIGNALS:
            return f"it takes at most {MOST_SIGNALS} outputs, got {count}"
        if len(e) < ROWS_A_SIGNAL * count:
            return (
                f"the training has {len(e)} rows in which all {count} outputs could be learned from, "
                f"{ROWS_A_SIGNAL * count} are needed"
            )
        sizes, directions = np.linalg.eigh(correlation(e))
        if sizes[0] < 1e-8:  # of one signal's own variance: it varies by rounding only
            alike = [names[index] for index in np.flatnonzero(np.abs(directions[:, 0]) > 0.1).tolist()]
            return f"one of the outputs {', '.join(alike)} follows from the others"
        return ""

    def explain(self, x: ArrayLike, signals: Sequence[Shown]) -> tuple[str, dict[str, float]]:
        """The text of an alarm, and each signal's share of it.

        Args:
            x: the newest sample, which is out.
            signals: signals of the sample, in order.
        """
        parts = np.maximum(self.contributions(x), 0.0)
        shares = parts / np.sum(parts)
        order = np.argsort(-shares)
        names = " and ".join(f"{signals[index].name} ({100 * shares[index]:.0f} %)" for index in order)
        text = f"what the model leaves unexplained is unlike the training: {names}"
        return text, {signals[index].name: float(shares[index]) for index in order}


def complete_rows(e: Array, signals: Sequence[int]) -> Array:
    """The rows in which none of these signals is missing, shape (rows, len(signals))."""
    e = e[:, list(signals)]
    return e[np.all(np.isfinite(e), axis=1)]


def correlation(e: Array) -> Array:
    """Correlation matrix of the columns, shape (columns, columns); 0 with one that does not vary."""
    off = e - e.mean(axis=0) if len(e) else np.zeros((1, e.shape[1]))
    lengths = np.linalg.norm(off, axis=0)
    products = np.outer(lengths, lengths)
    matrix = off.T @ off / np.where(products > 0, products, 1.0)
    matrix = 0.5 * (matrix + matrix.T)
    matrix[np.diag_indices(e.shape[1])] = 1.0
    return np.asarray(matrix)


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
