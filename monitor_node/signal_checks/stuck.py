"""Stuck: a sensor that shows the same value again and again, which it would not do if it measured.

Noise hardly ever gives the same reading twice; a sensor with coarse steps does it all the time, and if the signal is
slow, for long. So how many equal readings in a row are too many is learned from the run lengths of the training. With n
readings, of which c repeated the one before them, and m runs that reached j repeats, which s times of t went on beyond
them, a run of k repeats comes in the long run once in

    1 / p^k              readings, p = c / n,                      if repeats are independent,
    1 / (m/n p^(k - j))  readings, p = s / t, for any depth j,     if what is j deep goes on with probability p,

the recurrence time of success runs (Feller 1968, An introduction to probability theory, vol. 1, XIII.7), at the second
line for a Markov chain. Depths are 1, 2, 4, ... as far as five runs reached: a slow signal near the middle of a step
rests far longer than elsewhere, so its long runs go on more readily than its short ones, and the deeper lines see that.
The limit is the largest k that any line asks for once in `arl0` readings. Shares are not taken as found but as their
upper confidence bounds (Clopper & Pearson 1934, Biometrika 26(4)), so that with independent repeats 95 trainings of 100
give a limit which keeps `arl0` or more, and with dependent ones about as many, if the training has seen long runs. A
limit is also at least twice the longest run seen, and never so small that less than `SMALLEST` equal readings are a
fault. If it would be more readings than the training had, there is none: the signal is not judged.

A signal without noise gives another reason for equal readings: a plant that has come to rest. Before it rests it slows
down, and a sensor that sticks does not. So a run is judged only if the readings before it moved, in the mean of their
last few steps, at least a quarter as much as in the quietest such stretch of the training. What is missed by this: a
sensor with little noise that sticks while the plant is at rest; the charts of the residual see it when the plant moves.
What is not helped by it: a sensor whose steps are coarser than twice its noise. It repeats as often as the plant is
calm, and if the plant is calmer than it ever was in the training, a sound sensor can be called stuck.

A run counts on over missing samples, since equal values are no likelier across a gap than within. After `restart` it
counts from one. Signals that people set, like a valve position, rest as long as people like: judge measurements only.
"""

from collections import deque
from collections.abc import Sequence
from math import ceil, inf, isfinite, log

from scipy.special import betaincinv

from monitor_node.alarms.alarms import STUCK_SENSOR
from monitor_node.alarms.annunciator import AlarmBoard
from monitor_node.baseline.signal_range import SignalRange
from monitor_node.config import MonitorConfig
from monitor_node.signal_checks.base import SignalCheck
from reactorwatch.contract.codec import Publication
from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import LARGEST_VALUE, Judgement, finite, quantity
from reactorwatch.stored_state import StoredState

SMALLEST = 5
"""Fewer equal readings in a row than this are never a fault."""

ENOUGH_RUNS = 5
"""A depth that fewer runs reached says nothing of how they go on."""

MARGIN = 2
"""Times the longest run seen: so long at least is a run that is no fault."""

STRETCH = 8
"""Steps by which it is judged whether the signal was moving."""

AT_REST = 0.25
"""Of the mean step in the quietest stretch of the training: with less, the plant was coming to rest."""

CONFIDENCE = 0.95

READINGS = "readings"
"""The unit of the alarm."""


class StuckState(StoredState, frozen=True):
    """All that is set, learned and remembered.

    Attributes:
        arl0: see `Stuck`.
        runs: of the training: how many runs had so many repeats.
        quietest: mean absolute step in the quietest stretch of the training; infinite before the first.
        last: the reading before; None before the first.
        repeats: how many times in a row it has been repeated.
        steps: the last absolute steps up to the first of the readings that are equal now, newest last.
        learning: whether the present run belongs to the training.
    """

    arl0: float
    runs: dict[int, int]
    quietest: float
    last: float | None
    repeats: int
    steps: list[float]
    learning: bool


class Stuck:
    """Counts equal readings in a row of one signal, against a limit learned from how it repeats when it is sound.

    >>> from random import Random
    >>> noise = Random(1)
    >>> stuck = Stuck(arl0=432_000)
    >>> for _ in range(1000):
    ...     stuck.learn(noise.gauss(438.5, 0.3))
    >>> [stuck.update(438.5).out for _ in range(6)]
    [False, False, False, False, True, True]

    Args:
        arl0: readings between two false alarms in the mean, at least.

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
        self._steps: deque[float] = deque(maxlen=STRETCH)
        self._learning = False
        self._limit: float | None = None
        self._single: Judgement | None = None  # of a reading that is unlike the one before, made once

    @classmethod
    def from_state(cls, state: StuckState) -> "Stuck":
        """The one that goes on where `state` was taken.

        Raises:
            ValueError: the state is damaged.
        """
        stuck = cls(state.arl0)
        counts = [state.repeats, *state.runs, *state.runs.values()]
        if min(counts) < 0 or len(state.steps) > STRETCH or not all(0.0 <= step < inf for step in state.steps):
            raise ValueError(f"state of {cls.name} must hold counts and at most {STRETCH} sizes of steps, got {state}")
        stuck._runs, stuck._quietest = dict(state.runs), state.quietest
        stuck._last, stuck._repeats, stuck._learning = state.last, state.repeats, state.learning
        stuck._steps.extend(state.steps)
        return stuck

    @property
    def state(self) -> StuckState:
        """A copy of all that is set, learned and remembered."""
        return StuckState(
            self._arl0, dict(self._runs), self._quietest, self._last, self._repeats, list(self._steps), self._learning
        )

    @property
    def limit(self) -> float:
        """The most equal readings in a row that are no fault; infinite if, by what was learned, that can't be said."""
        if self._limit is None:
            self._limit = most_equal(self._runs, self._arl0)
        return self._limit

    def learn(self, value: float) -> None:
        """Take the next reading of the training in.

        Raises:
            ValueError: it is not finite; leave a missing sample out.
        """
        self._learning, self._limit, self._single = True, None, None
        if self._take(finite(value)) and len(self._steps) == STRETCH:
            self._quietest = min(self._quietest, self._movement())

    def update(self, value: float) -> Judgement:
        """Judge the next reading: the statistic counts it and those before it that are equal.

        Raises:
            ValueError: it is not finite; leave a missing sample out.
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
        moved = len(self._steps) == STRETCH and self._movement() >= AT_REST * self._quietest
        limit = self.limit if moved else inf
        return Judgement(equal, 0.0, 0.0, limit, equal > limit)

    def restart(self) -> None:
        """Forget the readings, as after a gap or a restart of the plant; what was learned stays."""
        if self._learning:
            self._end_run()
        self._last, self._repeats, self._learning = None, 0, False
        self._steps.clear()

    def _take(self, value: float) -> bool:
        """Count a reading; returns whether it differs from the one before."""
        last, self._last = self._last, value
        if last is None:
            return False
        if value == last:
            self._repeats += 1
            return False
        if self._learning:
            self._end_run()
        self._steps.extend([0.0] * min(self._repeats, STRETCH))
        self._steps.append(abs(value - last))
        self._repeats = 0
        return True

    def _end_run(self) -> None:
        self._limit = self._single = None
        self._runs[self._repeats] = self._runs.get(self._repeats, 0) + 1

    def _movement(self) -> float:
        return sum(self._steps) / STRETCH


def most_equal(runs: dict[int, int], arl0: float) -> float:
    """The most equal readings in a row that are no fault.

    Args:
        runs: of a sound signal: how many runs had so many repeats, the first reading of a run not counted.
        arl0: readings between two longer runs in the mean, at least.

    Returns:
        A whole number; infinite if the runs are too few or too long to tell.

    >>> most_equal({0: 1000}, 432_000)
    4.0
    >>> most_equal({999: 1}, 432_000)
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
        went_on = sum(count * (repeats - depth) for repeats, count in deep.items())
        # Two bounds that hold together with the confidence of one (Bonferroni).
        each = (1.0 + CONFIDENCE) / 2.0
        share = upper_bound(reached, readings, each)
        limits.append(depth + _length(upper_bound(went_on, went_on + reached, each), arl0 * share))
        depth *= 2
    limit = max(limits)
    return limit if limit <= readings else inf


def upper_bound(successes: int, trials: int, confidence: float) -> float:
    """Upper confidence bound on a probability: Clopper & Pearson (1934), Biometrika 26(4).

    Args:
        successes: how often it happened ...
        trials: ... in so many independent trials.
        confidence: with which the bound is not below the probability.

    >>> round(upper_bound(0, 100, 0.95), 4)  # 1 - 0.05^(1/100)
    0.0295
    """
    return float(betaincinv(successes + 1, trials - successes, confidence)) if successes < trials else 1.0


def _length(probability: float, arl0: float) -> float:
    """The least number of repeats, each of that probability, which come once in `arl0` or more."""
    if arl0 <= 1.0:
        return 0.0
    return float(ceil(log(arl0) / -log(probability))) if probability < 1.0 else inf


class StuckCheck(SignalCheck):
    """Raises an alarm when the sensor of an output is stuck; its readings are no measurements then."""

    name = Stuck.name
    can_be_false = True

    def __init__(self, config: MonitorConfig, board: AlarmBoard, ranges: Sequence[SignalRange]) -> None:
        super().__init__(config, board, ranges)
        self._alarms = [board.declare(self.name, name, at_once=True, tells_cause=True) for name in self.outputs]
        self._stuck: list[Stuck] = []
        self._note_alarms()

    @property
    def state(self) -> list[StuckState]:
        """Of each output; none before the training ends."""
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
            if judgement.out or not alarm.at_rest:
                name, times = self.outputs[index], judgement.statistic
                text = f"{name} is stuck: it has read {quantity(value, units[index], '.6g')} {times:.0f} times in a row"
                publications += self.judge(alarm, time_ns, judgement, READINGS, text, name, cause=STUCK_SENSOR)
                self._note_alarms()
        return publications

    @property
    def invalid(self) -> list[bool]:
        """See `SignalCheck`."""
        return self._invalid

    def on_restart(self) -> None:
        """See `SignalCheck`. After a gap equal readings are counted on: it makes them no likelier."""
        for stuck in self._stuck:
            stuck.restart()

    def _note_alarms(self) -> None:
        self._invalid = [alarm.memory.rule.standing for alarm in self._alarms]
