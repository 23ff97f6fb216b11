"""Charts of the measured values themselves, of all signals of a plant together, inputs too.

A `ValueChart` has the training, missing signals, the regression of each signal on all others and averages of held-out
rows. A `StatisticsChart` averages statistics of a model of all signals, such as T2 and SPE, with limits from held-out
blocks: a model that was fitted to few rows fits them better than new ones, and the statistics of a plant remember. So
the training is cut into blocks, the model of the other blocks judges each, and from the cube roots of these statistics,
which are nearly normal (Wilson & Hilferty 1931, The distribution of chi-square, Proc. Nat. Acad. Sci. 17), an
autoregression is learned. It gives the variance of their exponentially weighted average, and its own errors widen the
limit, as they do for charts of residuals (`false_alarm_budget`). The chart plots the largest of the averages, in
standard deviations.

Two bounds change nothing in sound rows: a cube root counts at most six standard deviations, so one wild row
is no lasting change; an average stays below 1.25 limits, so the alarm of a large change ends soon after it.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from itertools import pairwise
from math import inf, sqrt
from types import MappingProxyType
from typing import ClassVar, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from reactorwatch.arrays import BLOCKS, Array
from reactorwatch.errors import positive
from reactorwatch.spc.averages import ewma
from reactorwatch.spc.charts.base import ROWS_A_SIGNAL, Chart, Judgement, vector
from reactorwatch.spc.charts.ewma import ewma_limit
from reactorwatch.spc.false_alarm_budget import TrainingErrors, degrees_of_freedom, student_tail
from reactorwatch.spc.prewhitening import Prewhitening, learn
from reactorwatch.stored_state import Memory

SHRINKAGE = 0.01
"""Share by which correlations are reduced: without it, signals that follow from others have no inverse."""


class ValueBaseline(NamedTuple):
    """A training as charts of values are designed from it.

    Attributes:
        names: names of the signals.
        values: rows in which no signal is missing, shape (rows, signals); each varies.
        arl0: run length of the alarm of a single signal without a fault, in rows.
        settings: settings of the charts, by key.
        signals: signals that the settings name for charts, by key.
        inputs: number of inputs, which come first.
    """

    names: tuple[str, ...]
    values: Array
    arl0: float
    settings: Mapping[str, float]
    signals: Mapping[str, tuple[str, ...]] = MappingProxyType({})
    inputs: int = 0


class ValueChart(Chart):
    """A chart of the values of all signals; a sample is a vector.

    It has the false alarms of one alarm for each of its signals, or for each output.

    Attributes:
        names: names of its signals, in the order of a sample, the inputs first.
        is_of_outputs: whether it judges the outputs only.
        locates: whether the first signals of its explanation are those at which a disturbance may enter.
        fewest_signals: least number of its signals.
    """

    names: tuple[str, ...]
    is_of_outputs: ClassVar[bool] = False
    locates: ClassVar[bool] = False
    fewest_signals: ClassVar[int] = 8  # with fewer the others say too little of each one

    @classmethod
    @abstractmethod
    def design(cls, baseline: ValueBaseline) -> Self:
        """The chart for a training; there must be no obstacle to it."""

    @classmethod
    @abstractmethod
    def relative_rates(cls, baseline: ValueBaseline) -> Array:
        """Rate of false alarms by the errors of the training, in shares of one signal's alarm, shape (draws,)."""

    @abstractmethod
    def fill(self, x: Array) -> Array | None:
        """The sample with expected values in place of missing ones, NaN; None if too many are missing."""

    @abstractmethod
    def explain(self) -> tuple[str, dict[str, float]]:
        """The text of an alarm at the newest sample, and each signal's share of it, the largest first."""

    @classmethod
    def obstacle(cls, baseline: ValueBaseline) -> str:
        """The reason why there can be no chart after a training, whose `arl0` is not known yet; empty if there can."""
        values, names, signals = baseline.values, baseline.names, baseline.signals
        for item in cls.settings:
            lost = [name for name in signals.get(item.key, ()) if name not in names]
            if lost:
                return f"{item.key} names {lost[0]}, which does not vary in the training or has no values there"
        if len(names) < cls.fewest_signals:
            return f"it needs {cls.fewest_signals} signals or more that vary, got {len(names)}"
        needed = max(ROWS_A_SIGNAL * len(names), 100)  # of which a part is held out
        if len(values) < needed:
            return (
                f"the training has {len(values)} rows in which all {len(names)} signals could be learned from, "
                f"{needed} are needed"
            )
        return ""


def student_limit(baseline: ValueBaseline, known: float, freedom: float, largest: float) -> float:
    """Limit of averages whose variances were estimated, in standard deviations.

    Where less than one false alarm is promised in the rows of the training, it is not below their largest average.

    Args:
        baseline: training of the signals.
        known: limit that holds when the variances are known.
        freedom: degrees of freedom of the variances.
        largest: largest average of the training.
    """
    limit = -float(special.stdtrit(freedom, float(special.ndtr(-known))))
    return max(limit, largest) if baseline.values.size < baseline.arl0 else limit


def fill_missing(x: Array, centre: Array, matrix: Array) -> Array | None:
    """The sample with the mean given the others in place of missing signals; None if too many are missing.

    Args:
        x: values of the signals, shape (p,); NaN where missing.
        centre: mean of each signal, shape (p,).
        matrix: matrix from deviations of the signals to residuals, each in any unit, shape (p, p).
    """
    missing = ~np.isfinite(x)
    count = int(np.count_nonzero(missing))
    if not count:
        return x
    if count > 0.5 * x.size:
        return None
    off = np.where(missing, 0.0, x - centre)
    off[missing] = -np.linalg.solve(matrix[np.ix_(missing, missing)], matrix[missing] @ off)
    return np.asarray(np.where(missing, centre + off, x))


def adjustment(rows: Array) -> tuple[Array, Array]:
    """Means of signals, and the matrix from their deviations to the residuals w.

    Args:
        rows: scaled signals, shape (rows, p).
    """
    centre = rows.mean(axis=0)
    covariance = np.atleast_2d(np.cov(rows, rowvar=False))
    covariance *= 1.0 - SHRINKAGE
    covariance[np.diag_indices_from(covariance)] /= 1.0 - SHRINKAGE
    inverse = np.linalg.inv(covariance)
    return np.asarray(centre), np.asarray(inverse / np.sqrt(np.diag(inverse))[:, None])


def average_rows(residuals: Array, weight: float) -> Array:
    """Exponentially weighted averages of residuals from 0 on, without the first ones, shape (rows, p).

    Args:
        residuals: held-out residuals, shape (rows, p).
        weight: lambda.
    """
    return ewma(residuals, weight)[min(int(2.0 / weight), len(residuals) // 2) :]


# --- averages of statistics ------------------------------------------------------------------------------------

Model: TypeAlias = dict[str, Array]
"""Arrays of a model, by name."""


class StatisticsMemory(Memory):
    """Memory of such a chart.

    Attributes:
        names: names of the signals.
        weight: lambda.
        limit: limit of the averages in standard deviations.
        model: arrays of the model and of the limits, by name.
        averages: average of each statistic.
        parts: averages of the signals' parts of them, shape (statistics, signals).
        before: rows before the next one, shape (at most `rows_before`, signals).
    """

    names: tuple[str, ...]
    weight: float
    limit: float
    model: Model
    averages: Array
    parts: Array
    before: Array


class Averages(NamedTuple):
    """Averages of sound statistics' cube roots, one each.

    Attributes:
        means: mean of the cube roots.
        row_sds: standard deviation of a row's cube root.
        sds: standard deviation of the average, errors of the mean included.
        freedom: degrees of freedom of the least known one.
        largest: largest average of the held-out rows, in standard deviations.
    """

    means: Array
    row_sds: Array
    sds: Array
    freedom: float
    largest: float

    @classmethod
    def of(cls, roots: Array, weight: float, sds: Array, freedom: float) -> Self:
        """Averages of cube roots with these standard deviations; rows with NaN are left out."""
        known = roots[np.isfinite(roots).all(axis=1)]
        means = known.mean(axis=0)
        return cls(means, known.std(axis=0), sds, freedom, float(np.max(average_rows(known - means, weight) / sds)))


class StatisticsChart(ValueChart):
    """Averages of the statistics of a model of all signals.

    Args:
        names: names of the signals.
        model: arrays of the model, with those of `Averages` and of the missing signals.
        weight: lambda, of the newest row, in (0, 1].
        limit: limit of the averages in standard deviations.

    Attributes:
        labels: names of the statistics.
        rows_before: number of rows before the newest one that the statistics need.
        pieces: number of separate pieces of a held-out block.
        is_skewed: whether averages of the plant are skewed, see `skewed_sds`.
        weight_key: key of the setting of the weight.
        reason: what a large statistic means, for the text of an alarm.
    """

    memory_type = StatisticsMemory
    labels: ClassVar[tuple[str, ...]]
    rows_before: ClassVar[int] = 0
    pieces: ClassVar[int] = 1
    is_skewed: ClassVar[bool] = False
    weight_key: ClassVar[str]
    reason: ClassVar[str]

    def __init__(self, names: Sequence[str], model: Mapping[str, Array], weight: float, limit: float) -> None:
        arrays = {name: np.ascontiguousarray(item, np.float64) for name, item in model.items()}
        labels, signals = len(self.labels), len(names)
        memory = np.zeros(labels), np.zeros((labels, signals)), np.empty((0, signals))
        self._use(StatisticsMemory(tuple(names), float(weight), positive("limit", limit), arrays, *memory))

    def _use(self, memory: StatisticsMemory) -> None:
        """See `Chart`."""
        self.memory, self.names, self.model = memory, memory.names, memory.model
        self.weight, self.limit = memory.weight, memory.limit
        self._newest: Array = np.zeros(len(self.names))
        if any(self.model[name].shape != (len(self.labels),) for name in ("root_means", "root_sds", "average_sds")):
            raise ValueError(f"a chart of {', '.join(self.labels)} must have a mean and deviations of each")
        if memory.averages.shape != (len(self.labels),) or not np.all(np.isfinite(memory.averages)):
            raise ValueError(f"averages must be {len(self.labels)} finite numbers, got {memory.averages.tolist()}")

    @classmethod
    @abstractmethod
    def fit(cls, values: Array, baseline: ValueBaseline) -> Model:
        """The model of rows, shape (rows, signals); `baseline` has their names and the settings."""

    @classmethod
    @abstractmethod
    def parts(cls, model: Model, window: Array) -> Array:
        """Each signal's part of the statistics of a row, whose sums they are, shape (statistics, signals).

        Args:
            model: from `fit`.
            window: the row and those before it, the newest last, shape (rows_before + 1, signals).
        """

    @classmethod
    def statistics(cls, model: Model, window: Array) -> Array:
        """Statistics of a row, shape (statistics,); arguments as for `parts`."""
        return np.asarray(cls.parts(model, window).sum(axis=1))

    @classmethod
    def edges(cls, baseline: ValueBaseline) -> list[int]:
        """First row of each piece of the training, and the number of its rows; see `pieces`."""
        return list(map(int, np.linspace(0, len(baseline.values), BLOCKS * cls.pieces + 1)))

    @classmethod
    def shrinkage(cls, model: Model, held_out: int, rows: int) -> float:
        """Ratio of the statistics of new rows after a fit to some rows, to that after a fit to fewer; at most 1."""
        return 1.0

    @classmethod
    def design(cls, baseline: ValueBaseline) -> Self:
        """See `ValueChart`."""
        values, averages = baseline.values, cls.averages(baseline)
        model, scale = cls.fit(values, baseline), values.std(axis=0, ddof=1)
        centre, matrix = adjustment(values / scale)
        model |= {"root_means": averages.means, "root_sds": averages.row_sds, "average_sds": averages.sds}
        windows = (values[row - cls.rows_before : row + 1] for row in range(cls.rows_before, len(values)))
        model["usual_parts"] = np.mean([cls.parts(model, window) for window in windows], axis=0)
        model |= {"centre_of_missing": centre * scale, "matrix_of_missing": matrix / scale}
        return cls(baseline.names, model, baseline.settings[cls.weight_key], cls.limit_of(baseline, averages))

    @classmethod
    def averages(cls, baseline: ValueBaseline) -> Averages:
        """Averages of the training's statistics, each row judged by the model of the other blocks."""
        roots, weight = cls.held_out_roots(baseline), baseline.settings[cls.weight_key]
        learned = [learn(column, 1e-12) for column in roots.T]
        sds = [sqrt(average_variance(item, weight) + (item.sd / item.shift_gain) ** 2 / item.rows) for item in learned]
        freedom = min(degrees_of_freedom(item, weight) for item in learned)
        found = Averages.of(roots, weight, np.array(sds), freedom)
        if not cls.is_skewed:
            return found
        skewed = skewed_sds(found, roots, weight, cls._known_limit(baseline))
        return Averages.of(roots, weight, skewed, min(freedom, cls.most_freedom(baseline)))

    @classmethod
    def most_freedom(cls, baseline: ValueBaseline) -> float:
        """Largest number of degrees of freedom of skewed averages."""
        return inf

    @classmethod
    def held_out_roots(cls, baseline: ValueBaseline) -> Array:
        """Cube roots of the statistics of each row by the model of the other blocks, shape (rows, statistics).

        Those of the first rows of a block, whose rows before are in another one, are NaN.
        """
        values = baseline.values
        roots = np.full((len(values), len(cls.labels)), np.nan)
        for block in range(BLOCKS):
            pieces = list(pairwise(cls.edges(baseline)))[block::BLOCKS]
            others = np.delete(values, np.concatenate([np.arange(*piece) for piece in pieces]), axis=0)
            model = cls.fit(others, baseline)
            factor = cls.shrinkage(model, len(others), len(values))
            for first, end in pieces:
                for row in range(first + cls.rows_before, end):
                    window = values[row - cls.rows_before : row + 1]
                    roots[row] = np.cbrt(factor * cls.statistics(model, window))
        return roots

    @classmethod
    def limit_of(cls, baseline: ValueBaseline, averages: Averages) -> float:
        """Limit of the averages for the false alarms of the chart, in standard deviations."""
        return student_limit(baseline, cls._known_limit(baseline), averages.freedom, averages.largest)

    @classmethod
    def _known_limit(cls, baseline: ValueBaseline) -> float:
        """Limit of the averages if all about them were known; the alarms of one side are half of those of two."""
        arl0 = baseline.arl0 * len(cls.labels) / len(baseline.names)
        return ewma_limit(max(0.5 * arl0, 10.0), baseline.settings[cls.weight_key])

    @classmethod
    def relative_rates(cls, baseline: ValueBaseline) -> Array:
        """See `ValueChart`: an average whose variance is off crosses the limit more or less often."""
        averages, known = cls.averages(baseline), cls._known_limit(baseline)
        errors = TrainingErrors.draw(1).scale[:, 0]
        beyond = student_tail(cls.limit_of(baseline, averages), averages.freedom, errors)
        return np.asarray(len(baseline.names) * beyond / special.ndtr(-known))

    def update(self, x: ArrayLike) -> Judgement:
        """See `Chart`; x has shape (signals,)."""
        memory, self._newest = self.memory, vector(x, len(self.names))
        window = np.concatenate([memory.before, self._newest[None]])
        memory.before = window[max(len(window) - self.rows_before, 0) :]
        if len(window) > self.rows_before:
            off = np.cbrt(self.statistics(self.model, window)) - self.model["root_means"]
            off = np.minimum(off, 6.0 * self.model["root_sds"]) / self.model["average_sds"]
            averages = (1.0 - self.weight) * memory.averages + self.weight * off
            memory.averages = np.minimum(averages, 1.25 * self.limit)
            if memory.averages.max() > 0.5 * self.limit:  # from there on it may be an alarm, which names the signals
                parts = self.parts(self.model, window) - self.model["usual_parts"]
                memory.parts = (1.0 - self.weight) * memory.parts + self.weight * parts
            else:
                memory.parts = np.zeros_like(memory.parts)
        statistic = max(float(memory.averages.max()), 0.0)
        return Judgement(statistic, 0.0, 0.0, self.limit, statistic > self.limit)

    def fill(self, x: Array) -> Array | None:
        """See `ValueChart`: a missing signal gets its mean given the others."""
        return fill_missing(x, self.model["centre_of_missing"], self.model["matrix_of_missing"])

    def explain(self) -> tuple[str, dict[str, float]]:
        """See `ValueChart`: shares of what the signals' parts of the largest statistic have gained."""
        averages, parts = self.memory.averages, self.memory.parts
        largest = int(np.argmax(averages))
        gains = np.maximum(parts[largest], 0.0) + 1e-300
        order = np.argsort(-gains, kind="stable").tolist()
        shares = {self.names[i]: float(gains[i] / gains.sum()) for i in order}
        named = " and ".join(f"{name} ({100 * share:.0f} %)" for name, share in list(shares.items())[:3])
        text = (
            f"{self.labels[largest]} of the signals {self.reason}: on average {averages[largest]:.1f} sd above "
            f"that of the training (allowed: {self.limit:.1f} sd), most of it of {named}"
        )
        return text, shares

    def restart(self) -> None:
        """Forget the rows seen."""
        memory = self.memory
        memory.averages, memory.parts = np.zeros(len(self.labels)), np.zeros_like(memory.parts)
        memory.before = np.empty((0, len(self.names)))


def skewed_sds(found: Averages, roots: Array, weight: float, limit: float) -> Array:
    """Standard deviations of averages, such that a normal distribution of them has the right share beyond a limit.

    Averages of a plant that stays away for long are skewed: the first term of Cornish & Fisher (1938, Moments and
    cumulants in the specification of distributions, Rev. Int. Statist. Inst. 5) widens the limit.

    Args:
        found: averages without this correction.
        roots: cube roots, shape (rows, statistics).
        weight: lambda, of the newest row.
        limit: limit in standard deviations.
    """
    averages = average_rows(roots - found.means, weight)
    squares = np.mean(averages**2, axis=0)
    skewness = np.maximum(np.mean(averages**3, axis=0) / squares**1.5, 0.0)
    return np.asarray(np.sqrt(np.maximum(found.sds**2, squares)) * (1.0 + skewness * (limit - 1.0 / limit) / 6.0))


def average_variance(learned: Prewhitening, weight: float) -> float:
    """Variance of the exponentially weighted average of an autoregressive signal.

    >>> white = Prewhitening(0.0, (), 2.0, 100, 0.0, 0.0)
    >>> round(average_variance(white, 0.1), 4)  # 4 * 0.1 / 1.9
    0.2105

    Args:
        learned: autoregression of the signal.
        weight: lambda, of the newest value.
    """
    response, past, average, total = 1.0, [0.0] * len(learned.coefficients), 0.0, 0.0
    # Twenty memories: what comes after is below rounding.
    for _ in range(int(20.0 / weight * max(1.0, 1.0 / learned.shift_gain))):
        average = (1.0 - weight) * average + weight * response
        total += average**2
        past = [response, *past[:-1]] if past else []
        response = sum(a * value for a, value in zip(learned.coefficients, past, strict=True))
    return learned.sd**2 * total
