"""The level of each output against that of the training: what moves more slowly than the noise, and lasts.

A model that follows the plant also follows a slow fall, and its residuals show nothing. This chart compares with the
training for good: it takes the exponentially weighted average of each output, less what the inputs explain of it, and
is out as long as one of these levels is farther from the training than a slowly wandering signal comes by chance
(`spc/slow_levels.py`). An output that follows its inputs to a new set point is not outside.

Limits grow where less is known of what the inputs explain: by sqrt(1 + h), h being the leverage of their averages; by
c^2 where an input's average is c times as far off as ever in the training, as what a line neglects; and after a start
by all that inputs before it may still do.
"""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import Entry, inline, jit
from reactorwatch.errors import InputError, positive
from reactorwatch.spc.charts.base import LARGEST_VALUE, Judgement, Setting, vector
from reactorwatch.spc.charts.value_chart import ValueBaseline, ValueChart
from reactorwatch.spc.detection import POWER
from reactorwatch.spc.false_alarm_budget import TrainingErrors
from reactorwatch.spc.slow_levels import FEWEST_SAMPLES, LAGS, InputResponse, SlowLevels, sample_spacing
from reactorwatch.stored_state import Memory

AWAY = 0.01
"""Share of sound rows in which a level counts as away: so few delay the end of an alarm in one of five cases, of twenty
rows that end it."""

_INPUTS, _WEIGHT, LIMIT, _BEFORE, _SLOWEST, _HEAD = range(6)


class _Parts(NamedTuple):
    """First number of each part of a chart's numbers, see `LevelMemory`."""

    centres: int
    averages: int
    scales: int
    doubts: int
    gains: int
    ranges: int
    leverage: int
    end: int


def _lay_out(inputs: int, outputs: int) -> _Parts:
    explaining = inputs * LAGS
    centres, averages = _HEAD, _HEAD + inputs + outputs
    scales = averages + explaining + outputs
    gains = scales + 2 * outputs
    ranges = gains + outputs * explaining
    leverage = ranges + inputs
    return _Parts(
        centres, averages, scales, scales + outputs, gains, ranges, leverage, leverage + explaining * explaining
    )


_parts_of = inline(_lay_out)  # for kernels; Python takes the function, which needs no compiler


@jit
def move(numbers: Array, x: Array) -> float:
    """Take a row into the averages; returns the largest statistic, -1 if the row cannot be taken.

    Args:
        numbers: see `LevelMemory`; more may follow.
        x: inputs, then outputs, shape (k + p,).
    """
    k, weight = int(numbers[_INPUTS]), numbers[_WEIGHT]
    p, explaining = x.size - k, k * LAGS
    at = _parts_of(k, p)
    for value in x:
        if not abs(value) < LARGEST_VALUE:
            return -1.0
    wide, leverage = 1.0, 1.0
    for j in range(k):
        first, part = at.averages + j * LAGS, weight
        numbers[first] += weight * (x[j] - numbers[at.centres + j] - numbers[first])
        for i in range(first + 1, first + LAGS):
            numbers[i] += part * (numbers[first] - numbers[i])
            part *= 0.25
        distance = numbers[first] / numbers[at.ranges + j]
        wide = max(wide, distance * distance)
    numbers[_BEFORE] *= 1.0 - numbers[_SLOWEST]
    for i in range(explaining):
        for j in range(explaining):
            leverage += numbers[at.leverage + i * explaining + j] * numbers[at.averages + i] * numbers[at.averages + j]
    wide *= np.sqrt(leverage)
    largest, outputs = 0.0, at.averages + explaining
    for i in range(p):
        numbers[outputs + i] += weight * (x[k + i] - numbers[at.centres + k + i] - numbers[outputs + i])
        level = numbers[outputs + i]
        for j in range(explaining):
            level -= numbers[at.gains + i * explaining + j] * numbers[at.averages + j]
        unit = wide * numbers[at.scales + i] + numbers[_BEFORE] * numbers[at.doubts + i]
        largest = max(largest, abs(level) / unit)
    return float(largest)


_MOVE = Entry(move)


def count_numbers(inputs: int, outputs: int) -> int:
    """Number of numbers of a chart of so many signals, see `LevelMemory`."""
    return _lay_out(inputs, outputs).end


@inline
def numbers_in_kernel(inputs: int, outputs: int) -> int:
    """The same for kernels."""
    return _parts_of(inputs, outputs).end


class LevelMemory(Memory):
    """Memory of the chart.

    Attributes:
        names: names of the signals, the inputs first.
        numbers: number of inputs, weight, limit, share of what was before the start in the slowest average that
            explains an output, its weight; centres of the signals; averages, those of an input together; of each
            output, one unit of the limit, and what inputs before the start may do, in units of the limit; then
            coefficients, ranges and leverage as in `InputResponse`.
        back: share of its limit within which the level of each output is back, shape (p,).
    """

    names: tuple[str, ...]
    numbers: Array
    back: Array


class Level(ValueChart):
    """The average of each output against its mean and slow variation in the training.

    >>> chart = Level(["T"], [80.0], [2.0], weight=0.5, limit=4.0)
    >>> [chart.update([x]).out for x in (76.0, 66.0, 66.0, 66.0)]
    [False, False, True, True]

    Args:
        names: names of the signals, the inputs first.
        centres: mean of each signal, shape (k + p,).
        scales: one unit of the limit of each output, shape (p,).
        weight: lambda, of the newest row, in (0, 1].
        limit: limit of the averages, in these units.
        response: response to the inputs; None without inputs.
        back: share of its limit within which the level of each output is back, shape (p,); None: all of it.

    Raises:
        InputError: an argument is out of its range, or the shapes differ.
    """

    name = "level"
    memory_type = LevelMemory
    fewest_signals = 1
    is_of_outputs = True
    settings = (Setting("level_weight", 0.1, 0.001, 1.0),)

    def __init__(
        self,
        names: Sequence[str],
        centres: ArrayLike,
        scales: ArrayLike,
        weight: float,
        limit: float,
        response: InputResponse | None = None,
        back: Array | None = None,
    ) -> None:
        if not 0.0 < weight <= 1.0:
            raise InputError(f"weight (lambda) must be in (0, 1], got {weight}")
        middle, units = (np.array(item, np.float64) for item in (centres, scales))
        p, k = units.size, len(names) - units.size
        if middle.shape != (k + p,) or not np.all(np.isfinite(middle)) or not np.all(units > 0.0):
            raise InputError(
                f"there must be centres of {len(names)} signals and positive scales, got {middle}, {units}"
            )
        given = response or InputResponse(np.zeros((p, 0)), np.zeros(0), np.zeros((0, 0)), np.zeros(p), 1.0)
        head = [k, weight, positive("limit", limit), 1.0 if k else 0.0, given.slowest]
        parts = given.gains.ravel(), given.ranges, given.leverage.ravel()
        averages = np.zeros(k * LAGS + p)
        numbers = np.concatenate([head, middle, averages, units, given.before / limit, *parts])
        self._use(LevelMemory(tuple(names), numbers, np.ones(p) if back is None else back))

    def _use(self, memory: LevelMemory) -> None:
        """See `Chart`."""
        self.memory, self.names, numbers = memory, memory.names, memory.numbers
        k = int(numbers[_INPUTS]) if numbers.size >= _HEAD else -1
        p, explaining = len(self.names) - k, k * LAGS
        is_whole = k >= 0 and p >= 1 and numbers.size == count_numbers(k, p) and memory.back.shape == (p,)
        if not (is_whole and np.all(np.isfinite(numbers))):
            raise ValueError(f"numbers of {len(self.names)} signals must be finite, got {numbers.tolist()}")
        self._inputs, self.limit, at = k, float(numbers[LIMIT]), _lay_out(k, p)
        self._centres = numbers[at.centres : at.averages]
        self._averages = numbers[at.averages : at.scales]
        self._scales, self._doubts = numbers[at.scales : at.doubts], numbers[at.doubts : at.gains]
        self._gains = numbers[at.gains : at.ranges].reshape(p, explaining)
        self._ranges = numbers[at.ranges : at.leverage]
        self._leverage = numbers[at.leverage :].reshape(explaining, explaining)

    @classmethod
    def obstacle(cls, baseline: ValueBaseline) -> str:
        """See `ValueChart`."""
        samples = 1 + FEWEST_SAMPLES + 2 * baseline.inputs
        rows, needed = len(baseline.values), samples * sample_spacing(baseline.settings["level_weight"])
        if len(baseline.names) == baseline.inputs:
            return "no output varies in the training"
        few = f"the training has {rows} rows with all signals, {needed} are needed for slow changes"
        return few if rows < needed else ""

    @classmethod
    def design(cls, baseline: ValueBaseline) -> Self:
        """See `ValueChart`; `level_weight` is the weight of the newest row."""
        slow, weight = _slow_levels(baseline), baseline.settings["level_weight"]
        limits = slow.limits(baseline.arl0)
        limit, back = float(np.max(limits / slow.sds)), slow.usual(AWAY) / limits
        return cls(baseline.names, slow.centres, limits / limit, weight, limit, slow.response, back)

    @classmethod
    def relative_rates(cls, baseline: ValueBaseline) -> Array:
        """See `ValueChart`: for each draw of errors, the rate of the memory that it stands for."""
        slow = _slow_levels(baseline)
        rates = slow.rates(slow.limits(baseline.arl0)) * baseline.arl0
        shares = special.ndtr(TrainingErrors.draw(slow.sds.size).scale)
        return np.asarray(
            sum(
                rates[np.minimum(np.searchsorted(np.cumsum(slow.weights[:, i]), shares[:, i]), len(rates) - 1), i]
                for i in range(slow.sds.size)
            )
        )

    @classmethod
    def reaches(cls, baseline: ValueBaseline) -> dict[str, float]:
        """For each output, how far a level has to be moved to be out in nine of ten cases, in its unit."""
        slow = _slow_levels(baseline)
        reaches = slow.limits(baseline.arl0) + float(special.ndtri(POWER)) * slow.sds
        return dict(zip(baseline.names[baseline.inputs :], reaches.tolist(), strict=True))

    def update(self, x: ArrayLike) -> Judgement:
        """See `Chart`; x has shape (k + p,)."""
        values = np.ascontiguousarray(x, dtype=np.float64)
        statistic = _MOVE.call(self.memory.numbers, values) if values.shape == self._centres.shape else -1.0
        if statistic < 0.0:
            vector(x, self._centres.size)  # says what is wrong
        return Judgement(statistic, 0.0, 0.0, self.limit, statistic > self.limit)

    def fill(self, x: Array) -> Array | None:
        """See `ValueChart`: the average of an input stays as it is, that of an output moves as the inputs explain."""
        known, k, weight = np.isfinite(x), self._inputs, self.memory.numbers[_WEIGHT]
        if not known.any():
            return None
        driving, own = np.split(self._averages, [self._gains.shape[1]])
        before = driving.reshape(k, LAGS)
        inputs = np.where(known[:k], x[:k], self._centres[:k] + before[:, 0])
        after = before.copy()
        after[:, 0] += weight * (inputs - self._centres[:k] - before[:, 0])
        after[:, 1:] += weight * 0.25 ** np.arange(LAGS - 1) * (after[:, :1] - before[:, 1:])
        moved = self._gains @ (after - before).ravel()
        return np.concatenate([inputs, np.where(known[k:], x[k:], self._centres[k:] + own + moved / weight)])

    def explain(self) -> tuple[str, dict[str, float]]:
        """See `ValueChart`: the outputs outside their training, and shares of the squared deviations."""
        k, (levels, usual, reach) = self._inputs, self._levels()
        sizes = (levels - usual) / reach
        order = np.argsort(-np.abs(sizes), kind="stable").tolist()
        outside = [i for i in order if abs(sizes[i]) > 1.0] or order[:1]
        named = [
            f"{self.names[k + i]} is on average {levels[i]:.4g} (allowed{' with these inputs' if k else ''}: "
            f"{usual[i] - reach[i]:.4g} to {usual[i] + reach[i]:.4g})"
            for i in outside[:3]
        ]
        shares = sizes**2 / np.sum(sizes**2)
        return f"outside its training: {' and '.join(named)}", {self.names[k + i]: float(shares[i]) for i in order}

    @property
    def away(self) -> list[str]:
        """Outputs whose level is farther from the training than in all but one of a hundred sound rows."""
        levels, usual, reach = self._levels()
        away = np.abs(levels - usual) > self.memory.back * reach
        return [self.names[self._inputs + i] for i in np.flatnonzero(away).tolist()]

    def _levels(self) -> tuple[Array, Array, Array]:
        """Level of each output, what is usual with these inputs, and how far from it the limit is."""
        k, (driving, own) = self._inputs, np.split(self._averages, [self._gains.shape[1]])
        usual, levels = self._centres[k:] + self._gains @ driving, self._centres[k:] + own
        beyond = max([1.0, *((driving[::LAGS] / self._ranges) ** 2)])
        wide = beyond * np.sqrt(1.0 + driving @ self._leverage @ driving)
        return levels, usual, self.limit * (wide * self._scales + self.memory.numbers[_BEFORE] * self._doubts)

    def restart(self) -> None:
        """Forget the rows seen."""
        self._averages[:] = 0.0
        self.memory.numbers[_BEFORE] = 1.0 if self._inputs else 0.0


def _slow_levels(baseline: ValueBaseline) -> SlowLevels:
    return SlowLevels.of(baseline.values, baseline.inputs, baseline.settings["level_weight"])
