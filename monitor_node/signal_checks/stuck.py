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

A run continues over missing samples, since equal values are no likelier across a gap than within. After `restart` it
counts from one. Signals that operators set, like a valve position, rest for any time: check measurements only.
"""

from collections import deque
from collections.abc import Sequence
from math import ceil, inf, isfinite, log

from scipy.special import betaincinv

from monitor_node.alarms.alarms import STUCK_SENSOR
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.baseline.signal_range import SignalRange
from monitor_node.config import MonitorConfig
from monitor_node.signal_checks.base import SignalCheck
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

    >>> from random import Random
    >>> noise = Random(1)
    >>> stuck = Stuck(arl0=432_000)
    >>> for _ in range(1000):
    ...     stuck.learn(noise.gauss(438.5, 0.3))
    >>> [stuck.update(438.5).out for _ in range(6)]
    [False, False, False, False, True, True]

    Args:
        arl0: least mean number of readings between two false alarms.

    Raises:
        InputError: arl0 is not a number above 1.
    """

    name = "stuck"

    def __init__(self, arl0: float) -> None:
        if not 1.0 < arl0 < inf:
            raise InputError(f"arl0 must be a number above 1, got {arl0}")
        self._arl0 = float(arl0)
        self._runs: dict[int, int] = {}
        self._quietest = inf
        self._last: float | None = None
        self._repeats = 0
        self._steps: deque[float] = deque(maxlen=MOVEMENT_STEPS)
        self._learning = False
        self._limit: float | None = None
        self._single: Judgement | None = None  # of a reading that differs from the one before, made once

    @classmethod
    def from_state(cls, state: StuckState) -> "Stuck":
        """Resume from a state.

        Raises:
            ValueError: the state is damaged.
        """
        stuck = cls(state.arl0)
        counts = [state.repeats, *state.runs, *state.runs.values()]
        if min(counts) < 0 or len(state.steps) > MOVEMENT_STEPS or not all(0.0 <= step < inf for step in state.steps):
            raise ValueError(
                f"state of {cls.name} must hold counts and at most {MOVEMENT_STEPS} sizes of steps, got {state}"
            )
        stuck._runs, stuck._quietest = dict(state.runs), state.quietest
        stuck._last, stuck._repeats, stuck._learning = state.last, state.repeats, state.learning
        stuck._steps.extend(state.steps)
        return stuck

    @property
    def state(self) -> StuckState:
        """A copy of the state."""
        return StuckState(
            self._arl0, dict(self._runs), self._quietest, self._last, self._repeats, list(self._steps), self._learning
        )

    @property
    def limit(self) -> float:
        """Most equal readings in a row without a fault; infinite if the training cannot tell."""
        if self._limit is None:
            self._limit = longest_normal_run(self._runs, self._arl0)
        return self._limit

    def learn(self, value: float) -> None:
        """Learn from the next reading of the training; leave missing ones out.

        Raises:
            ValueError: the reading is not finite.
        """
        self._learning, self._limit, self._single = True, None, None
        if self._take(finite(value)) and len(self._steps) == MOVEMENT_STEPS:
            self._quietest = min(self._quietest, self._movement())

    def update(self, value: float) -> Judgement:
        """Evaluate the next reading; leave missing ones out. The statistic is the number of equal readings in a row.

        Raises:
            ValueError: the reading is not finite.
        """
        last = self._last
        if self._single and not self._repeats and last is not None and last != value and abs(value) < LARGEST_VALUE:
            self._last = value  # as nearly always
            self._steps.append(abs(value - last))
            return self._single
        finite(value)
        if self._learning:
            self._end_run()
            self._learning = False
        if self._take(value) or not self._repeats:
            if self._single is None:
                self._single = Judgement(1.0, 0.0, 0.0, self.limit, False)
            return self._single
        equal = self._repeats + 1.0
        moved = len(self._steps) == MOVEMENT_STEPS and self._movement() >= AT_REST * self._quietest
        limit = self.limit if moved else inf
        return Judgement(equal, 0.0, 0.0, limit, equal > limit)

    def restart(self) -> None:
        """Drop the last readings, as after a restart of the plant; the limit stays."""
        if self._learning:
            self._end_run()
        self._last, self._repeats, self._learning = None, 0, False
        self._steps.clear()

    def _take(self, value: float) -> bool:
        """Count a reading; returns True if it differs from the one before."""
        last, self._last = self._last, value
        if last is None:
            return False
        if value == last:
            self._repeats += 1
            return False
        if self._learning:
            self._end_run()
        self._steps.extend([0.0] * min(self._repeats, MOVEMENT_STEPS))
        self._steps.append(abs(value - last))
        self._repeats = 0
        return True

    def _end_run(self) -> None:
        self._limit = self._single = None
        self._runs[self._repeats] = self._runs.get(self._repeats, 0) + 1

    def _movement(self) -> float:
        return sum(self._steps) / MOVEMENT_STEPS


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
        self._stuck: list[Stuck] = []
        self._note_alarms()

    @property
    def state(self) -> list[StuckState]:
        """State of each output; empty before the training ends."""
        return [stuck.state for stuck in self._stuck]

    def restore(self, state: list[StuckState]) -> None:
        """See `SignalCheck`."""
        self._stuck = [Stuck.from_state(item) for item in state]
        self._note_alarms()

    def start(self, values: list[list[float]], e: list[list[float]], arl0: float) -> None:
        """See `SignalCheck`."""
        self._stuck = [Stuck(arl0) for _ in values]
        self._note_alarms()
        for stuck, readings in zip(self._stuck, values, strict=True):
            for reading in readings:
                if isfinite(reading):
                    stuck.learn(reading)

    def on_values(self, time_ns: int, values: list[float], units: list[str]) -> list[Publication]:
        """See `SignalCheck`."""
        publications: list[Publication] = []
        for index, value in enumerate(values):
            if not isfinite(value):
                continue
            alarm, judgement = self._alarms[index], self._stuck[index].update(value)
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

    def on_restart(self) -> None:
        """See `SignalCheck`. After a gap equal readings are counted on: it makes them no likelier."""
        for stuck in self._stuck:
            stuck.restart()

    def _note_alarms(self) -> None:
        self._invalid = [alarm.memory.rule.standing for alarm in self._alarms]
