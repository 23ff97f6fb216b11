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
with a margin of three standard errors (but no less than before), and nothing is a spike before there are 10
of them.

Every spike has its own value beyond the limit, so the rate of false spikes is never more than P(|z| > limit); that
bound holds for dependent values as well. Where tails are heavier than normal, `spike_limit` learns a limit from the
training: the largest |z| are taken to exceed their threshold by an exponential excess (Pickands 1975, Statistical
inference using extreme order statistics, Annals of Statistics 3(1), with shape 0), whose mean is estimated with its
largest quarter known only as larger (Epstein & Sobel 1953, Life testing, Journal of the American Statistical
Association 48), and given one standard error on top. So up to one value in a hundred may be a spike in the training,
whatever its size, and hardly moves the limit; if more are, that is how this signal is, and the limit rises until they
are none. For tails heavier than exponential there are more false spikes than promised; but isolated far values are then
what the signal has.

A sensor may have outliers at a steady rate as long as it is sound: only a change of it is an alarm (`SpikeRate`). Of n
in the N rows of a training the rate is gamma distributed, and the number in the next R rows negative binomial,

    rate ~ Gamma(n + 1, N),    count ~ NB(n + 1, N / (N + R))

(Hahn & Meeker 1991, Statistical Intervals, ch. 7). A spike is then an alarm if there have been so many in the last R
rows that chance has as many no more often than once in `arl0` rows. A signal without outliers in its training has an
alarm at each.
"""

from collections.abc import Sequence
from math import ceil, isfinite, log, sqrt
from statistics import median
from typing import Literal, NamedTuple, TypeAlias

import msgspec
import numpy as np
from msgspec import field
from numpy.typing import ArrayLike
from scipy.special import nbdtrc, ndtri

from reactorwatch.errors import InputError, positive
from reactorwatch.spc.charts.base import LARGEST_VALUE, finite
from reactorwatch.stored_state import Memory

FEWEST_ROWS = 50
"""Fewest residuals of a training: a fifth of them is then its tail, ten values."""

RATE_SHARE = 0.5
"""Length of the window in which spikes are counted, in lengths of the training."""

Phase: TypeAlias = Literal["ordinary", "quarantined", "quarantined again", "changed"]


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


class SpikeRate(msgspec.Struct, array_like=True):
    """Decides which spike is an alarm; the object is its own state.

    Attributes:
        outliers: number of outliers in the training.
        window_ns: length of the window in which spikes are counted.
        limit: number of spikes in the window that is an alarm.
        recent_ns: times of the newest spikes in the window, oldest first.
    """

    outliers: int
    window_ns: int
    limit: int
    recent_ns: list[int]

    @classmethod
    def learn(cls, count: int, rows: int, period_ns: float, arl0: float) -> "SpikeRate":
        """Learn from a training.

        Args:
            count: number of outliers in it.
            rows: number of its rows.
            period_ns: sampling period.
            arl0: least mean number of rows between two false alarms.
        """
        window = max(int(RATE_SHARE * rows), 1)
        return cls(count, round(window * period_ns), spike_count_limit(count, rows, window, arl0), [])

    @property
    def usual(self) -> float:
        """Number of spikes that are usual in the window."""
        return RATE_SHARE * self.outliers

    @property
    def window_min(self) -> float:
        """Length of the window in minutes."""
        return self.window_ns / 60e9

    def add(self, time_ns: int) -> int:
        """Count a spike; returns the number in the window if it is an alarm, else 0."""
        recent = self.recent_ns
        recent.append(time_ns)
        while time_ns - recent[0] > self.window_ns or recent[0] > time_ns:
            del recent[0]
        if len(recent) < self.limit:
            return 0
        count = len(recent)
        recent.clear()
        return count


class Spike(Memory):
    """Distinguishes spikes from changes in the standardised residuals of one signal; the object is its own state.

    >>> spike = Spike(limit=6.0)
    >>> [spike.update(z) for z in (0.3, 9.0, -0.5)][1:]
    [Verdict(quarantine=True, spike=False, size=0.0), Verdict(quarantine=False, spike=True, size=9.0)]
    >>> [spike.update(z).quarantine for z in (9.0, 9.0, 9.0)]  # a change
    [True, False, False]

    Attributes:
        limit: limit in standard deviations, beyond which a value may be a spike.
        phase: the value before was ordinary, is quarantined, is quarantined after a spike, or was part of a
            change.
        quarantined: quarantined value; 0 if there is none.
        recent: newest values since an alarm is active, oldest first; empty without one.
        usual: spikes at a steady rate; None: there were none in the training.

    Raises:
        InputError: limit is not a positive number.
        ValueError: a value is not finite.
    """

    limit: float
    phase: Phase = "ordinary"
    quarantined: float = 0.0
    recent: list[float] = field(default_factory=list)
    usual: SpikeRate | None = None

    def __post_init__(self) -> None:
        positive("limit", self.limit)
        for z in (self.quarantined, *self.recent):
            finite(z)

    @property
    def is_ordinary(self) -> bool:
        """True if a value within the limit would change nothing."""
        return self.phase == "ordinary" and not self.recent

    def update(self, z: float, *, is_moved: bool = False) -> Verdict:
        """Update with the next standardised residual; leave missing ones out.

        Args:
            z: the residual.
            is_moved: True if an alarm is active, so that a fault may have moved the residual.

        Raises:
            ValueError: the residual is not finite.
        """
        recent = self.recent
        if not is_moved:
            if recent:
                recent.clear()
            return self._decide(z)
        level, spread, is_decided = 0.0, 1.0, recent or self.phase in ("ordinary", "changed")
        if len(recent) >= 10:  # their median is then known
            level = median(recent)
            deviation = median(abs(value - level) for value in recent)
            # 1.4826: from the median absolute deviation to the standard one; its error is about 1 / sqrt(n).
            spread = max(1.0, (1.0 + 3.0 / sqrt(len(recent))) * 1.4826 * deviation)
        elif is_decided:
            self._remember(finite(z))
            self.phase, self.quarantined = "changed", 0.0
            return NO_SPIKE
        verdict = self._decide((finite(z) - level) / spread)
        if not verdict.quarantine:
            self._remember(z)
        return verdict._replace(size=verdict.size * spread)

    def _remember(self, z: float) -> None:
        self.recent.append(z)
        del self.recent[:-100]

    def _decide(self, z: float) -> Verdict:
        """Decide on a residual about 0."""
        if self.phase == "ordinary" and abs(z) <= self.limit:  # as nearly always
            return NO_SPIKE
        if not abs(z) < LARGEST_VALUE:
            finite(z)
        beyond, normal = abs(z) > self.limit, abs(z) <= 0.5 * self.limit
        before, self.quarantined = self.quarantined, 0.0
        if self.phase in ("ordinary", "changed"):
            if self.phase == "changed" and not normal:
                return NO_SPIKE
            self.phase = "quarantined" if beyond else "ordinary"
            self.quarantined = z if beyond else 0.0
            return Verdict(beyond, False, 0.0)
        if not normal and (self.phase == "quarantined again" or z * before > 0.0):
            self.phase = "changed"
            return NO_SPIKE
        self.phase = "quarantined again" if beyond else "ordinary"
        self.quarantined = z if beyond else 0.0
        return Verdict(beyond, True, before)

    def restart(self) -> None:
        """Drop earlier values, as after a gap or a restart of the plant: a quarantined value stays undecided."""
        self.phase, self.quarantined = "ordinary", 0.0
        self.recent.clear()


class Spikes(Memory):
    """Spikes of the outputs of a plant; the object is its own state.

    Attributes:
        of_outputs: method for each output; None for an output without one; empty before the training ends.
    """

    of_outputs: list[Spike | None] = field(default_factory=list)

    def learn(self, e: Sequence[Sequence[float]], outliers: Sequence[int], period_ns: float, arl0: float) -> None:
        """Learn from a training; an output with too few residuals has no method.

        Args:
            e: standardised residuals of each output in order of time; NaN where there is none.
            outliers: number of outliers of each output.
            period_ns: sampling period.
            arl0: least mean number of rows between two false alarms of an output.
        """
        self.of_outputs = []
        for residuals, count in zip(e, outliers, strict=True):
            z = [size for size in residuals if isfinite(size)]
            spike = Spike(spike_limit(z, arl0)) if len(z) >= FEWEST_ROWS else None
            if spike is not None and count:
                spike.usual = SpikeRate.learn(count, len(residuals), period_ns, arl0)
            self.of_outputs.append(spike)

    @property
    def is_ordinary(self) -> bool:
        """True if values within their limits would change nothing."""
        return all(spike is None or spike.is_ordinary for spike in self.of_outputs)

    def update(self, z: Sequence[float], *, is_moved: bool) -> list[Verdict]:
        """Update with a row: a standardised residual of each output, NaN where missing; see `Spike.update`."""
        return [
            NO_SPIKE if spike is None or size != size else spike.update(size, is_moved=is_moved)
            for spike, size in zip(self.of_outputs, z, strict=True)
        ]

    def restart(self) -> None:
        """Drop earlier rows, see `Spike.restart`."""
        for spike in self.of_outputs:
            if spike is not None:
                spike.restart()


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
    tail = max(ceil(0.05 * sizes.size), FEWEST_ROWS // 5)
    threshold = float(sizes[-tail - 1])
    seen = int(0.75 * tail)
    excess = sizes[-tail:][:seen] - threshold
    scale = float(excess.sum() + (tail - seen) * excess[-1]) / seen
    learned = threshold + scale * (1.0 + 1.0 / sqrt(seen)) * max(0.0, log(arl0 * tail / sizes.size))
    return max(float(-ndtri(0.5 / arl0)), learned)


def spike_count_limit(count: int, rows: int, window: int, arl0: float) -> int:
    """Number of spikes in a window that chance has at most once in `arl0` rows.

    >>> [spike_count_limit(count, 1000, 500, 3e6) for count in (0, 1, 5, 20)]
    [1, 11, 18, 34]

    Args:
        count: number of outliers in the training.
        rows: number of rows of the training.
        window: length of the window in rows.
        arl0: least mean number of rows between two false alarms.
    """
    if not count:
        return 1
    rate, share = (count + 1) / rows, rows / (rows + window)
    most = 10_000
    for others in range(most):
        # nbdtrc(k, n, p): probability of more than k
        if rate * (float(nbdtrc(others - 1, count + 1, share)) if others else 1.0) <= 1.0 / arl0:
            return others + 1
    return most
