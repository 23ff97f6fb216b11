"""One alarm: its chart, the rule that raises and clears it, and the state that the operator sees."""

from collections.abc import Mapping, Sequence
from typing import Annotated, NamedTuple, TypeAlias

import msgspec

from monitor_node.alarms.incidents import Count
from monitor_node.alarms.on_off_delay import IS_NORMAL, OnOffDelay, OnOffDelayState
from monitor_node.alarms.states import Event, State, next_state
from reactorwatch.contract import keys
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, ChartPoint, Contribution, Priority, Suspect
from reactorwatch.spc.charts.base import Judgement

PRIORITIES: Mapping[str, Priority] = {
    name: getattr(Priority, f"PRIORITY_{name.upper()}") for name in ("low", "medium", "high", "critical")
}
STATES: Mapping[State, AlarmState] = {state: getattr(AlarmState, f"ALARM_STATE_{state.name}") for state in State}

STUCK_SENSOR = "stuck_sensor"
"""The cause named by the check for stuck values."""

LAST_NS = 2**63 - 1
TimeNs: TypeAlias = Annotated[int, msgspec.Meta(ge=-(2**63), le=LAST_NS)]
"""A time that fits into a message."""


class SuspectedCause(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A possible cause of an alarm; the fields of a `Suspect` message."""

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


class AlarmMemory(msgspec.Struct, forbid_unknown_fields=True):
    """The state of an alarm.

    Attributes:
        state: state that the operator sees.
        rule: recent points, and the alarm's condition.
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
    rule: OnOffDelayState = msgspec.field(default_factory=OnOffDelayState)
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


SHARED = (
    "raised_ns", "cleared_ns", "value", "limit", "unit", "text", "incident", "first_in", "shelved_until_ns", "by",
    "comment",
)  # fmt: skip
"""Fields that the state of an alarm and its message have in common."""


def memory_from_message(alarm: Alarm) -> AlarmMemory:
    """Reconstruct the state of an alarm from a message, as far as the message has it."""
    active = alarm.raised_ns != 0 and alarm.cleared_ns == 0
    return AlarmMemory(
        state=next((state for state, code in STATES.items() if code == alarm.state), State.NORMAL),
        rule=OnOffDelayState(standing=active),
        above=alarm.limit > 0.0,
        contributions={item.signal: item.share for item in alarm.contributions},
        suspects=[
            SuspectedCause(**{field: getattr(item, field) for field in SuspectedCause.__struct_fields__})
            for item in alarm.suspects
        ],
        shelved_ns=alarm.time_ns if alarm.shelved_until_ns else 0,
        **{field: getattr(alarm, field) for field in SHARED},
    )


class Explanation(NamedTuple):
    """Text and causes of an alarm when it is raised.

    Attributes:
        text: the deviation in one sentence.
        contributions: share of the deviation by signal.
        suspects: causes, if the alarm names its cause itself.
    """

    text: str
    contributions: dict[str, float]
    suspects: Sequence[SuspectedCause] = ()


class ChartAlarm:
    """The alarm of one chart.

    Args:
        chart: name of the chart.
        signal: name of the signal, or another word in the alarm's key.
        priority: a key of `PRIORITIES`.
        rule: on-delay and off-delay.
        dead_band: a point is normal within (1 - dead_band) of the way from the centre to the limit that was crossed.
        names_cause: True if the alarm names its cause itself.

    Attributes:
        name: name as in the key: `shewhart/T`.
        priority: priority as in messages.
        names_cause: as given.
        memory: state; replace it by `restore`.
    """

    def __init__(
        self,
        chart: str,
        signal: str,
        priority: str,
        rule: OnOffDelay,
        dead_band: float,
        *,
        names_cause: bool = False,
    ) -> None:
        self.name = keys.chart_name(chart, signal)
        self.priority = PRIORITIES[priority]
        self.names_cause = names_cause
        self._rule = rule
        self._reach = 1 - dead_band
        self.memory = AlarmMemory(rule=rule.state)

    def restore(self, memory: AlarmMemory) -> None:
        """Resume from a state."""
        self.memory, self._rule.state = memory, memory.rule

    @property
    def is_idle(self) -> bool:
        """True if a point within the limits would change nothing."""
        rule = self.memory.rule
        return not (rule.standing or rule.recent)

    def update(self, judgement: Judgement) -> bool | None:
        """Update the alarm's condition with a point of the chart.

        Returns:
            True if the alarm is raised, False if it is cleared, which `record` has to follow; None if nothing changes.
        """
        out = bool(judgement.out)
        return self._rule.update(out, not out and IS_NORMAL.call(*judgement[:4], self.memory.above, self._reach))

    def record(self, time_ns: int, judgement: Judgement, unit: str, explanation: Explanation | None) -> Event:
        """Record the change of the condition that `update` returned; returns the event, which is applied.

        Args:
            time_ns: time of the sample.
            judgement: point of the chart.
            unit: unit of the statistic.
            explanation: explanation of an alarm that is raised; None: it is cleared.
        """
        memory = self.memory
        memory.value, memory.unit = judgement.statistic, unit
        if explanation is None:
            memory.cleared_ns = time_ns
            memory.text = f"{self.name} is back within its limits"
            self.apply(Event.CLEARED)
            return Event.CLEARED
        memory.above = judgement.statistic > judgement.centre
        memory.limit = judgement.upper_limit if memory.above else judgement.lower_limit
        memory.raised_ns, memory.cleared_ns = time_ns, 0
        memory.incident, memory.first_in = 0, False
        if memory.state is State.NORMAL:
            memory.by = memory.comment = ""
        memory.text, memory.contributions = explanation.text, explanation.contributions
        memory.suspects = list(explanation.suspects)
        self.apply(Event.RAISED)
        return Event.RAISED

    def apply(self, event: Event) -> None:
        """Apply an event to the state.

        Raises:
            InputError: the table of states refuses the event.
        """
        memory = self.memory
        memory.state = next_state(memory.state, event, active=memory.rule.standing)
        if memory.state is not State.SHELVED:
            memory.shelved_ns = memory.shelved_until_ns = 0

    def message(self, time_ns: int, event: str) -> Alarm:
        """The alarm as a message.

        Args:
            time_ns: time of the change.
            event: event that changed the alarm.
        """
        memory = self.memory
        return Alarm(
            time_ns=time_ns,
            alarm=self.name,
            state=STATES[memory.state],
            priority=self.priority,
            contributions=[Contribution(signal=name, share=share) for name, share in memory.contributions.items()],
            suspects=[Suspect(**msgspec.structs.asdict(item)) for item in memory.suspects],
            event=event,
            **{field: getattr(memory, field) for field in SHARED},
        )


def chart_point(time_ns: int, judgement: Judgement) -> ChartPoint:
    """Message of a point on a chart."""
    return ChartPoint(
        time_ns=time_ns,
        statistic=judgement.statistic,
        centre=judgement.centre,
        lower_limit=judgement.lower_limit,
        upper_limit=judgement.upper_limit,
        out=judgement.out,
    )
