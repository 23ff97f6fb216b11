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
from typing import NamedTuple

import msgspec

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.baseline.signal_range import SignalRange
from monitor_node.config import MonitorConfig
from monitor_node.ingest.sampling import Spacing
from monitor_node.signal_checks.base import PLANT, SignalCheck
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

    Attributes:
        standing: True if the timeout is active.

    Raises:
        InputError: limit is not a number above 1, or least_s not a positive one.
    """

    name = "silence"

    def __init__(self, limit: float = 5.0, least_s: float = 5.0) -> None:
        if not 1.0 < limit < float("inf"):
            raise InputError(f"limit must be a number of periods above 1, got {limit}")
        self._limit, self._least_s = float(limit), positive("least_s", least_s)
        self._rows, self._receipts = Spacing(), Spacing()
        self._last_ns: int | None = None
        self._received_ns: int | None = None
        self._counted_ns: int | None = None  # receive time from which the next spacing counts
        self._steady_ns: float | None = None
        self.standing = False

    @classmethod
    def from_state(cls, state: DataTimeoutState) -> "DataTimeout":
        """Resume from a state."""
        timeout = cls(state.limit, state.least_s)
        timeout._rows, timeout._receipts = msgspec.structs.replace(state.rows), msgspec.structs.replace(state.receipts)
        timeout._last_ns, timeout.standing = state.last_ns, state.standing
        timeout._note_steady()
        return timeout

    @property
    def state(self) -> DataTimeoutState:
        """A copy of the state."""
        rows, receipts = msgspec.structs.replace(self._rows), msgspec.structs.replace(self._receipts)
        return DataTimeoutState(self._limit, self._least_s, rows, receipts, self._last_ns, self.standing)

    # --- sample time -----------------------------------------------------------------------------------------

    def fallback_allowed_ns(self) -> int | None:
        """Allowed time of a signal whose own spacing is unknown, by this plant's rows; None if that is unknown."""
        return _allowed_ns(self._rows, max(UNKNOWN_ROWS, self._limit))

    def update(self, time_ns: int, *, present: bool, fallback_allowed_ns: int | None = None) -> Change:
        """Update with a row.

        A row that is not later than the last sample means that the plant's clock was set back: spacings count from this
        row on.

        Args:
            time_ns: time of the row.
            present: True if the signal has a value in it.
            fallback_allowed_ns: allowed time while the signal's own spacing is unknown; None: unlimited.
        """
        last_ns = self._last_ns
        if last_ns is None or time_ns <= last_ns:
            self._last_ns = time_ns
            return self._change(None, time_ns) if present else NO_CHANGE
        rows, spacing_ns = self._rows, time_ns - last_ns
        if present and spacing_ns == self._steady_ns and not self.standing:
            self._last_ns = time_ns  # there is nothing to learn
            return NO_CHANGE
        allowed_ns = _allowed_ns(rows, self._limit)
        if allowed_ns is None and fallback_allowed_ns is not None:
            allowed_ns = max(fallback_allowed_ns, int(self._limit * rows.mean_ns))
        raised_ns = None
        if allowed_ns is not None and spacing_ns > allowed_ns and not self.standing:
            self.standing, raised_ns = True, last_ns + allowed_ns
        if not present:
            return NO_CHANGE if raised_ns is None else Change(raised_ns, None)
        rows.learn(spacing_ns if allowed_ns is None else min(spacing_ns, allowed_ns), MEMORY)
        self._note_steady()
        self._last_ns = time_ns
        return self._change(raised_ns, max(time_ns, last_ns + (allowed_ns or 0)))

    def suppress_until(self, time_ns: int) -> None:
        """Restart the timer: until now all signals had no data, not only this one."""
        if not self.standing:
            self._last_ns = time_ns

    # --- receive time ----------------------------------------------------------------------------------------

    def arm(self, now_ns: int) -> None:
        """Restart the timer after a stop; the time to the next sample is no spacing."""
        self._received_ns, self._counted_ns = now_ns, None

    @property
    def receipts_ns(self) -> tuple[int | None, int | None]:
        """Receive time of the last sample, and of the one from which the next spacing counts; None before the first."""
        return self._received_ns, self._counted_ns

    @receipts_ns.setter
    def receipts_ns(self, receipts_ns: tuple[int | None, int | None]) -> None:
        self._received_ns, self._counted_ns = receipts_ns

    def on_receipt(self, now_ns: int) -> None:
        """Restart the timer: a sample was received. A step back of the clock is no spacing, nor is one in a burst."""
        before_ns, self._received_ns = self._counted_ns, now_ns
        if before_ns is None or now_ns < before_ns:
            self._counted_ns = now_ns
        elif self._receipts.count < MEMORY or now_ns - before_ns >= BURST * self._receipts.mean_ns:
            self._counted_ns = now_ns
            self._receipts.learn(min(now_ns - before_ns, self._timeout_ns() or now_ns - before_ns), MEMORY)

    def due_ns(self) -> int | None:
        """Time to `check`, unless a sample arrives before; None: no timeout is set."""
        timeout_ns = self._timeout_ns()
        if self._received_ns is None or timeout_ns is None or self.standing or self.deadline_ns() is None:
            return None
        return self._received_ns + timeout_ns

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
        allowed_ns = _allowed_ns(self._rows, self._limit)
        return None if self._last_ns is None or allowed_ns is None else self._last_ns + allowed_ns

    def _timeout_ns(self) -> int | None:
        allowed_ns = _allowed_ns(self._receipts, self._limit)
        return None if allowed_ns is None else max(allowed_ns, int(self._least_s * 1e9))

    def _note_steady(self) -> None:
        """Note the spacing of the rows if all were equal: then the next equal one teaches nothing."""
        rows = self._rows
        self._steady_ns = rows.mean_ns if rows.count == MEMORY and rows.deviation_ns == 0.0 else None

    def _change(self, raised_ns: int | None, heard_ns: int) -> Change:
        """Change due to a sample."""
        if not self.standing:
            return NO_CHANGE
        self.standing = False
        return Change(raised_ns, heard_ns)


def _allowed_ns(spacing: Spacing, limit: float) -> int | None:
    """`limit` times the usual spacing; None before it is known."""
    if spacing.count < LEARN_FROM:
        return None
    return int(limit * (spacing.mean_ns + DEVIATIONS * spacing.deviation_ns))


class SilenceCheck(SignalCheck):
    """Raises an alarm when the plant, or one of its signals, is silent."""

    name = DataTimeout.name

    def __init__(self, config: MonitorConfig, board: Annunciator, ranges: Sequence[SignalRange]) -> None:
        super().__init__(config, board, ranges)
        self._names = (PLANT, config.input, *config.outputs)
        self._silences = [DataTimeout(config.silence_periods) for _ in self._names]
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
        """Flags of the signals without data, the input first."""
        return [silence.standing for silence in self._silences[1:]]

    @property
    def state(self) -> list[DataTimeoutState]:
        """State of the plant, of the input and of each output."""
        return [silence.state for silence in self._silences]

    def restore(self, state: list[DataTimeoutState]) -> None:
        """See `SignalCheck`."""
        self._silences = [DataTimeout.from_state(item) for item in state]

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
