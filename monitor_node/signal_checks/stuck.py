"""Stuck sensor: too many equal readings in a row.

Noise hardly ever gives the same reading twice; a sensor with coarse steps often repeats, and with a slow signal for
long. So the limit of equal readings in a row is learned from the run lengths of the training. With n readings, of which
c repeated the one before them, and m runs that reached j repeats and continued beyond them s times of t, a run of k
repeats occurs on average once in

    1 / p^k              readings, p = c / n,                      if repeats are independent,
    1 / (m/n p^(k - j))  readings, p = s / t, for any depth j,     if a run of depth j continues with probability p,

the recurrence time of success runs (Feller 1968, An introduction to probability theory, vol. 1, XIII.7), in the second
line for a Markov chain. Depths are 1, 2, 4, ... as far as five runs reached: a slow signal near the middle of a step
rests far longer than elsewhere, so its long runs are more persistent than its short ones, which the deeper lines show.
The limit is the largest k that any line gives for once in `arl0` readings. Shares are replaced by their upper
confidence bounds (Clopper & Pearson 1934, Biometrika 26(4)), so that with independent repeats 95 of 100 trainings give
a limit that keeps `arl0` or more, and with dependent ones about as many, if the training had long runs. A limit is at
least twice the longest run of the training, and at least `SMALLEST` equal readings. If it exceeds the readings of the
training, there is none: the signal is not checked.

A plant at rest is another reason for equal readings of a signal without noise. It slows down before, and a stuck sensor
does not. So a run is evaluated only if the readings before it moved, in the mean of their last few steps, at least a
quarter as much as in the quietest interval of the training. This misses a sensor with little noise that sticks while
the plant is at rest; the charts of the residual detect it when the plant moves. It does not help with steps coarser
than twice the noise: such a sensor repeats as often as the plant is calm, and if the plant is calmer than ever in the
training, a sound sensor can be called stuck.

Readings in the same step of a stated resolution are equal, however the numbers were rounded on their way.

A run continues over missing samples, since equal values are no likelier across a gap than within. After `restart` it
counts from one. Signals that operators set, like a valve position, rest for any time: check measurements only.
"""

from collections.abc import Sequence
from math import ceil, inf, isfinite, log, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv

from monitor_node.alarms.alarms import STUCK_SENSOR
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.baseline.resolution import quantise
from monitor_node.baseline.signal_range import SignalRange
from monitor_node.config import MonitorConfig
from monitor_node.signal_checks.base import SignalCheck
from reactorwatch.codegen.numba_kernel import Entry, jit
from reactorwatch.contract.codec import Publication
from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import LARGEST_VALUE, Judgement, finite, format_quantity
from reactorwatch.stored_state import StoredState

SMALLEST = 5
"""Fewer equal readings in a row than this are never a fault."""

ENOUGH_RUNS = 5
"""Least number of runs at a depth for an estimate of their continuation."""

MARGIN = 2
"""Least limit, in longest runs of the training."""

MOVEMENT_STEPS = 8
"""Steps in the mean that shows whether the signal was moving."""

AT_REST = 0.25
"""Share of the mean step in the quietest interval of the training: with less, the plant was coming to rest."""

CONFIDENCE = 0.95

READINGS = "readings"
"""The unit of the alarm."""


STUCK = np.dtype(
    [
        ("limit", "f8"),  # most equal readings in a row without a fault
        ("quietest", "f8"),
        ("last", "f8"),  # NaN before the first reading
        ("steps", "f8", (MOVEMENT_STEPS,)),  # newest last
        ("repeats", "i8"),
        ("step_count", "i8"),
    ],
    align=True,
)
"""Numbers of the check of one signal, see `StuckState`."""


@jit
def movement(p: Any) -> float:
    """Mean of the last absolute steps."""
    total = 0.0
    for k in range(p.step_count):
        total += p.steps[k]
    return total / MOVEMENT_STEPS


@jit
def _add_step(p: Any, size: float) -> None:
    if p.step_count < MOVEMENT_STEPS:
        p.steps[p.step_count] = size
        p.step_count += 1
        return
    for k in range(MOVEMENT_STEPS - 1):
        p.steps[k] = p.steps[k + 1]
    p.steps[MOVEMENT_STEPS - 1] = size


@jit
def take_reading(p: Any, value: float) -> bool:
    """Count a reading; returns True if it differs from the one before."""
    last, p.last = p.last, value
    if last != last:
        return False
    if value == last:
        p.repeats += 1
        return False
    for _ in range(min(p.repeats, MOVEMENT_STEPS)):
        _add_step(p, 0.0)
    _add_step(p, abs(value - last))
    p.repeats = 0
    return True


@jit
def allowed_readings(p: Any) -> float:
    """Most equal readings in a row; infinite if the signal came to rest before them."""
    moved = p.step_count == MOVEMENT_STEPS and movement(p) >= AT_REST * p.quietest
    return float(p.limit) if moved else inf


@jit
def is_stuck(p: Any) -> bool:
    """True if more readings in a row are equal than a sound sensor has."""
    return bool(p.repeats > 0 and p.repeats + 1.0 > allowed_readings(p))


@jit
def _take(numbers: Any, value: float) -> bool:
    return take_reading(numbers[0], value)


@jit
def _allowed_readings(numbers: Any) -> float:
    return allowed_readings(numbers[0])


@jit
def _take_all(numbers: Any, values: NDArray[np.float64], resolutions: NDArray[np.float64]) -> bool:
    found = False
    for i in range(values.size):
        if np.isfinite(values[i]):
            take_reading(numbers[i], quantise(values[i], resolutions[i]))
            found = found or is_stuck(numbers[i])
    return found


@jit
def _learn_all(numbers: Any, values: NDArray[np.float64], repeats: NDArray[np.int64]) -> int:
    """Count readings of a training; writes the repeats of each run that ends, and returns the number of these runs."""
    p, ended = numbers[0], 0
    for value in values:
        before = p.repeats
        if take_reading(p, value):
            repeats[ended] = before
            ended += 1
            if p.step_count == MOVEMENT_STEPS:
                p.quietest = min(p.quietest, movement(p))
    return ended


_TAKE, _TAKE_ALL, _LEARN_ALL = Entry(_take), Entry(_take_all), Entry(_learn_all)
_ALLOWED = Entry(_allowed_readings)


class StuckState(StoredState, frozen=True):
    """State of a check.

    Attributes:
        arl0: see `Stuck`.
        runs: number of the training's runs by number of repeats.
        quietest: mean absolute step in the quietest interval of the training; infinite before the first.
        last: last reading; None before the first.
        repeats: number of its repeats so far.
        steps: the last absolute steps up to the first of the present equal readings, newest last.
        learning: True if the present run belongs to the training.
    """

    arl0: float
    runs: dict[int, int]
    quietest: float
    last: float | None
    repeats: int
    steps: list[float]
    learning: bool


class Stuck:
    """Counts equal readings in a row of one signal, against a limit learned without a fault.

    >>> stuck = Stuck(arl0=432_000)
    >>> stuck.learn(np.random.default_rng(1).normal(438.5, 0.3, 1000))
    >>> [stuck.update(438.5).out for _ in range(6)]
    [False, False, False, False, True, True]

    Args:
        arl0: least mean number of readings between two false alarms.
        numbers: numbers of the check, shape (1,), as a view of those of a plant; None: its own.

    Raises:
        InputError: arl0 is not a number above 1.
    """

    name = "stuck"

    def __init__(self, arl0: float, numbers: NDArray[np.void] | None = None) -> None:
        if not 1.0 < arl0 < inf:
            raise InputError(f"arl0 must be a number above 1, got {arl0}")
        self._arl0 = float(arl0)
        self._runs: dict[int, int] = {}
        self._learning = False
        self.numbers = np.empty(1, STUCK) if numbers is None else numbers
        self.numbers[0] = (inf, inf, nan, np.zeros(MOVEMENT_STEPS), 0, 0)

    @classmethod
    def from_state(cls, state: StuckState, numbers: NDArray[np.void] | None = None) -> "Stuck":
        """Resume from a state.

        Raises:
            ValueError: the state is damaged.
        """
        counts = [state.repeats, *state.runs, *state.runs.values()]
        if min(counts) < 0 or len(state.steps) > MOVEMENT_STEPS or not all(0.0 <= step < inf for step in state.steps):
            raise ValueError(
                f"state of {cls.name} must hold counts and at most {MOVEMENT_STEPS} sizes of steps, got {state}"
            )
        stuck = cls(state.arl0, numbers)
        p = stuck.numbers[0]
        p["quietest"], p["last"] = state.quietest, nan if state.last is None else state.last
        p["repeats"], p["step_count"], p["steps"][: len(state.steps)] = state.repeats, len(state.steps), state.steps
        stuck._resume(dict(state.runs), learning=state.learning)
        return stuck

    @classmethod
    def of_numbers(cls, arl0: float, runs: dict[int, int], numbers: NDArray[np.void]) -> "Stuck":
        """Check with given numbers, after its training."""
        stuck = cls.__new__(cls)
        stuck._arl0, stuck._runs, stuck._learning, stuck.numbers = arl0, runs, False, numbers
        return stuck

    @property
    def state(self) -> StuckState:
        """A copy of the state."""
        p = self.numbers[0]
        last, steps = float(p["last"]), p["steps"][: p["step_count"]].tolist()
        return StuckState(
            self._arl0,
            dict(self._runs),
            float(p["quietest"]),
            None if last != last else last,
            int(p["repeats"]),
            steps,
            self._learning,
        )

    @property
    def training(self) -> tuple[dict[int, int], float]:
        """Number of the training's runs by number of repeats, and `arl0`."""
        return self._runs, self._arl0

    @property
    def is_ready(self) -> bool:
        """True if the training is over and there was a reading since the last restart."""
        last = float(self.numbers["last"][0])
        return not self._learning and last == last

    @property
    def limit(self) -> float:
        """Most equal readings in a row without a fault; infinite if the training cannot tell."""
        return longest_normal_run(self._runs, self._arl0) if self._learning else float(self.numbers["limit"][0])

    def learn(self, values: NDArray[np.float64]) -> None:
        """Learn from the next readings of the training, all of which are finite."""
        self._learning = True
        repeats = np.empty(values.size, np.int64)
        ended = _LEARN_ALL.call(self.numbers, values, repeats)
        for count, runs in zip(*np.unique(repeats[:ended], return_counts=True), strict=True):
            self._runs[int(count)] = self._runs.get(int(count), 0) + int(runs)

    def update(self, value: float) -> Judgement:
        """Evaluate the next reading; leave missing ones out. The statistic is the number of equal readings in a row.

        Raises:
            ValueError: the reading is not finite.
        """
        if not abs(value) < LARGEST_VALUE:
            finite(value)
        self.end_learning()
        _TAKE.call(self.numbers, value)
        return self.judge()

    def judge(self) -> Judgement:
        """Evaluate the newest reading."""
        p = self.numbers[0]
        equal = float(p["repeats"]) + 1.0
        limit: float = _ALLOWED.call(self.numbers) if equal > 1.0 else float(p["limit"])
        return Judgement(equal, 0.0, 0.0, limit, equal > 1.0 and equal > limit)

    def restart(self) -> None:
        """Drop the last readings, as after a restart of the plant; the limit stays."""
        self.end_learning()
        p = self.numbers[0]
        p["last"], p["repeats"], p["step_count"] = nan, 0, 0

    def _resume(self, runs: dict[int, int], *, learning: bool) -> None:
        self._runs, self._learning = runs, learning
        self.numbers["limit"] = longest_normal_run(self._runs, self._arl0)

    def end_learning(self) -> None:
        """End the training, if it lasts: count its last run, and compute the limit."""
        if not self._learning:
            return
        last = int(self.numbers["repeats"][0])
        self._resume({**self._runs, last: self._runs.get(last, 0) + 1}, learning=False)


def longest_normal_run(runs: dict[int, int], arl0: float) -> float:
    """Most equal readings in a row without a fault: a whole number, or infinite if the runs are too few or too long.

    Args:
        runs: number of runs by number of repeats, without a fault; the first reading of a run is no repeat.
        arl0: least mean number of readings between two longer runs.

    >>> longest_normal_run({0: 1000}, 432_000)
    4.0
    >>> longest_normal_run({999: 1}, 432_000)
    inf
    """
    readings = sum(count * (repeats + 1) for repeats, count in runs.items())
    if not readings:
        return inf
    longest = max(runs)
    repeated = sum(count * repeats for repeats, count in runs.items())
    independent = _length(upper_bound(repeated, readings - 1, CONFIDENCE), arl0)
    limits = [SMALLEST - 1.0, MARGIN * (longest + 1.0), independent]
    depth = 1
    while depth <= longest:
        deep = {repeats: count for repeats, count in runs.items() if repeats >= depth}
        reached = sum(deep.values())
        if reached < ENOUGH_RUNS:
            break
        continued = sum(count * (repeats - depth) for repeats, count in deep.items())
        # Two bounds that hold together with the confidence of one (Bonferroni).
        each = (1.0 + CONFIDENCE) / 2.0
        share = upper_bound(reached, readings, each)
        limits.append(depth + _length(upper_bound(continued, continued + reached, each), arl0 * share))
        depth *= 2
    limit = max(limits)
    return limit if limit <= readings else inf


def upper_bound(successes: int, trials: int, confidence: float) -> float:
    """Upper confidence bound on a probability: Clopper & Pearson (1934), Biometrika 26(4).

    Args:
        successes: number of successes.
        trials: number of independent trials.
        confidence: probability that the bound is not too low.

    >>> round(upper_bound(0, 100, 0.95), 4)  # 1 - 0.05^(1/100)
    0.0295
    """
    return float(betaincinv(successes + 1, trials - successes, confidence)) if successes < trials else 1.0


def _length(probability: float, arl0: float) -> float:
    """Least number of repeats in a row, each with that probability, that occurs at most once in `arl0` readings."""
    if arl0 <= 1.0:
        return 0.0
    return float(ceil(log(arl0) / -log(probability))) if probability < 1.0 else inf


class StuckCheck(SignalCheck):
    """Raises an alarm when the sensor of an output is stuck; its readings are no measurements then."""

    name = Stuck.name
    can_be_false = True

    def __init__(self, config: MonitorConfig, board: Annunciator, ranges: Sequence[SignalRange]) -> None:
        super().__init__(config, board, ranges)
        self._alarms = [
            board.declare(self.name, name, without_on_delay=True, names_cause=True) for name in self.outputs
        ]
        self._resolutions = np.array([config.resolution.get(name, 0.0) for name in self.outputs])
        self._watching = False
        self.numbers = np.zeros(len(self.outputs), STUCK)
        self._stuck: list[Stuck] = []
        self._note_alarms()

    @property
    def state(self) -> list[StuckState]:
        """State of each output; empty before the training ends."""
        return [stuck.state for stuck in self._stuck]

    def restore(self, state: list[StuckState]) -> None:
        """See `SignalCheck`."""
        self._stuck = [Stuck.from_state(item, self.numbers[i : i + 1]) for i, item in enumerate(state)]
        self._watching = False
        self._note_alarms()

    def start(self, values: list[list[float]], e: list[list[float]], arl0: float) -> None:
        """See `SignalCheck`."""
        self._stuck = [Stuck(arl0, self.numbers[i : i + 1]) for i in range(len(values))]
        self._watching = False
        self._note_alarms()
        for stuck, readings, step in zip(self._stuck, values, self._resolutions, strict=True):
            given = np.array(readings)
            given = given[np.isfinite(given)]
            stuck.learn(np.array([quantise(reading, step) for reading in given.tolist()]) if step else given)

    def on_values(self, time_ns: int, values: list[float], units: list[str]) -> list[Publication]:
        """See `SignalCheck`."""
        publications: list[Publication] = []
        if not self._watching:
            for stuck in self._stuck:
                stuck.end_learning()
            self._watching = True
        found = _TAKE_ALL.call(self.numbers, np.array(values), self._resolutions)
        if not (found or self._counting):
            return publications
        for index, value in enumerate(values):
            if not isfinite(value):
                continue
            alarm, judgement = self._alarms[index], self._stuck[index].judge()
            if judgement.out or alarm.memory.rule.standing or alarm.memory.rule.recent:
                name, times = self.outputs[index], judgement.statistic
                reading = format_quantity(value, units[index], ".6g")
                text = f"{name} is stuck: it has read {reading} {times:.0f} times in a row"
                publications += self.judge(alarm, time_ns, judgement, READINGS, text, name, cause=STUCK_SENSOR)
                self._note_alarms()
        return publications

    def invalid(self) -> list[bool]:
        """See `SignalCheck`."""
        return self._invalid

    @property
    def is_normal(self) -> bool:
        """See `SignalCheck`."""
        return all(stuck.is_ready for stuck in self._stuck)

    @property
    def trainings(self) -> list[tuple[dict[int, int], float]]:
        """See `Stuck.training`, of each output."""
        return [stuck.training for stuck in self._stuck]

    def on_restart(self) -> None:
        """See `SignalCheck`. After a gap equal readings are counted on: it makes them no likelier."""
        for stuck in self._stuck:
            stuck.restart()

    def _note_alarms(self) -> None:
        self._invalid = [alarm.memory.rule.standing for alarm in self._alarms]
        self._counting = any(alarm.memory.rule.standing or alarm.memory.rule.recent for alarm in self._alarms)
