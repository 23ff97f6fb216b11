"""How the alarms burden the operator: the figures of EEMUA 191 (2013) and ANSI/ISA-18.2 (2016).

One person can deal with about one alarm in ten minutes. More than ten in ten minutes are a *flood*, in which alarms are
no longer read. An alarm that comes up three times within a minute *chatters*: its delays or its dead band are too
small. One that has stood for more than a day is *stale*: nobody acts on it, so it should not be an alarm.

What counts as an alarm here is that it comes up: it becomes unacknowledged. All of it is in plant time.
"""

from collections.abc import Iterable
from typing import NamedTuple

import msgspec

from monitor_node.alarms.incidents import Count
from monitor_node.alarms.states import State
from reactorwatch.contract.messages_pb2 import AlarmKpis, Priority, PriorityCount
from reactorwatch.records.record import MINUTE_NS

RATE_WINDOW_NS = 10 * MINUTE_NS
FLOOD = 10  # alarms in the window; more are a flood
CHATTER_TIMES = 3
CHATTER_WITHIN_NS = MINUTE_NS
PRIORITIES = (
    Priority.PRIORITY_CRITICAL,
    Priority.PRIORITY_HIGH,
    Priority.PRIORITY_MEDIUM,
    Priority.PRIORITY_LOW,
)
STALE_AFTER_NS = 24 * 60 * MINUTE_NS


def are_of_nothing(figures: AlarmKpis) -> bool:
    """Whether figures say that no alarm ever came up, and that nobody keeps one out of sight.

    Args:
        figures: those.
    """
    return not (
        figures.alarms_10min
        or figures.standing
        or figures.unacknowledged
        or figures.shelved
        or figures.suppressed
        or figures.out_of_service
        or figures.incidents
        or any(count.raised for count in figures.priorities)
    )


class Counted(NamedTuple):
    """What the figures need to know of an alarm now."""

    name: str
    priority: Priority
    state: State
    raised_ns: int


class CameUp(NamedTuple):
    """An alarm that came up."""

    time_ns: int
    alarm: str


class KpiState(msgspec.Struct, forbid_unknown_fields=True):
    """What is remembered.

    Attributes:
        recent: alarms that came up within the last ten minutes, the oldest first.
        raised: how many came up so far, by the number of the priority.
    """

    recent: list[CameUp] = msgspec.field(default_factory=list)
    raised: dict[int, Count] = msgspec.field(default_factory=dict)


class KpiCounter:
    """Counts alarms as they come up.

    Attributes:
        state: what it remembers.
    """

    def __init__(self) -> None:
        self.state = KpiState()

    def came_up(self, time_ns: int, alarm: str, priority: Priority) -> None:
        """Count one."""
        self._forget(time_ns)
        self.state.recent.append(CameUp(time_ns, alarm))
        self.state.raised[priority] = self.state.raised.get(priority, 0) + 1

    def figures(self, time_ns: int, alarms: Iterable[Counted], incidents: int) -> AlarmKpis:
        """The figures now.

        Args:
            time_ns: now, in plant time.
            alarms: all of the plant.
            incidents: how many there were so far.
        """
        self._forget(time_ns)
        alarms = list(alarms)
        recent = self.state.recent
        standing = [alarm for alarm in alarms if alarm.state in (State.UNACKNOWLEDGED, State.ACKNOWLEDGED)]
        states = [alarm.state for alarm in alarms]
        return AlarmKpis(
            time_ns=time_ns,
            alarms_10min=len(recent),
            flood=len(recent) > FLOOD,
            chattering=sorted({item.alarm for item in recent if self._chatters(item.alarm)}),
            standing=[alarm.name for alarm in standing],
            stale=[alarm.name for alarm in standing if time_ns - alarm.raised_ns > STALE_AFTER_NS],
            priorities=[
                PriorityCount(
                    priority=priority,
                    raised=self.state.raised.get(priority, 0),
                    standing=sum(alarm.priority == priority for alarm in standing),
                )
                for priority in PRIORITIES
            ],
            unacknowledged=states.count(State.UNACKNOWLEDGED) + states.count(State.RETURNED_UNACKNOWLEDGED),
            shelved=states.count(State.SHELVED),
            suppressed=states.count(State.SUPPRESSED_BY_DESIGN),
            out_of_service=states.count(State.OUT_OF_SERVICE),
            incidents=incidents,
        )

    def _forget(self, time_ns: int) -> None:
        """Keep what came up in the ten minutes up to now; what lies ahead is from before the clock was set back."""
        self.state.recent = [item for item in self.state.recent if 0 <= time_ns - item.time_ns < RATE_WINDOW_NS]

    def _chatters(self, alarm: str) -> bool:
        times = [item.time_ns for item in self.state.recent if item.alarm == alarm]
        return any(
            last - first <= CHATTER_WITHIN_NS for first, last in zip(times, times[CHATTER_TIMES - 1 :], strict=False)
        )
