"""Silence: a plant, or one of its sensors, has stopped sending; the learned interval of samples and its limit.

There are two clocks. In sample time, a row later than allowed ends a timeout that was raised when the allowed time was
over. So a replay and a back-test find the same timeouts, raised and cleared at the same times, as the live monitor. But
without samples sample time stands still, and a live monitor must not wait for the plant's return to report its absence.
Then receive time decides. An alarm raised by it carries the sample time at which the next row, if there is one, will
find that it was raised.

The allowed time is learned for each clock separately, since a simulated plant may run sixty times as fast as its own
time: `limit` times the usual spacing, which is the mean spacing plus twice its mean deviation, both exponential means
over 32 samples, as in the retransmission timer of Jacobson (1988), Congestion avoidance and control, SIGCOMM. Evenly
spaced samples are allowed `limit` periods, irregular ones and bursts accordingly more. A timeout enters the mean as no
more than the allowed time, so that one does not spoil it; a plant that continues more slowly is learned after two or
three. In receive time at least `least_s` is allowed, for delays of networks and computers. Before MEMORY spacings
are known there is no timeout.

If the transport delayed samples and the plant never stopped, the next row clears the live alarm at the time at which it
was raised, and a replay, rightly, does not have it.

The timeout of the plant is restarted by every row and every received sample. That of a signal counts its values in the
rows, which continue with NaN after a sensor has failed. A gap in all rows is no fault of a single sensor; the signals'
timeouts are suppressed then, and only one alarm is raised.

A signal with fewer than MEMORY known spacings, or without any value, is measured by the plant's rows: its timeout
is 100 of their usual spacings.

>>> from math import nan
>>> timeout = DataTimeout(signals=1)
>>> [timeout.update(time_ns, [440.0]) for time_ns in range(0, 4000, 100)] == [[]] * 40
True
>>> timeout.update(7000, [440.0])  # nothing for 3100 ns, where 500 are allowed
[(0, Change(raised_ns=4400, cleared_ns=7000))]
>>> sum((timeout.update(time_ns, [nan]) for time_ns in range(7100, 8100, 100)), [])
[(1, Change(raised_ns=7500, cleared_ns=None))]
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from msgspec import field
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import Entry, jit, python_function
from reactorwatch.errors import InputError, positive
from reactorwatch.stored_state import Memory, Records

MEMORY = 32
"""Spacings in the exponential means, all of which must be known before a timeout."""


class Change(NamedTuple):
    """Change of a timeout.

    Attributes:
        raised_ns: sample time at which the allowed time was over; None: not raised now.
        cleared_ns: time of the sample that ended the timeout, at least `raised_ns`; None: not cleared now.
    """

    raised_ns: int | None
    cleared_ns: int | None


NO_CHANGE = Change(None, None)

SPACING = np.dtype([("mean_ns", "f8"), ("deviation_ns", "f8"), ("count", "i8")], align=True)
"""Numbers of a spacing, see `Spacing`."""


@jit
def learn_spacing(s: Any, spacing_ns: float, memory: int) -> None:
    """Update exponential means, over `memory` spacings, with a spacing."""
    s.count = min(s.count + 1, memory)
    deviation = spacing_ns - s.mean_ns
    s.mean_ns += deviation / s.count
    if s.count > 1:
        s.deviation_ns += (abs(deviation) - s.deviation_ns) / s.count


_LEARN = python_function(learn_spacing)


class Spacing(Memory):
    """Usual spacing of samples, by exponential means; the object is its own state.

    Attributes:
        count: number of spacings in the means, up to their memory.
        mean_ns: exponential mean of the spacings.
        deviation_ns: exponential mean of their absolute deviations.
    """

    count: int = 0
    mean_ns: float = 0.0
    deviation_ns: float = 0.0

    def learn(self, spacing_ns: float, memory: int) -> None:
        """Update the means, over `memory` spacings, with a spacing."""
        _LEARN(self, spacing_ns, memory)


NO_TIME_NS = -(2**63)
"""Stands for no time."""

LONGEST_NS = 2**62 - 1
"""Longest allowed time: its sum with a time fits into 64 bits."""

TIMEOUT = np.dtype([("spacing", SPACING), ("last_ns", "i8"), ("is_active", "i8")], align=True)
"""Numbers of a timeout in sample time: spacing, time of the last sample or `NO_TIME_NS`, 1 if it is active."""


@jit
def allowed_ns(s: Any, limit: float) -> int:
    """`limit` times the usual spacing; -1 before it is known."""
    if s.count < MEMORY:
        return -1
    return int(min(limit * (s.mean_ns + 2.0 * s.deviation_ns), float(LONGEST_NS)))


@jit
def update_timeout(p: Any, time_ns: int, present: bool, limit: float, fallback_ns: int) -> tuple[int, int, int]:
    """Update with a row, see `_update`.

    Args:
        p: numbers of the timeout.
        time_ns: time of the row.
        present: True if the signal has a value in it.
        limit: allowed time, in usual spacings.
        fallback_ns: allowed time while the usual spacing is unknown; -1: unlimited.

    Returns:
        1 if the timeout was raised plus 2 if it was cleared; time at which the allowed time was over; time of the
        sample that cleared it.
    """
    last_ns = p.last_ns
    if last_ns == NO_TIME_NS or time_ns <= last_ns:
        p.last_ns = time_ns
        if not (present and p.is_active):
            return 0, 0, 0
        p.is_active = 0
        return 2, 0, time_ns
    spacing_ns, allowed = time_ns - last_ns, allowed_ns(p.spacing, limit)
    if allowed < 0 and fallback_ns >= 0:
        allowed = max(fallback_ns, int(min(limit * p.spacing.mean_ns, float(LONGEST_NS))))
    change, raised_ns = 0, 0
    if 0 <= allowed < spacing_ns and not p.is_active:
        p.is_active, change, raised_ns = 1, 1, last_ns + allowed
    if not present:
        return change, raised_ns, 0
    learn_spacing(p.spacing, float(spacing_ns if allowed < 0 else min(spacing_ns, allowed)), MEMORY)
    p.last_ns = time_ns
    if not p.is_active:
        return change, raised_ns, 0
    p.is_active = 0
    return change + 2, raised_ns, max(time_ns, last_ns + max(allowed, 0))


@jit
def _update(numbers: Any, time_ns: int, values: Array, limit: float, changes: NDArray[np.int64]) -> bool:
    """Update the timeouts of a plant and of its signals; writes the results of `update_timeout`; True if one changed.

    Args:
        numbers: numbers of the timeouts, the plant's first.
        time_ns: time of the row.
        values: value of each signal; NaN where missing.
        limit: allowed time, in usual spacings.
        changes: results, shape (1 + signals, 3).
    """
    plant, fallback_ns = numbers[0], -1
    changes[0, 0], changes[0, 1], changes[0, 2] = update_timeout(plant, time_ns, True, limit, -1)
    found = bool(changes[0, 0])
    if not np.isfinite(values).all():
        fallback_ns = allowed_ns(plant.spacing, max(100.0, limit))  # an analyser may give one value in fifty rows
    for i in range(values.size):
        p = numbers[i + 1]
        if changes[0, 0] and not p.is_active:  # until now all signals had no data, not only this one
            p.last_ns = time_ns
        change, raised_ns, cleared_ns = update_timeout(p, time_ns, np.isfinite(values[i]), limit, fallback_ns)
        changes[i + 1, 0], changes[i + 1, 1], changes[i + 1, 2] = change, raised_ns, cleared_ns
        found = found or change > 0
    return found


@jit
def _limit_ns(numbers: Any, limit: float) -> int:
    return allowed_ns(numbers[0].spacing, limit)


_UPDATE, _ALLOWED, _ALLOWED_NS = Entry(_update), Entry(_limit_ns), python_function(allowed_ns)


class TimeoutMemory(Memory):
    """Memory of timeouts.

    Attributes:
        numbers: numbers in sample time of the plant, then of each signal, see `TIMEOUT`.
        receipts: usual spacing of the plant's samples in receive time.
    """

    numbers: Records
    receipts: Spacing = field(default_factory=Spacing)


class DataTimeout:
    """Timeouts of a plant's samples, and of those of each signal.

    Args:
        signals: number of signals.
        limit: allowed time without a sample, in usual spacings.
        least_s: least allowed receive time without a sample, in seconds.

    Attributes:
        memory: what is stored; another one may be put in its place.
        received_ns: receive time of the last sample; None before the first. A monitor that was down received nothing.
        counted_ns: receive time of the sample from which the next spacing counts; None before the first.

    Raises:
        InputError: limit is not a number above 1, or least_s not a positive one.
    """

    def __init__(self, signals: int = 0, limit: float = 5.0, least_s: float = 5.0) -> None:
        if not 1.0 < limit < float("inf"):
            raise InputError(f"limit must be a number of periods above 1, got {limit}")
        self._limit, self._least_ns = float(limit), int(positive("least_s", least_s) * 1e9)
        numbers = np.zeros(1 + signals, TIMEOUT)
        numbers["last_ns"] = NO_TIME_NS
        self.memory = TimeoutMemory(numbers)
        self._changes = np.zeros((1 + signals, 3), np.int64)
        self.received_ns: int | None = None
        self.counted_ns: int | None = None

    @property
    def is_active(self) -> bool:
        """True if the timeout of the plant is active."""
        return bool(self.memory.numbers["is_active"][0])

    # --- sample time -----------------------------------------------------------------------------------------

    def update(self, time_ns: int, values: Sequence[float]) -> list[tuple[int, Change]]:
        """Update with a row; returns the changes with the index of each in the memory: 0 for the plant.

        A row that is not later than the last sample means that the plant's clock was set back: spacings count from this
        row on.

        Args:
            time_ns: time of the row.
            values: value of each signal; NaN where missing.
        """
        row = np.array(values, dtype=np.float64)
        if not _UPDATE.call(self.memory.numbers, time_ns, row, self._limit, self._changes):
            return []
        return [
            (i, Change(raised_ns if change & 1 else None, cleared_ns if change & 2 else None))
            for i, (change, raised_ns, cleared_ns) in enumerate(self._changes.tolist())
            if change
        ]

    def deadline_ns(self) -> int | None:
        """Deadline of the next row; None before the spacing is known."""
        numbers = self.memory.numbers
        last_ns, allowed = int(numbers["last_ns"][0]), _ALLOWED.call(numbers, self._limit)
        return None if last_ns == NO_TIME_NS or allowed < 0 else last_ns + allowed

    # --- receive time ----------------------------------------------------------------------------------------

    def arm(self, now_ns: int) -> None:
        """Restart the timer after a stop; the time to the next sample is no spacing."""
        self.received_ns, self.counted_ns = now_ns, None

    def on_receipt(self, now_ns: int) -> None:
        """Restart the timer: a sample was received. A step back of the clock is no spacing, nor is one in a burst.

        A sample sooner than an eighth of the mean spacing belongs to a burst: after a partition, or a stall of this
        process, all delayed samples arrive at once.
        """
        before_ns, self.received_ns = self.counted_ns, now_ns
        if before_ns is None or now_ns < before_ns:
            self.counted_ns = now_ns
        elif self.memory.receipts.count < MEMORY or now_ns - before_ns >= 0.125 * self.memory.receipts.mean_ns:
            self.counted_ns = now_ns
            allowed = self._timeout_ns()
            spacing_ns = now_ns - before_ns
            self.memory.receipts.learn(float(spacing_ns if allowed is None else min(spacing_ns, allowed)), MEMORY)

    def due_ns(self) -> int | None:
        """Time to `check`, unless a sample arrives before; None: no timeout is set."""
        timeout, received_ns = self._timeout_ns(), self.received_ns
        if received_ns is None or timeout is None or self.is_active or self.deadline_ns() is None:
            return None
        return received_ns + timeout

    def check(self, now_ns: int) -> Change:
        """Check the timeout in receive time.

        A check much later than due means that the monitor was stalled, or its clock was set. Samples may still be on
        their way, so the timer is restarted.

        Args:
            now_ns: present time, on the clock of `on_receipt`.
        """
        due_ns = self.due_ns()
        if due_ns is None or now_ns < due_ns:
            return NO_CHANGE
        if now_ns - due_ns > 1_000_000_000:  # the monitor was stalled for a second
            self.arm(now_ns)
            return NO_CHANGE
        return self.declare_timeout()

    def declare_timeout(self) -> Change:
        """Make the timeout of the plant active."""
        deadline_ns = self.deadline_ns()
        if self.is_active or deadline_ns is None:
            return NO_CHANGE
        self.memory.numbers["is_active"][0] = True
        return Change(deadline_ns, None)

    def _timeout_ns(self) -> int | None:
        """Allowed receive time without a sample; None before it is known."""
        allowed = _ALLOWED_NS(self.memory.receipts, self._limit)
        return None if allowed < 0 else max(allowed, self._least_ns)
