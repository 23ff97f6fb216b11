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

from math import ceil, inf, log, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv

from reactorwatch.codegen.numba_kernel import Entry, jit
from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import Judgement
from reactorwatch.stored_state import Memory, Records, place_records

SMALLEST = 5
"""Fewer equal readings in a row than this are never a fault."""

MOVEMENT_STEPS = 8
"""Steps in the mean that shows whether the signal was moving."""

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
"""Numbers of the check of one signal, see `StuckSensors`."""


@jit
def quantise(value: float, step: float) -> float:
    """Nearest multiple of a resolution; the value itself if that is 0.

    >>> quantise(20.831, 0.25), quantise(20.831, 0.0)
    (20.75, 20.831)
    """
    return np.floor(value / step + 0.5) * step if step > 0.0 else value


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
    moved = p.step_count == MOVEMENT_STEPS and movement(p) >= 0.25 * p.quietest
    return float(p.limit) if moved else inf


@jit
def is_stuck(p: Any) -> bool:
    """True if more readings in a row are equal than a sound sensor has."""
    return bool(p.repeats > 0 and p.repeats + 1.0 > allowed_readings(p))


@jit
def _take_all(numbers: Any, values: NDArray[np.float64], resolutions: NDArray[np.float64]) -> bool:
    found = False
    for i in range(values.size):
        if np.isfinite(values[i]):
            take_reading(numbers[i], quantise(values[i], resolutions[i]))
            found = found or is_stuck(numbers[i])
    return found


@jit
def _learn(numbers: Any, values: NDArray[np.float64], repeats: NDArray[np.int64]) -> int:
    """Count readings of a training; writes the repeats of each run, and returns the number of runs."""
    p, ended = numbers[0], 0
    for value in values:
        before = p.repeats
        if take_reading(p, value):
            repeats[ended] = before
            ended += 1
            if p.step_count == MOVEMENT_STEPS:
                p.quietest = min(p.quietest, movement(p))
    repeats[ended] = p.repeats
    return ended + 1


@jit
def _limit(numbers: Any) -> float:
    return allowed_readings(numbers[0])


_TAKE_ALL, _LEARN, _ALLOWED = Entry(_take_all), Entry(_learn), Entry(_limit)


class StuckSensors(Memory):
    """Equal readings in a row of some signals, against limits learned without a fault; the object is its own state.

    >>> stuck = StuckSensors.of(1)
    >>> stuck.learn(0, np.random.default_rng(1).normal(438.5, 0.3, 1000), arl0=432_000)
    >>> [stuck.update(np.array([438.5]), np.zeros(1)) for _ in range(6)]
    [False, False, False, False, True, True]

    Attributes:
        numbers: numbers of the check of each signal, see `STUCK`.
    """

    numbers: Records

    @classmethod
    def of(cls, count: int) -> "StuckSensors":
        """Checks of so many signals, before their training."""
        numbers = np.zeros(count, STUCK)
        numbers["limit"] = numbers["quietest"] = inf
        numbers["last"] = nan
        return cls(numbers)

    @property
    def is_ready(self) -> bool:
        """True if there was a reading of each signal since the training, or the last restart."""
        return not np.isnan(self.numbers["last"]).any()

    def place(self, numbers: Records) -> None:
        """Keep the numbers in an array of the plant from now on.

        Raises:
            ValueError: the numbers are of other signals, or damaged.
        """
        stored = place_records(self.numbers, numbers.copy())
        steps = stored["step_count"]
        if steps.min() < 0 or steps.max() > MOVEMENT_STEPS or stored["repeats"].min() < 0:
            raise ValueError(f"stuck sensors must have counts, and at most {MOVEMENT_STEPS} steps")
        numbers[:] = stored
        self.numbers = numbers

    def learn(self, i: int, values: NDArray[np.float64], arl0: float) -> None:
        """Learn from the readings of a training.

        Args:
            i: index of the signal.
            values: readings, all finite, in order of time.
            arl0: least mean number of readings between two false alarms.

        Raises:
            InputError: arl0 is not a number above 1.
        """
        if not 1.0 < arl0 < inf:
            raise InputError(f"arl0 must be a number above 1, got {arl0}")
        self.numbers[i] = (inf, inf, nan, np.zeros(MOVEMENT_STEPS), 0, 0)
        repeats = np.empty(values.size + 1, np.int64)
        ended = _LEARN.call(self.numbers[i : i + 1], values, repeats) if values.size else 0
        counts = zip(*np.unique(repeats[:ended], return_counts=True), strict=True)
        self.numbers["limit"][i] = longest_ordinary_run({int(count): int(runs) for count, runs in counts}, arl0)

    def update(self, values: NDArray[np.float64], resolutions: NDArray[np.float64]) -> bool:
        """Count the next reading of each signal; returns True if a sensor is stuck.

        Args:
            values: readings; NaN where missing.
            resolutions: stated resolution of each signal; 0 where there is none.
        """
        found: bool = _TAKE_ALL.call(self.numbers, values, resolutions)
        return found

    def judge(self, i: int) -> Judgement:
        """Evaluate the newest reading of a signal; the statistic is the number of equal readings in a row."""
        p = self.numbers[i]
        equal = float(p["repeats"]) + 1.0
        limit: float = _ALLOWED.call(self.numbers[i : i + 1]) if equal > 1.0 else float(p["limit"])
        return Judgement(equal, 0.0, 0.0, limit, equal > 1.0 and equal > limit)

    def restart(self) -> None:
        """Drop the last readings, as after a restart of the plant; the limits stay."""
        self.numbers["last"], self.numbers["repeats"], self.numbers["step_count"] = nan, 0, 0


def longest_ordinary_run(runs: dict[int, int], arl0: float) -> float:
    """Most equal readings in a row without a fault: a whole number, or infinite if the runs are too few or too long.

    Args:
        runs: number of runs by number of repeats, without a fault; the first reading of a run is no repeat.
        arl0: least mean number of readings between two longer runs.

    >>> longest_ordinary_run({0: 1000}, 432_000)
    4.0
    >>> longest_ordinary_run({999: 1}, 432_000)
    inf
    """
    confidence = 0.95  # of the bounds on shares: so many trainings of 100 keep `arl0`
    readings = sum(count * (repeats + 1) for repeats, count in runs.items())
    if not readings:
        return inf
    longest = max(runs)
    repeated = sum(count * repeats for repeats, count in runs.items())
    independent = _length(upper_bound(repeated, readings - 1, confidence), arl0)
    limits = [SMALLEST - 1.0, 2 * (longest + 1.0), independent]
    depth = 1
    while depth <= longest:
        deep = {repeats: count for repeats, count in runs.items() if repeats >= depth}
        reached = sum(deep.values())
        if reached < 5:  # too few for an estimate of their continuation
            break
        continued = sum(count * (repeats - depth) for repeats, count in deep.items())
        # Two bounds that hold together with the confidence of one (Bonferroni).
        each = (1.0 + confidence) / 2.0
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
