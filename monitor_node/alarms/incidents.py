"""Incidents of a plant's alarms, and alarm KPIs.

The KPIs are the operator's load after EEMUA 191 (2013) and ANSI/ISA-18.2 (2016). An operator can deal with about one
alarm in ten minutes. More than ten in ten minutes are a *flood*, in which alarms are no longer read. An alarm activated
three times within a minute *chatters*: its delays or its dead band are too small. One that has been active for more
than a day is *stale*: it calls for no action, so it should not be an alarm.

An alarm is counted when it becomes unacknowledged. All times are plant time.
"""

from collections.abc import Collection
from typing import NamedTuple

import msgspec

from monitor_node.alarms.alarms import PRIORITIES, AlarmMemory, ChartAlarm, Count, SuspectedCause, TimeNs
from reactorwatch.contract.alarm_states import CODES, State
from reactorwatch.contract.messages_pb2 import AlarmKpis, PriorityCount
from reactorwatch.contract.messages_pb2 import Incident as IncidentMessage
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.stored_state import Memory

URGENCY = (
    *(State.UNACKNOWLEDGED, State.ACKNOWLEDGED, State.RETURNED_UNACKNOWLEDGED, State.SHELVED),
    *(State.SUPPRESSED_BY_DESIGN, State.OUT_OF_SERVICE, State.NORMAL),
)
"""States of alarms, the most urgent first; an incident has that of its most urgent alarm."""

RATE_WINDOW_NS = 10 * MINUTE_NS
FLOOD = 10  # alarms in the window; more are a flood
CHATTER_TIMES = 3
CHATTER_WITHIN_NS = MINUTE_NS
STALE_AFTER_NS = 24 * 60 * MINUTE_NS


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
        """The incident as a message, without the time.

        Args:
            members: memory of the alarms whose last activation belongs to the incident.
        """
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
        """Compute the KPIs.

        Args:
            time_ns: present plant time.
            alarms: all alarms of the plant.
            incidents: number of incidents so far.
        """
        # Those in the future are from before the clock was set back.
        recent = self.recent = [item for item in self.recent if 0 <= time_ns - item.time_ns < RATE_WINDOW_NS]
        abnormal = [alarm for alarm in alarms if alarm.memory.state is not State.NORMAL]  # few of hundreds
        states = [alarm.memory.state for alarm in abnormal]
        active = [alarm for alarm in abnormal if alarm.memory.state in (State.UNACKNOWLEDGED, State.ACKNOWLEDGED)]
        return AlarmKpis(
            time_ns=time_ns,
            alarms_10min=len(recent),
            flood=len(recent) > FLOOD,
            chattering=sorted({item.alarm for item in recent if self._chatters(item.alarm)}),
            standing=[alarm.name for alarm in active],
            stale=[alarm.name for alarm in active if time_ns - alarm.memory.raised_ns > STALE_AFTER_NS],
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
        return any(
            last - first <= CHATTER_WITHIN_NS for first, last in zip(times, times[CHATTER_TIMES - 1 :], strict=False)
        )
