"""Silence: the plant, or one of its sensors, says nothing more.

Two clocks tell it. Where samples come, their own times do: a row that comes later than is allowed after the one before
ends a silence that began to count as one when the allowed time was over. So a replay and a back-test find the same
silences, raised and cleared at the same times, as the live monitor. But while nothing comes at all no sample tells
anything, and a live monitor must not wait for the plant to come back to say that it is gone. There the clock of receipt
tells it: nothing has come for longer than is allowed in receipt time. What is then raised carries the time at which
the next row, if there ever is one, will say that it was raised.

How long is allowed is learned, for each clock by itself, since a simulated plant may run sixty times as fast as its own
time: `limit` times the usual spacing, which is the mean spacing and twice its mean deviation, both forgetting over 32
samples, as in the retransmission timer of Jacobson (1988), Congestion avoidance and control, SIGCOMM. Regular samples
are allowed `limit` periods; irregular ones and those that arrive in bursts more, by themselves. A silence is learned as
no more than what was allowed, so that one does not spoil what was known; and yet a plant that goes on more slowly is
taken as it is after two or three. In receipt time it is never less than `least_s`, within which networks and computers
may hold anything up. Until `LEARN_FROM` spacings are known, the plant is not silent.

If the transport held samples up and the plant was never silent, the live alarm is cleared by the next row, as soon as
it was raised, and a replay, rightly, does not have it.

One `Silence` watches the plant: every row is a sign of life, and so is every sample received. One more a signal watches
that signal in the rows, which go on without it, with NaN: a dead sensor. A gap in all rows is no fault of any single
sensor, so these are excused then, and only one alarm is raised.

A signal of which fewer than `LEARN_FROM` spacings are known, or that has never come at all, is measured by the plant's
rows: it is silent after `UNKNOWN_ROWS` of their usual spacings without a value.

>>> from math import isnan, nan
>>> plant, sensor = Silence(), Silence()
>>> def on_row(time_ns: int, T: float) -> list[tuple[str, Change]]:
...     found = [("plant", plant.update(time_ns, present=True))]
...     if found[0][1] != NOTHING:
...         sensor.excuse(time_ns)
...     found.append(("T", sensor.update(time_ns, present=not isnan(T))))
...     return [(name, change) for name, change in found if change != NOTHING]
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

from monitor_node.alarms.annunciator import AlarmBoard
from monitor_node.baseline.signal_range import SignalRange
from monitor_node.config import MonitorConfig
from monitor_node.signal_checks.base import PLANT, SignalCheck
from reactorwatch.contract.codec import Publication
from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import Judgement, positive
from reactorwatch.stored_state import StoredState

LEARN_FROM = 32
"""Spacings that must be known before anything is silent."""

MEMORY = 32
"""Spacings over which the usual one is forgotten."""

UNKNOWN_ROWS = 100.0
"""Usual spacings of the plant's rows within which every signal has to come. An analyser may give one value in fifty
rows; a signal that does not come within these is not published, or its sensor is dead."""

DEVIATIONS = 2.0
"""Mean deviations that a usual spacing may be longer than the mean."""

BURST = 0.125
"""Of the usual spacing: what comes sooner is one sign of life with what came before. After a cut, or a stop of ours,
all that was held up comes at once, and says nothing of how often samples come."""

LATE_NS = 1_000_000_000
"""Who looks later than this after the plant was due cannot say that the plant was late."""


class Change(NamedTuple):
    """What happens to the silence.

    Attributes:
        raised_ns: when it began to be longer than is allowed, in the time of the samples; None: it was not raised now.
        cleared_ns: time of the sample that ended it, or when it was raised if that is later; None: it was not ended
            now.
    """

    raised_ns: int | None
    cleared_ns: int | None


NOTHING = Change(None, None)
"""The one that is returned, itself, when nothing happens."""


class Spacing(msgspec.Struct, forbid_unknown_fields=True):
    """How far apart samples usually are, on one clock.

    Attributes:
        count: of the spacings seen, up to `MEMORY`.
        mean_ns: of the recent ones.
        deviation_ns: of the recent ones from their mean, in the mean.
    """

    count: int = 0
    mean_ns: float = 0.0
    deviation_ns: float = 0.0

    def allowed_ns(self, limit: float) -> int | None:
        """`limit` times the usual spacing; None while too little is known."""
        if self.count < LEARN_FROM:
            return None
        return int(limit * (self.mean_ns + DEVIATIONS * self.deviation_ns))

    def usual_ns(self) -> float | None:
        """Usual spacing; None while too little is known."""
        return None if self.count < LEARN_FROM else self.mean_ns + DEVIATIONS * self.deviation_ns

    @property
    def steady_ns(self) -> float | None:
        """The spacing, if all were the same."""
        return self.mean_ns if self.count == MEMORY and self.deviation_ns == 0.0 else None

    def learn(self, spacing_ns: float) -> None:
        """Take the next spacing in."""
        self.count = min(self.count + 1, MEMORY)
        off = spacing_ns - self.mean_ns
        self.mean_ns += off / self.count
        if self.count > 1:
            self.deviation_ns += (abs(off) - self.deviation_ns) / self.count


class SilenceState(StoredState, frozen=True):
    """All that is set, learned and remembered.

    The time of the last receipt is not: while a monitor was down it heard nothing, and the plant is not to blame.

    Attributes:
        limit: see `Silence`.
        least_s: see `Silence`.
        rows: spacing in the time of the samples.
        receipts: spacing in the time of receipt.
        last_ns: time of the last sample that was there; None before the first.
        standing: whether it is silent.
    """

    limit: float
    least_s: float
    rows: Spacing
    receipts: Spacing
    last_ns: int | None
    standing: bool


class Silence:
    """Tells when samples have stopped coming.

    Args:
        limit: usual spacings without a sample that are still allowed.
        least_s: seconds of receipt time without anything that are always allowed.

    Attributes:
        standing: whether it is silent.

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
        self._counted_ns: int | None = None  # of these, the one that the next spacing is counted from
        self._steady_ns: float | None = None
        self.standing = False

    @classmethod
    def from_state(cls, state: SilenceState) -> "Silence":
        """The one that goes on where `state` was taken."""
        silence = cls(state.limit, state.least_s)
        silence._rows, silence._receipts = msgspec.structs.replace(state.rows), msgspec.structs.replace(state.receipts)
        silence._last_ns, silence.standing = state.last_ns, state.standing
        silence._steady_ns = silence._rows.steady_ns
        return silence

    @property
    def state(self) -> SilenceState:
        """A copy of all that is set, learned and remembered."""
        rows, receipts = msgspec.structs.replace(self._rows), msgspec.structs.replace(self._receipts)
        return SilenceState(self._limit, self._least_s, rows, receipts, self._last_ns, self.standing)

    # --- in the time of the samples --------------------------------------------------------------------------

    def unknown_allowed_ns(self) -> int | None:
        """Longest gap of a signal whose own spacing is not known, in the time of this plant; None: not known yet."""
        usual_ns = self._rows.usual_ns()
        return None if usual_ns is None else int(max(UNKNOWN_ROWS, self._limit) * usual_ns)

    def update(self, time_ns: int, *, present: bool, unknown_allowed_ns: int | None = None) -> Change:
        """Take the next row in.

        A row that is not later than the last sample means that the plant's clock was set back: spacings are counted
        from this row on.

        Args:
            time_ns: of the row.
            present: whether what is watched has a value in it.
            unknown_allowed_ns: how long it may be missing while its own spacing is not known; None: for ever.
        """
        last_ns = self._last_ns
        if last_ns is None or time_ns <= last_ns:
            self._last_ns = time_ns
            return self._change(None, time_ns) if present else NOTHING
        rows, spacing_ns = self._rows, time_ns - last_ns
        if present and spacing_ns == self._steady_ns and not self.standing:
            self._last_ns = time_ns  # there is nothing to learn
            return NOTHING
        allowed_ns = rows.allowed_ns(self._limit)
        if allowed_ns is None and unknown_allowed_ns is not None:
            allowed_ns = max(unknown_allowed_ns, int(self._limit * rows.mean_ns))
        raised_ns = None
        if allowed_ns is not None and spacing_ns > allowed_ns and not self.standing:
            self.standing, raised_ns = True, last_ns + allowed_ns
        if not present:
            return NOTHING if raised_ns is None else Change(raised_ns, None)
        rows.learn(spacing_ns if allowed_ns is None else min(spacing_ns, allowed_ns))
        self._steady_ns = rows.steady_ns
        self._last_ns = time_ns
        return self._change(raised_ns, max(time_ns, last_ns + (allowed_ns or 0)))

    def excuse(self, time_ns: int) -> None:
        """Begin to count anew: up to now everything was silent, not only what is watched here."""
        if not self.standing:
            self._last_ns = time_ns

    # --- in the time of receipt ------------------------------------------------------------------------------

    def listen(self, now_ns: int) -> None:
        """Begin to wait, after a stop, for what comes next; how long it takes is no spacing."""
        self._received_ns, self._counted_ns = now_ns, None

    @property
    def receipts_ns(self) -> tuple[int | None, int | None]:
        """When something came last, and from when the next spacing is counted; None: what comes next is the first."""
        return self._received_ns, self._counted_ns

    @receipts_ns.setter
    def receipts_ns(self, receipts_ns: tuple[int | None, int | None]) -> None:
        self._received_ns, self._counted_ns = receipts_ns

    def received(self, now_ns: int) -> None:
        """Note that something came, whatever it was. A clock that was set back is no spacing, nor is one in a burst."""
        before_ns, self._received_ns = self._counted_ns, now_ns
        if before_ns is None or now_ns < before_ns:
            self._counted_ns = now_ns
        elif self._receipts.count < MEMORY or now_ns - before_ns >= BURST * self._receipts.mean_ns:
            self._counted_ns = now_ns
            self._receipts.learn(min(now_ns - before_ns, self._patience_ns() or now_ns - before_ns))

    def due_ns(self) -> int | None:
        """When to `check` unless something comes before; None: there is nothing to wait for."""
        patience_ns = self._patience_ns()
        if self._received_ns is None or patience_ns is None or self.standing or self.deadline_ns() is None:
            return None
        return self._received_ns + patience_ns

    def check(self, now_ns: int) -> Change:
        """Look whether it is silent.

        Who looks much later than it was due was not there himself: frozen, or his clock was set. What was said
        meanwhile may still be on its way, so it is waited for anew.

        Args:
            now_ns: by the clock that `received` was told.
        """
        due_ns = self.due_ns()
        if due_ns is None or now_ns < due_ns:
            return NOTHING
        if now_ns - due_ns > LATE_NS:
            self.listen(now_ns)
            return NOTHING
        return self.begin()

    def begin(self) -> Change:
        """It is silent from now on, whoever says so."""
        if self.standing or self.deadline_ns() is None:
            return NOTHING
        self.standing = True
        return Change(self.deadline_ns(), None)

    def deadline_ns(self) -> int | None:
        """Until when the next row is allowed, in the time of the samples; None while too little is known."""
        allowed_ns = self._rows.allowed_ns(self._limit)
        return None if self._last_ns is None or allowed_ns is None else self._last_ns + allowed_ns

    def _patience_ns(self) -> int | None:
        allowed_ns = self._receipts.allowed_ns(self._limit)
        return None if allowed_ns is None else max(allowed_ns, int(self._least_s * 1e9))

    def _change(self, raised_ns: int | None, heard_ns: int) -> Change:
        """What it means that something was heard."""
        if not self.standing:
            return NOTHING
        self.standing = False
        return Change(raised_ns, heard_ns)


class SilenceCheck(SignalCheck):
    """Raises an alarm when the plant, or one of its signals, is silent."""

    name = Silence.name

    def __init__(self, config: MonitorConfig, board: AlarmBoard, ranges: Sequence[SignalRange]) -> None:
        super().__init__(config, board, ranges)
        self._names = (PLANT, config.input, *config.outputs)
        self._silences = [Silence(config.silence_periods) for _ in self._names]
        self._alarms = [
            board.declare(self.name, name, at_once=True, over_at_once=True, priority="high", tells_cause=True)
            for name in self._names
        ]

    @property
    def of_plant(self) -> Silence:
        """The silence of all signals together."""
        return self._silences[0]

    @property
    def silent(self) -> list[bool]:
        """Silence of each signal, the input first."""
        return [silence.standing for silence in self._silences[1:]]

    @property
    def state(self) -> list[SilenceState]:
        """Of the plant, of the input and of each output."""
        return [silence.state for silence in self._silences]

    def restore(self, state: list[SilenceState]) -> None:
        """See `SignalCheck`."""
        self._silences = [Silence.from_state(item) for item in state]

    def listen(self, now_ns: int) -> None:
        """Wait, after a stop, for the plant's next sample."""
        self.of_plant.listen(now_ns)

    def go_on_from_alarms(self) -> None:
        """Take as silent what the alarms say is silent: the next sample ends it."""
        for silence, alarm in zip(self._silences, self._alarms, strict=True):
            silence.standing = alarm.memory.rule.standing

    def on_row(self, time_ns: int, values: tuple[float, ...]) -> list[Publication]:
        """See `SignalCheck`."""
        silences = self._silences
        publications: list[Publication] = []
        change = silences[0].update(time_ns, present=True)
        if change is not NOTHING:
            publications += self.publish(0, change)
            for silence in silences[1:]:
                silence.excuse(time_ns)
        is_complete = all(value == value for value in values)  # NaN is not equal to itself
        unknown_ns = None if is_complete else silences[0].unknown_allowed_ns()
        for index, value in enumerate(values, start=1):
            change = silences[index].update(time_ns, present=value == value, unknown_allowed_ns=unknown_ns)
            if change is not NOTHING:
                publications += self.publish(index, change)
        return publications

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
