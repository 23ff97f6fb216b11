"""Spike: one outlier, followed by a normal value. A sensor does that, a process does not.

A disturbed process stays disturbed for a while; so a standardised residual beyond `limit` is ambiguous until the next
one. The first one beyond is quarantined: charts with a memory and the correction of a filter do not get it. The next
value decides:

- it is normal: the quarantined value was a spike, and is dropped; or
- it is still off on the same side: a change. Nothing more is quarantined until the change is over. A change loses one
  sample by this; or
- it is beyond the limit on the other side: the first was a spike, and this one may be another, and is quarantined. A
  third one, on either side, is not: at most two in a row are, so that growing noise or an oscillation is not taken for
  spikes for long.

Normal means within half the limit, so that a change about as large as the limit is not taken for a spike each time it
falls below it.

While an alarm without a known cause is active, a fault may have moved the residual permanently, and values about its
new level are no spikes. So a value is then compared with the median of recent ones, in units of their median deviation
with a margin (but no less than before), and nothing is a spike before there are `LEAST_RECENT` of them.

Normal values make a false spike at the rate of a small Markov chain, `false_spike_rate`; since every spike has its own
value beyond the limit, it is never more than P(|z| > limit), and that bound holds for dependent values as well. Where
tails are heavier than normal, `spike_limit` learns a limit from the training: the largest |z| are taken to exceed
their threshold by an exponential excess (Pickands 1975, Statistical inference using extreme order statistics, Annals
of Statistics 3(1), with shape 0), whose mean is estimated with its largest quarter known only as larger (Epstein &
Sobel 1953, Life testing, Journal of the American Statistical Association 48), and given one standard error on top. So
up to one value in a hundred may be a spike in the training, whatever its size, and hardly moves the limit; if more
are, that is how this signal is, and the limit rises until they are none. Of outliers that a training has, only a change
of their rate is an alarm (`spike_rate`). For tails heavier than exponential there are more false spikes than promised;
but isolated far values are then what the signal has.
"""

from bisect import bisect_left, insort
from collections.abc import Sequence
from copy import deepcopy
from math import ceil, isfinite, log, sqrt
from typing import ClassVar, Literal, NamedTuple, TypeAlias

import numpy as np
from msgspec import field
from numpy.typing import ArrayLike
from scipy.special import ndtr, ndtri

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.baseline.signal_range import SignalRange
from monitor_node.config import MonitorConfig
from monitor_node.signal_checks.base import Flags, SignalCheck
from reactorwatch.arrays import Array
from reactorwatch.contract.codec import Publication
from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import LARGEST_VALUE, Judgement, finite, format_quantity, positive
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.spike_rate import SpikeRate
from reactorwatch.spc.training_errors import TrainingErrors, two_sided_tail
from reactorwatch.stored_state import Memory

NORMAL = 0.5
"""Share of the limit within which a value is normal."""

RECENT, LEAST_RECENT = 100, 10
"""Recent values with which a value is compared while an alarm is active, at most and at least."""

ERRORS = 3.0
"""Standard errors, each about 1 / sqrt(n), by which the spread of these values is taken larger than estimated."""

TAIL_SHARE = 0.05
LEAST_TAIL = 10
"""Share of the training's largest values from which its tail is estimated, and their least number."""

SEEN_SHARE = 0.75
"""Share of these, the smaller ones, whose size counts; the others count as larger."""

FEWEST_ROWS = 5 * LEAST_TAIL

_TO_SD = 1.4826  # of the median absolute deviation, for normal values

Phase: TypeAlias = Literal["quiet", "held", "held again", "changed"]


class Verdict(NamedTuple):
    """Result for a value.

    Attributes:
        quarantine: True if the value is a missing sample to filters and to charts with a memory.
        spike: True if the value *before* it was a spike.
        size: size of the spike; 0 without one.
    """

    quarantine: bool
    spike: bool
    size: float


NO_SPIKE = Verdict(False, False, 0.0)


class RecentValues:
    """The newest values of a signal, `RECENT` at most, with their median and median absolute deviation.

    They are also kept in ascending order, so that a row does not sort them.

    Args:
        values: the values, oldest first; the same list from now on.
    """

    def __init__(self, values: list[float]) -> None:
        self._values, self._ascending = values, sorted(values)

    def __len__(self) -> int:
        return len(self._ascending)

    def append(self, value: float) -> None:
        """Add a finite value; the oldest one goes if there are too many."""
        if len(self._values) == RECENT:
            del self._ascending[bisect_left(self._ascending, self._values.pop(0))]
        self._values.append(value)
        insort(self._ascending, value)

    def clear(self) -> None:
        """Remove all values."""
        self._values.clear()
        self._ascending.clear()

    def median_and_deviation(self) -> tuple[float, float]:
        """Median, and median absolute deviation from it; of at least one value."""
        ordered, n = self._ascending, len(self._ascending)
        half = n // 2
        level = ordered[half] if n % 2 else (ordered[half - 1] + ordered[half]) / 2
        # The values nearest to the median are neighbours: those from `low` to `low + half`, by bisection.
        low, high = 0, n - half - 1
        while low < high:
            middle = (low + high) // 2
            if level - ordered[middle] > ordered[middle + half + 1] - level:
                low = middle + 1
            else:
                high = middle
        below, above = level - ordered[low], ordered[low + half] - level
        largest = max(below, above)
        if n % 2:
            return level, largest
        if below > above:
            return level, (largest + max(level - ordered[low + 1], above)) / 2
        return level, (largest + max(below, ordered[low + half - 1] - level)) / 2


class Spike(Memory, dict=True):
    """Distinguishes spikes from changes in the standardised residuals of one signal; the object is its own state.

    >>> spike = Spike(limit=6.0)
    >>> [spike.update(z) for z in (0.3, 9.0, -0.5)][1:]
    [Verdict(quarantine=True, spike=False, size=0.0), Verdict(quarantine=False, spike=True, size=9.0)]
    >>> [spike.update(z).quarantine for z in (9.0, 9.0, 9.0)]  # a change
    [True, False, False]

    Attributes:
        limit: limit in standard deviations, beyond which a value may be a spike.
        phase: the value before was normal (quiet), is quarantined, is quarantined after a spike, or was part of a
            change.
        held: quarantined value; 0 if there is none.
        recent: newest values since an alarm is active, oldest first; empty without one.
        usual: spikes at a steady rate; None: there were none in the training.

    Raises:
        InputError: limit is not a positive number.
        ValueError: a value is not finite.
    """

    limit: float
    phase: Phase = "quiet"
    held: float = 0.0
    recent: list[float] = field(default_factory=list)
    usual: SpikeRate | None = None

    name: ClassVar[str] = "spike"

    def __post_init__(self) -> None:
        positive("limit", self.limit)
        for z in (self.held, *self.recent):
            finite(z)
        self._newest = RecentValues(self.recent)

    @property
    def is_normal(self) -> bool:
        """True if a value within the limit would change nothing."""
        return self.phase == "quiet" and not self.recent

    def update(self, z: float, *, is_moved: bool = False) -> Verdict:
        """Update with the next standardised residual; leave missing ones out.

        Args:
            z: the residual.
            is_moved: True if an alarm is active, so that a fault may have moved the residual.

        Raises:
            ValueError: the residual is not finite.
        """
        recent = self._newest
        if not is_moved:
            if recent:
                recent.clear()
            return self._decide(z)
        level, spread, is_decided = 0.0, 1.0, recent or self.phase in ("quiet", "changed")
        if len(recent) >= LEAST_RECENT:
            level, deviation = recent.median_and_deviation()
            margin = 1.0 + ERRORS / sqrt(len(recent))
            spread = max(1.0, margin * _TO_SD * deviation)
        elif is_decided:
            recent.append(finite(z))
            self.phase, self.held = "changed", 0.0
            return NO_SPIKE
        verdict = self._decide((finite(z) - level) / spread)
        if not verdict.quarantine:
            recent.append(z)
        return verdict._replace(size=verdict.size * spread)

    def _decide(self, z: float) -> Verdict:
        """Decide on a residual about 0."""
        if self.phase == "quiet" and abs(z) <= self.limit:  # as nearly always
            return NO_SPIKE
        if not abs(z) < LARGEST_VALUE:
            finite(z)
        beyond, normal = abs(z) > self.limit, abs(z) <= NORMAL * self.limit
        held, self.held = self.held, 0.0
        if self.phase in ("quiet", "changed"):
            if self.phase == "changed" and not normal:
                return NO_SPIKE
            self.phase = "held" if beyond else "quiet"
            self.held = z if beyond else 0.0
            return Verdict(beyond, False, 0.0)
        if not normal and (self.phase == "held again" or z * held > 0.0):
            self.phase = "changed"
            return NO_SPIKE
        self.phase = "held again" if beyond else "quiet"
        self.held = z if beyond else 0.0
        return Verdict(beyond, True, held)

    def restart(self) -> None:
        """Drop earlier values, as after a gap or a restart of the plant: a quarantined value stays undecided."""
        self.phase, self.held = "quiet", 0.0
        self._newest.clear()


def false_spike_rate(limit: float) -> float:
    """Rate of false spikes per value among independent normal values.

    The stationary rate of the Markov chain of `Spike.phase`.

    >>> round(1e9 * false_spike_rate(6.0), 2)
    1.97
    """
    beyond = 2.0 * float(ndtr(-limit))
    off = 2.0 * float(ndtr(-NORMAL * limit))
    # Visits to each phase for one visit to `held`.
    held_again = beyond / 2.0
    changed = (off / 2.0 + held_again * off) / (1.0 - off)
    quiet = 1.0 / beyond
    return (1.0 - off / 2.0 + held_again * (1.0 - off)) / (quiet + 1.0 + held_again + changed)


def spike_limit(z: ArrayLike, arl0: float) -> float:
    """Limit of `Spike` learned from a training; at least that of normal values.

    Args:
        z: standardised residuals without a fault, shape (rows,), without missing ones; at least 50.
        arl0: least mean number of values between two false spikes, if tails are exponential or lighter.

    Raises:
        InputError: too few values, or one that is not finite, or arl0 is not a number above 1.
    """
    if not 1.0 < arl0 < np.inf:
        raise InputError(f"arl0 must be a number above 1, got {arl0}")
    sizes = np.sort(np.abs(np.asarray(z, dtype=np.float64)))
    if sizes.ndim != 1 or sizes.size < FEWEST_ROWS or not np.isfinite(sizes).all():
        raise InputError(f"z must be at least {FEWEST_ROWS} finite values in a row, got {sizes.size}")
    tail = max(ceil(TAIL_SHARE * sizes.size), LEAST_TAIL)
    threshold = float(sizes[-tail - 1])
    seen = int(SEEN_SHARE * tail)
    excess = sizes[-tail:][:seen] - threshold
    scale = float(excess.sum() + (tail - seen) * excess[-1]) / seen
    learned = threshold + scale * (1.0 + 1.0 / sqrt(seen)) * max(0.0, log(arl0 * tail / sizes.size))
    return max(float(-ndtri(0.5 / arl0)), learned)


class SpikeCheck(SignalCheck):
    """Raises an alarm when an output had a spike, and withholds what may be one."""

    name = Spike.name
    can_be_false = True

    def __init__(self, config: MonitorConfig, board: Annunciator, ranges: Sequence[SignalRange]) -> None:
        super().__init__(config, board, ranges)
        self._alarms = [
            board.declare(self.name, name, without_on_delay=True, priority="low", names_cause=True, is_transient=True)
            for name in self.outputs
        ]
        self._spikes: list[Spike | None] = []
        self.limits = np.full(len(self.outputs), np.inf)
        """Limit of each output, within which a residual is no spike; infinite without a check."""
        self._none = (False,) * len(self.outputs)
        self._is_quiet = False
        self._quiet_limits: list[float] = []

    @property
    def state(self) -> list[Spike | None]:
        """A copy of the check of each output; None for an output without one; empty before the training ends."""
        return deepcopy(self._spikes)

    def restore(self, state: list[Spike | None]) -> None:
        """See `SignalCheck`."""
        self._spikes = deepcopy(state)
        self._set_limits()

    def learn_rates(self, counts: Sequence[int], rows: int, period_ns: float, arl0: float) -> None:
        """Learn how often spikes are usual; after `start`.

        Args:
            counts: number of outliers of each output in the training.
            rows: number of rows of the training.
            period_ns: sampling period.
            arl0: run length of each alarm without a fault, in rows.
        """
        for spike, count in zip(self._spikes, counts, strict=True):
            if spike is not None and count:
                spike.usual = SpikeRate.learn(count, rows, period_ns, arl0)

    def start(self, values: list[list[float]], e: list[list[float]], arl0: float) -> None:
        """See `SignalCheck`."""
        known = [[size for size in residuals if isfinite(size)] for residuals in e]
        self._spikes = [Spike(spike_limit(z, arl0)) if len(z) >= FEWEST_ROWS else None for z in known]
        self._set_limits()

    def relative_rates(self, learned: Sequence[Prewhitening], arl0: float, errors: TrainingErrors) -> Array:
        """See `SignalCheck`."""
        scales = np.column_stack([errors.true_scale(i, item, 1.0) for i, item in enumerate(learned)])
        shifts = scales * errors.mean / np.sqrt([float(item.rows) for item in learned])
        return np.column_stack(
            [arl0 * two_sided_tail(limit, shifts[:, i], scales[:, i]) for i, limit in enumerate(self.limits.tolist())]
        )

    def _set_limits(self) -> None:
        for index, spike in enumerate(self._spikes):
            self.limits[index] = np.inf if spike is None else spike.limit
        self._note_quiet()

    def _note_quiet(self) -> None:
        """Note that residuals within the limits would change nothing."""
        self._quiet_limits = self.limits.tolist()
        rules = [alarm.memory.rule for alarm in self._alarms]
        self._is_quiet = self.is_normal and not any(rule.standing or rule.recent for rule in rules)

    @property
    def is_normal(self) -> bool:
        """See `SignalCheck`."""
        return all(spike is None or spike.is_normal for spike in self._spikes)

    def on_residuals(
        self, time_ns: int, e: list[float], scales: list[float], units: list[str], publications: list[Publication]
    ) -> Flags:
        """See `SignalCheck`."""
        flags, is_moved = self._none, self.board.has_unexplained
        is_quiet = self._is_quiet and not is_moved
        if is_quiet and not any(abs(size) > limit for size, limit in zip(e, self._quiet_limits, strict=True)):
            return flags
        for index, spike in enumerate(self._spikes):
            if spike is None or not isfinite(e[index]):
                continue
            alarm, verdict = self._alarms[index], spike.update(e[index], is_moved=is_moved)
            if verdict.quarantine:
                flags = (*flags[:index], True, *flags[index + 1 :])
            rate, count = spike.usual, 1
            if verdict.spike and rate is not None:
                count = rate.add(time_ns)
            is_alarm = verdict.spike and count > 0
            if is_alarm or alarm.memory.rule.standing or alarm.memory.rule.recent:
                name = self.outputs[index]
                size = verdict.size if is_alarm else 0.0
                judgement = Judgement(size, 0.0, -spike.limit, spike.limit, is_alarm)
                spiked = format_quantity(size * scales[index], units[index], "+.3g")
                text = f"{name} had a spike of {spiked} one row before; it was left out"
                if rate is not None:
                    text += f"; {count} spikes in {rate.window_min:.3g} min, where {rate.usual:.2g} are usual"
                publications += self.judge(alarm, time_ns, judgement, "sd", text, name, cause=self.name)
        self._note_quiet()
        return flags

    def on_gap(self) -> None:
        """See `SignalCheck`."""
        for spike in self._spikes:
            if spike is not None:
                spike.restart()
