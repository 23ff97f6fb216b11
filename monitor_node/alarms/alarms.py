"""Alarms: the rule that raises and clears one, its memory, incidents of several, and the operator's load (KPIs).

The rule is an on-delay and an off-delay (ISA-18.2), m out of n. One point beyond 3 sigma comes by chance every 370
samples: at ten samples a minute, every 37 minutes. No operator could work with that. So an alarm is raised by
`raise_count` violating points among the last `window` (on-delay), and cleared by `clear_count` ordinary points in a row
(off-delay). With a dead band a point near the limit is neither violating nor ordinary, so that a value near its limit
gives one alarm and not many. The remaining rate of false alarms is `spc.run_length.false_alarm_rates`.

The KPIs are those of EEMUA 191 (2013) and ANSI/ISA-18.2 (2016). An operator can deal with about one alarm in ten
minutes. More than ten in ten minutes are a *flood*, in which alarms are no longer read. An alarm activated three times
within a minute *chatters*: its delays or its dead band are too small. One that has been active for more than a day is
*stale*: it calls for no action, so it should not be an alarm. An alarm is counted when it becomes unacknowledged. All
times are plant time.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, NamedTuple, TypeAlias

import msgspec
import numpy as np

from reactorwatch.codegen.numba_kernel import Entry, jit
from reactorwatch.contract import keys
from reactorwatch.contract.alarm_states import CODES, State
from reactorwatch.contract.messages_pb2 import AlarmKpis, Priority, PriorityCount, Suspect
from reactorwatch.contract.messages_pb2 import Incident as IncidentMessage
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.spc.charts.base import Judgement
from reactorwatch.spc.run_length import check_rule
from reactorwatch.stored_state import Memory

PRIORITIES: Mapping[str, Priority] = {
    name: getattr(Priority, f"PRIORITY_{name.upper()}") for name in ("low", "medium", "high", "critical")
}

STUCK_SENSOR = "stuck_sensor"
"""The cause named by the check for stuck values."""


Count: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
"""A count that fits into a message."""

LAST_NS = 2**63 - 1
TimeNs: TypeAlias = Annotated[int, msgspec.Meta(ge=-(2**63), le=LAST_NS)]
"""A time that fits into a message."""


class SuspectedCause(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A possible cause of an alarm; the fields of a `Suspect` message.

    Attributes:
        cause: name of the cause.
        probability: posterior probability.
        profile: `step` or `ramp`; empty if not known.
        size: size in `unit`; of a ramp in the newest row.
        size_sd: standard deviation of the size.
        unit: unit of the size.
        onset_ns: time of the onset.
        onset_sd_min: standard deviation of the onset.
        kind: `sensor` or `process`; empty if not known.
        text: the cause in words.
    """

    cause: str
    probability: float
    profile: str = ""
    size: float = 0.0
    size_sd: float = 0.0
    unit: str = ""
    onset_ns: TimeNs = 0
    onset_sd_min: float = 0.0
    kind: str = ""
    text: str = ""

    @property
    def message(self) -> Suspect:
        """The cause as a message."""
        return Suspect(**msgspec.structs.asdict(self))


DELAY = np.dtype([("recent", "i4"), ("in_a_row", "i4"), ("above", "i4")], align=True)
"""Numbers of an alarm that is not active: last points, ordinary points in a row, 1 if its last limit was the upper."""


@jit
def add_point(recent: int, in_a_row: int, mask: int, violating: bool, ordinary: bool) -> tuple[int, int]:
    """Last points and number of ordinary points in a row, with the next point."""
    return ((recent << 1) | (1 if violating else 0)) & mask, in_a_row + 1 if ordinary else 0


@jit
def raises(recent: int, raise_count: int, violating: bool) -> bool:
    """True if the last points raise an alarm that is not active."""
    count = 0
    while recent:
        count += recent & 1
        recent >>= 1
    return violating and count >= raise_count


@jit
def is_ordinary(statistic: float, centre: float, lower: float, upper: float, above: bool, reach: float) -> bool:
    """True if a point is within the limit that was crossed, by the dead band."""
    deviation = statistic - centre
    return deviation <= reach * (upper - centre) if above else deviation >= reach * (lower - centre)


_ADD_POINT, _RAISES, _IS_ORDINARY = Entry(add_point), Entry(raises), Entry(is_ordinary)


class AlarmMemory(Memory):
    """Memory of an alarm.

    Attributes:
        state: state that the operator sees.
        recent: last points, newest in the lowest bit (1: violating).
        in_a_row: number of ordinary points in a row.
        standing: True if the condition is active.
        is_active: True if the alarm was raised, and not cleared since; `standing` is ahead of it within a row.
        raised_ns: time of the sample that raised the alarm last; 0 before the first.
        cleared_ns: time of the sample that cleared the alarm; 0 while it is active.
        value: statistic of the chart when the alarm was last raised or cleared.
        limit: limit that was crossed.
        above: True if that was the upper limit.
        unit: unit of value and limit.
        text: the deviation in one sentence; empty before the alarm was first raised.
        contributions: share of the deviation by signal.
        suspects: possible causes, the likeliest first; empty before a search.
        incident: number of the incident; 0 if the alarm was not activated since it was raised.
        first_in: True for the first-out alarm of the incident.
        shelved_ns: time of shelving; 0 if the alarm is not shelved.
        shelved_until_ns: end of shelving; 0 if the alarm is not shelved.
        by: operator of the last action.
        comment: the operator's comment.
    """

    state: State = State.NORMAL
    recent: int = 0
    in_a_row: int = 0
    standing: bool = False
    is_active: bool = False
    raised_ns: TimeNs = 0
    cleared_ns: TimeNs = 0
    value: float = 0.0
    limit: float = 0.0
    above: bool = False
    unit: str = ""
    text: str = ""
    contributions: dict[str, float] = msgspec.field(default_factory=dict)
    suspects: list[SuspectedCause] = msgspec.field(default_factory=list)
    incident: Count = 0
    first_in: bool = False
    shelved_ns: TimeNs = 0
    shelved_until_ns: TimeNs = 0
    by: str = ""
    comment: str = ""


class AlarmChange(msgspec.Struct):
    """Change of an alarm's condition, as the stages of a row return it.

    Attributes:
        alarm: the alarm.
        judgement: point of the chart.
        is_raised: True if the alarm is raised, False if it is cleared.
        unit: unit of the statistic.
        time_ns: time of the change; None: that of the row.
        text: the deviation in one sentence.
        contributions: share of the deviation by signal.
        suspects: causes, if the alarm names its cause itself.
        entries: causes of the whole incident, if the chart finds them.
    """

    alarm: "ChartAlarm"
    judgement: Judgement
    is_raised: bool
    unit: str = ""
    time_ns: int | None = None
    text: str = ""
    contributions: dict[str, float] = msgspec.field(default_factory=dict)
    suspects: Sequence[SuspectedCause] = ()
    entries: Sequence[SuspectedCause] = ()


class ChartAlarm:
    """The alarm of one chart.

    Args:
        chart: name of the chart.
        signal: name of the signal, or another word in the alarm's key.
        priority: a key of `PRIORITIES`.
        delays: number of violating points that raises the alarm; number of newest points among which they count; number
            of ordinary points in a row that clears the alarm.
        dead_band: a point is ordinary within (1 - dead_band) of the way from the centre to the limit that was crossed.
        names_cause: True if the alarm names its cause itself.
        is_transient: True if the alarm is for a single value. While an alarm without a known cause is active, it joins
            the latest incident, so that it removes no suspects.

    Attributes:
        name: name as in the key: `shewhart/T`.
        priority: priority as in messages.
        names_cause: as given.
        is_transient: as given.
        memory: memory of the alarm; another one may be put in its place.

    Raises:
        ValueError: the delays make no rule.
    """

    def __init__(
        self,
        chart: str,
        signal: str,
        priority: str,
        delays: tuple[int, int, int],
        dead_band: float,
        *,
        names_cause: bool = False,
        is_transient: bool = False,
    ) -> None:
        check_rule(*delays)
        self.name = keys.chart_name(chart, signal)
        self.priority = PRIORITIES[priority]
        self.names_cause, self.is_transient = names_cause, is_transient
        self._raise_count, window, self._clear_count = delays
        self._mask, self._reach = (1 << window) - 1, 1 - dead_band
        self.memory = AlarmMemory()

    def update(
        self, judgement: Judgement, unit: str = "", time_ns: int | None = None, *, away: bool = False
    ) -> AlarmChange | None:
        """Update the alarm's condition with a point of the chart.

        Args:
            judgement: the point.
            unit: unit of its statistic.
            time_ns: time of the point; None: that of the row.
            away: True if the plant is not back, whatever its predictor has learned: then no point is ordinary.

        Returns:
            The change, which the annunciator's `apply` has to follow; None if nothing changes.
        """
        memory, out = self.memory, bool(judgement.out)
        if not (out or memory.standing or memory.recent):
            return None
        ordinary = not (out or away) and _IS_ORDINARY.call(*judgement[:4], memory.above, self._reach)
        memory.recent, memory.in_a_row = _ADD_POINT.call(memory.recent, memory.in_a_row, self._mask, out, ordinary)
        if memory.standing:
            if memory.in_a_row < self._clear_count:
                return None
            memory.standing, memory.recent = False, 0
        elif _RAISES.call(memory.recent, self._raise_count, out):
            memory.standing = True
        else:
            return None
        return AlarmChange(self, judgement, memory.standing, unit, time_ns)


URGENCY = (
    *(State.UNACKNOWLEDGED, State.ACKNOWLEDGED, State.RETURNED_UNACKNOWLEDGED, State.SHELVED),
    *(State.SUPPRESSED_BY_DESIGN, State.OUT_OF_SERVICE, State.NORMAL),
)
"""States of alarms, the most urgent first; an incident has that of its most urgent alarm."""

CHATTER_WITHIN_NS = MINUTE_NS


class Incident(msgspec.Struct, forbid_unknown_fields=True):
    """Memory of an incident.

    Attributes:
        number: number of the incident from 1.
        since_ns: activation of its first alarm.
        changed_ns: time when an alarm of the incident was last raised or cleared.
        alarms: names of its alarms in the order of their activation; the first is the first-out alarm.
        suspects: its possible causes, the likeliest first; empty before a search.
        text: what limits the suspects; empty: nothing.
        published: its newest message without the time, serialized.
    """

    number: Count
    since_ns: TimeNs = 0
    changed_ns: TimeNs = 0
    alarms: list[str] = msgspec.field(default_factory=list)
    suspects: list[SuspectedCause] = msgspec.field(default_factory=list)
    text: str = ""
    published: bytes = b""

    def message(self, members: Collection[AlarmMemory]) -> IncidentMessage:
        """The incident as a message, without the time."""
        return IncidentMessage(
            number=self.number,
            since_ns=self.since_ns,
            until_ns=0 if any(alarm.is_active for alarm in members) else self.changed_ns,
            state=CODES[min((alarm.state for alarm in members), key=URGENCY.index, default=State.NORMAL)],
            alarms=self.alarms,
            suspects=[item.message for item in self.suspects],
            text=self.text,
        )


def is_empty(kpis: AlarmKpis) -> bool:
    """True if no alarm was ever activated, and none is shelved, suppressed or out of service."""
    given = {field.name for field, _ in kpis.ListFields()} - {"time_ns", "priorities"}
    return not (given or any(count.raised for count in kpis.priorities))


class Activation(NamedTuple):
    """Activation of an alarm."""

    time_ns: int
    alarm: str


class KpiCounter(Memory):
    """Counter of activations.

    Attributes:
        recent: activations within the last ten minutes, the oldest first.
        raised: number of activations so far, by priority code.
    """

    recent: list[Activation] = msgspec.field(default_factory=list)
    raised: dict[int, Count] = msgspec.field(default_factory=dict)

    def compute(self, time_ns: int, alarms: Collection[ChartAlarm], incidents: int) -> AlarmKpis:
        """Compute the KPIs."""
        # Those in the future are from before the clock was set back.
        recent = self.recent = [item for item in self.recent if 0 <= time_ns - item.time_ns < 10 * MINUTE_NS]
        abnormal = [alarm for alarm in alarms if alarm.memory.state is not State.NORMAL]  # few of hundreds
        states = [alarm.memory.state for alarm in abnormal]
        active = [alarm for alarm in abnormal if alarm.memory.state in (State.UNACKNOWLEDGED, State.ACKNOWLEDGED)]
        return AlarmKpis(
            time_ns=time_ns,
            alarms_10min=len(recent),
            flood=len(recent) > 10,
            chattering=sorted({item.alarm for item in recent if self._chatters(item.alarm)}),
            standing=[alarm.name for alarm in active],
            stale=[alarm.name for alarm in active if time_ns - alarm.memory.raised_ns > 24 * 60 * MINUTE_NS],
            priorities=[
                PriorityCount(
                    priority=priority,
                    raised=self.raised.get(priority, 0),
                    standing=sum(alarm.priority == priority for alarm in active),
                )
                for priority in sorted(PRIORITIES.values(), reverse=True)
            ],
            unacknowledged=states.count(State.UNACKNOWLEDGED) + states.count(State.RETURNED_UNACKNOWLEDGED),
            shelved=states.count(State.SHELVED),
            suppressed=states.count(State.SUPPRESSED_BY_DESIGN),
            out_of_service=states.count(State.OUT_OF_SERVICE),
            incidents=incidents,
        )

    def _chatters(self, alarm: str) -> bool:
        times = [item.time_ns for item in self.recent if item.alarm == alarm]
        return any(last - first <= CHATTER_WITHIN_NS for first, last in zip(times, times[2:], strict=False))
