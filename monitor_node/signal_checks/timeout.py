"""No data: a plant, or one of its sensors, has stopped sending.

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
three. In receive time at least `least_s` is allowed, for delays of networks and computers. Before `LEARN_FROM` spacings
are known there is no timeout.

If the transport delayed samples and the plant never stopped, the next row clears the live alarm at the time at which it
was raised, and a replay, rightly, does not have it.

One `DataTimeout` is for the plant: every row and every received sample restarts it. One more for each signal counts its
values in the rows, which continue with NaN after a sensor has failed. A gap in all rows is no fault of a single sensor;
these timeouts are suppressed then, and only one alarm is raised.

A signal with fewer than `LEARN_FROM` known spacings, or without any value, is measured by the plant's rows: its timeout
is `UNKNOWN_ROWS` of their usual spacings.

>>> from math import isnan, nan
>>> plant, sensor = DataTimeout(), DataTimeout()
>>> def on_row(time_ns: int, T: float) -> list[tuple[str, Change]]:
...     changes = [("plant", plant.update(time_ns, present=True))]
...     if changes[0][1] != NO_CHANGE:
...         sensor.suppress_until(time_ns)
...     changes.append(("T", sensor.update(time_ns, present=not isnan(T))))
...     return [(name, change) for name, change in changes if change != NO_CHANGE]
>>> [on_row(time_ns, 440.0) for time_ns in range(0, 4000, 100)] == [[]] * 40
True
>>> on_row(7000, 440.0)  # nothing for 3100 ns, where 500 are allowed
[('plant', Change(raised_ns=4400, cleared_ns=7000))]
>>> sum((on_row(time_ns, nan) for time_ns in range(7100, 8100, 100)), [])
[('T', Change(raised_ns=7500, cleared_ns=None))]
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.baseline.signal_range import SignalRange
from monitor_node.config import MonitorConfig
from monitor_node.ingest.sampling import SPACING, Spacing, learn_spacing
from monitor_node.signal_checks.base import PLANT, SignalCheck
from reactorwatch.codegen.numba_kernel import Entry, jit
from reactorwatch.contract.codec import Publication
from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import Judgement, positive
from reactorwatch.stored_state import StoredState

LEARN_FROM = 32
"""Spacings that must be known before a timeout."""

MEMORY = 32
"""Spacings in the exponential means."""

UNKNOWN_ROWS = 100.0
"""Usual spacings of the plant's rows within which every signal must have a value. An analyser may give one value in
fifty rows; a signal without a value in these is not published, or its sensor has failed."""

DEVIATIONS = 2.0
"""Mean deviations between the mean and the usual spacing."""

BURST = 0.125
"""Share of the mean spacing: a sooner sample belongs to a burst. After a partition, or a stall of this process,
all delayed samples arrive at once, and their spacing is not learned."""

LATE_NS = 1_000_000_000
"""If the check itself runs this late, the monitor was stalled; restart the timer instead of raising the alarm."""


class Change(NamedTuple):
    """Change of a timeout.

    Attributes:
        raised_ns: sample time at which the allowed time was over; None: not raised now.
        cleared_ns: time of the sample that ended the timeout, at least `raised_ns`; None: not cleared now.
    """

    raised_ns: int | None
    cleared_ns: int | None


NO_CHANGE = Change(None, None)
"""Returned, the object itself, if nothing changes."""


Numbers: TypeAlias = NDArray[np.void]

NO_TIME_NS = -(2**63)
"""Stands for no time."""

LONGEST_NS = 2**62 - 1
"""Longest allowed time: its sum with a time fits into 64 bits."""

TIMEOUT = np.dtype([("spacing", SPACING), ("last_ns", "i8"), ("is_active", "i8")], align=True)
"""Numbers of a timeout in sample time: spacing, time of the last sample or `NO_TIME_NS`, 1 if it is active."""

RECEIPTS = np.dtype([("spacing", SPACING), ("received_ns", "i8"), ("counted_ns", "i8")], align=True)
"""Numbers of a timeout in receive time: spacing, time of the last sample, and of the one from which the next spacing
counts; `NO_TIME_NS` before them."""


@jit
def usual_ns(s: Any) -> float:
    """Usual spacing; -1 before it is known."""
    return -1.0 if s.count < LEARN_FROM else float(s.mean_ns + DEVIATIONS * s.deviation_ns)


@jit
def allowed_ns(s: Any, limit: float) -> int:
    """`limit` times the usual spacing; -1 before it is known."""
    usual = usual_ns(s)
    return -1 if usual < 0.0 else int(min(limit * usual, float(LONGEST_NS)))


@jit
def update_timeout(p: Any, time_ns: int, present: bool, limit: float, fallback_ns: int) -> tuple[int, int, int]:
    """Update with a row, see `DataTimeout.update`.

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
def timeout_ns(r: Any, limit: float, least_ns: int) -> int:
    """Allowed receive time without a sample; -1 before it is known."""
    allowed = allowed_ns(r.spacing, limit)
    return allowed if allowed < 0 else max(allowed, least_ns)


@jit
def receive(r: Any, now_ns: int, limit: float, least_ns: int) -> None:
    """Note a received sample. A step back of the clock is no spacing, nor is one in a burst."""
    before_ns, r.received_ns = r.counted_ns, now_ns
    if before_ns == NO_TIME_NS or now_ns < before_ns:
        r.counted_ns = now_ns
    elif r.spacing.count < MEMORY or float(now_ns - before_ns) >= BURST * r.spacing.mean_ns:
        r.counted_ns = now_ns
        spacing_ns, allowed = now_ns - before_ns, timeout_ns(r, limit, least_ns)
        learn_spacing(r.spacing, float(min(spacing_ns, allowed) if allowed >= 0 else spacing_ns), MEMORY)


@jit
def _update(numbers: Any, time_ns: int, present: bool, limit: float, fallback_ns: int) -> tuple[int, int, int]:
    return update_timeout(numbers[0], time_ns, present, limit, fallback_ns)


@jit
def _allowed_ns(numbers: Any, limit: float) -> int:
    return allowed_ns(numbers[0].spacing, limit)


@jit
def _timeout(receipts: Any, limit: float, least_ns: int) -> int:
    return timeout_ns(receipts[0], limit, least_ns)


@jit
def _receive(receipts: Any, now_ns: int, limit: float, least_ns: int) -> None:
    receive(receipts[0], now_ns, limit, least_ns)


_UPDATE, _ALLOWED, _TIMEOUT, _RECEIVE = Entry(_update), Entry(_allowed_ns), Entry(_timeout), Entry(_receive)


class DataTimeoutState(StoredState, frozen=True):
    """State of a timeout, without the last receive time: a monitor that was down received nothing.

    Attributes:
        limit: see `DataTimeout`.
        least_s: see `DataTimeout`.
        rows: spacing in sample time.
        receipts: spacing in receive time.
        last_ns: time of the last sample with a value; None before the first.
        standing: True if the timeout is active.
    """

    limit: float
    least_s: float
    rows: Spacing
    receipts: Spacing
    last_ns: int | None
    standing: bool


class DataTimeout:
    """Timeout of a plant's or a signal's samples.

    Args:
        limit: allowed time without a sample, in usual spacings.
        least_s: least allowed receive time without a sample, in seconds.
        numbers: numbers in sample time, shape (1,), as a view of those of a plant; None: its own.
        receipts: numbers in receive time, shape (1,); None: its own.

    Raises:
        InputError: limit is not a number above 1, or least_s not a positive one.
    """

    name = "silence"

    def __init__(
        self, limit: float = 5.0, least_s: float = 5.0, numbers: Numbers | None = None, receipts: Numbers | None = None
    ) -> None:
        if not 1.0 < limit < float("inf"):
            raise InputError(f"limit must be a number of periods above 1, got {limit}")
        self._limit, self._least_s = float(limit), positive("least_s", least_s)
        self._least_ns = int(self._least_s * 1e9)
        self.numbers = no_timeouts(1) if numbers is None else numbers
        self.receipts = no_receipts() if receipts is None else receipts

    @classmethod
    def from_state(cls, state: DataTimeoutState, numbers: Numbers | None = None) -> "DataTimeout":
        """Resume from a state."""
        timeout = cls(state.limit, state.least_s, numbers)
        timeout.numbers[0] = (
            state.rows.numbers,
            NO_TIME_NS if state.last_ns is None else state.last_ns,
            state.standing,
        )
        timeout.receipts["spacing"] = state.receipts.numbers
        return timeout

    @property
    def state(self) -> DataTimeoutState:
        """A copy of the state."""
        rows, receipts = Spacing.of_numbers(self.numbers["spacing"][0]), Spacing.of_numbers(self.receipts["spacing"][0])
        return DataTimeoutState(self._limit, self._least_s, rows, receipts, self._last_ns, self.standing)

    @property
    def standing(self) -> bool:
        """True if the timeout is active."""
        return bool(self.numbers["is_active"][0])

    @standing.setter
    def standing(self, standing: bool) -> None:
        self.numbers["is_active"] = standing

    @property
    def _last_ns(self) -> int | None:
        """Time of the last sample with a value; None before the first."""
        return _time(self.numbers["last_ns"])

    # --- sample time -----------------------------------------------------------------------------------------

    def fallback_allowed_ns(self) -> int | None:
        """Allowed time of a signal whose own spacing is unknown, by this plant's rows; None if that is unknown."""
        allowed: int = _ALLOWED.call(self.numbers, max(UNKNOWN_ROWS, self._limit))
        return None if allowed < 0 else allowed

    def update(self, time_ns: int, *, present: bool, fallback_allowed_ns: int | None = None) -> Change:
        """Update with a row.

        A row that is not later than the last sample means that the plant's clock was set back: spacings count from this
        row on.

        Args:
            time_ns: time of the row.
            present: True if the signal has a value in it.
            fallback_allowed_ns: allowed time while the signal's own spacing is unknown; None: unlimited.
        """
        fallback_ns = -1 if fallback_allowed_ns is None else fallback_allowed_ns
        change, raised_ns, cleared_ns = _UPDATE.call(self.numbers, time_ns, present, self._limit, fallback_ns)
        if not change:
            return NO_CHANGE
        return Change(raised_ns if change & 1 else None, cleared_ns if change & 2 else None)

    def suppress_until(self, time_ns: int) -> None:
        """Restart the timer: until now all signals had no data, not only this one."""
        if not self.standing:
            self.numbers["last_ns"] = time_ns

    # --- receive time ----------------------------------------------------------------------------------------

    def arm(self, now_ns: int) -> None:
        """Restart the timer after a stop; the time to the next sample is no spacing."""
        self.receipts_ns = now_ns, None

    @property
    def receipts_ns(self) -> tuple[int | None, int | None]:
        """Receive time of the last sample, and of the one from which the next spacing counts; None before the first."""
        return _time(self.receipts["received_ns"]), _time(self.receipts["counted_ns"])

    @receipts_ns.setter
    def receipts_ns(self, receipts_ns: tuple[int | None, int | None]) -> None:
        received_ns, counted_ns = receipts_ns
        self.receipts["received_ns"] = NO_TIME_NS if received_ns is None else received_ns
        self.receipts["counted_ns"] = NO_TIME_NS if counted_ns is None else counted_ns

    def on_receipt(self, now_ns: int) -> None:
        """Restart the timer: a sample was received."""
        _RECEIVE.call(self.receipts, now_ns, self._limit, self._least_ns)

    def due_ns(self) -> int | None:
        """Time to `check`, unless a sample arrives before; None: no timeout is set."""
        timeout: int = _TIMEOUT.call(self.receipts, self._limit, self._least_ns)
        received_ns = _time(self.receipts["received_ns"])
        if received_ns is None or timeout < 0 or self.standing or self.deadline_ns() is None:
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
        if now_ns - due_ns > LATE_NS:
            self.arm(now_ns)
            return NO_CHANGE
        return self.declare_timeout()

    def declare_timeout(self) -> Change:
        """Make the timeout active."""
        if self.standing or self.deadline_ns() is None:
            return NO_CHANGE
        self.standing = True
        return Change(self.deadline_ns(), None)

    def deadline_ns(self) -> int | None:
        """Deadline of the next row in sample time; None before the spacing is known."""
        last_ns, allowed = self._last_ns, _ALLOWED.call(self.numbers, self._limit)
        return None if last_ns is None or allowed < 0 else last_ns + allowed


def no_timeouts(count: int) -> Numbers:
    """Numbers of timeouts before the first sample, shape (count,)."""
    numbers = np.zeros(count, TIMEOUT)
    numbers["last_ns"] = NO_TIME_NS
    return numbers


def no_receipts() -> Numbers:
    """Numbers of a timeout in receive time before the first sample, shape (1,)."""
    receipts = np.zeros(1, RECEIPTS)
    receipts["received_ns"] = receipts["counted_ns"] = NO_TIME_NS
    return receipts


def _time(field: NDArray[np.int64]) -> int | None:
    time_ns = int(field[0])
    return None if time_ns == NO_TIME_NS else time_ns


class SilenceCheck(SignalCheck):
    """Raises an alarm when the plant, or one of its signals, is silent."""

    name = DataTimeout.name

    def __init__(self, config: MonitorConfig, board: Annunciator, ranges: Sequence[SignalRange]) -> None:
        super().__init__(config, board, ranges)
        self._names = (PLANT, *config.signals)
        self.numbers = no_timeouts(len(self._names))
        self._silences = [
            DataTimeout(config.silence_periods, numbers=self.numbers[i : i + 1]) for i in range(len(self._names))
        ]
        self._alarms = [
            board.declare(
                self.name, name, without_on_delay=True, without_off_delay=True, priority="high", names_cause=True
            )
            for name in self._names
        ]

    @property
    def of_plant(self) -> DataTimeout:
        """The silence of all signals together."""
        return self._silences[0]

    @property
    def silent(self) -> list[bool]:
        """Flags of the signals without data, the inputs first."""
        return [silence.standing for silence in self._silences[1:]]

    @property
    def state(self) -> list[DataTimeoutState]:
        """State of the plant, of each input and of each output."""
        return [silence.state for silence in self._silences]

    def restore(self, state: list[DataTimeoutState]) -> None:
        """See `SignalCheck`."""
        self._silences = [DataTimeout.from_state(item, self.numbers[i : i + 1]) for i, item in enumerate(state)]

    @property
    def is_normal(self) -> bool:
        """See `SignalCheck`: the newest row has all signals, and no timeout is active."""
        times_ns = self.numbers["last_ns"]
        return not self.numbers["is_active"].any() and bool((times_ns == times_ns[0]).all())

    def use(self, numbers: Numbers) -> None:
        """Keep the numbers in an array of the plant from now on."""
        numbers[:] = self.numbers
        self.numbers = numbers
        for i, silence in enumerate(self._silences):
            silence.numbers = numbers[i : i + 1]

    def arm(self, now_ns: int) -> None:
        """Wait, after a stop, for the plant's next sample."""
        self.of_plant.arm(now_ns)

    def resume_from_alarms(self) -> None:
        """Take as silent what the alarms say is silent: the next sample ends it."""
        for silence, alarm in zip(self._silences, self._alarms, strict=True):
            silence.standing = alarm.memory.rule.standing

    def on_row(self, time_ns: int, values: tuple[float, ...]) -> list[Publication]:
        """See `SignalCheck`."""
        silences = self._silences
        publications: list[Publication] = []
        change = silences[0].update(time_ns, present=True)
        if change is not NO_CHANGE:
            publications += self.publish(0, change)
            for silence in silences[1:]:
                silence.suppress_until(time_ns)
        is_complete = all(value == value for value in values)  # NaN is not equal to itself
        unknown_ns = None if is_complete else silences[0].fallback_allowed_ns()
        for index, value in enumerate(values, start=1):
            change = silences[index].update(time_ns, present=value == value, fallback_allowed_ns=unknown_ns)
            if change is not NO_CHANGE:
                publications += self.publish(index, change)
        return publications

    def check(self, now_ns: int) -> list[Publication]:
        """Check the plant's timeout in receive time."""
        return self.publish(0, self.of_plant.check(now_ns))

    def declare_timeout(self) -> list[Publication]:
        """Declare a timeout of the plant that was recorded, where the receive time expired it."""
        return self.publish(0, self.of_plant.declare_timeout())

    def publish(self, index: int, change: Change) -> list[Publication]:
        """The alarm of the plant (index 0) or of a signal, if it changes."""
        name, alarm = self._names[index], self._alarms[index]
        publications: list[Publication] = []
        if change.raised_ns is not None:
            text = "the plant is silent: no sample of it comes" if index == 0 else f"{name} is silent: the others go on"
            raised = Judgement(1.0, 0.0, 0.0, 0.0, True)
            publications += self.judge(alarm, change.raised_ns, raised, "", text, name, cause=self.name)
        if change.cleared_ns is not None:
            over = Judgement(0.0, 0.0, 0.0, 0.0, False)
            publications += self.judge(alarm, change.cleared_ns, over, "", "", name, cause=self.name)
        return publications
