"""One alarm: the chart that it comes from, the rule that raises and clears it, and the state that the operator sees."""

from collections.abc import Mapping
from typing import Annotated, TypeAlias

import msgspec

from monitor_node.alarm_states import Event, State, next_state
from monitor_node.charts.base import Judgement
from monitor_node.incidents import Count
from monitor_node.persistence import Persistence, PersistenceState
from reactorwatch.contract import keys
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, Contribution, Priority

PRIORITIES: Mapping[str, Priority] = {
    "low": Priority.PRIORITY_LOW,
    "medium": Priority.PRIORITY_MEDIUM,
    "high": Priority.PRIORITY_HIGH,
    "critical": Priority.PRIORITY_CRITICAL,
}
STATES: Mapping[State, AlarmState] = {
    State.NORMAL: AlarmState.ALARM_STATE_NORMAL,
    State.UNACKNOWLEDGED: AlarmState.ALARM_STATE_UNACKNOWLEDGED,
    State.ACKNOWLEDGED: AlarmState.ALARM_STATE_ACKNOWLEDGED,
    State.RETURNED_UNACKNOWLEDGED: AlarmState.ALARM_STATE_RETURNED_UNACKNOWLEDGED,
    State.SHELVED: AlarmState.ALARM_STATE_SHELVED,
    State.SUPPRESSED_BY_DESIGN: AlarmState.ALARM_STATE_SUPPRESSED_BY_DESIGN,
    State.OUT_OF_SERVICE: AlarmState.ALARM_STATE_OUT_OF_SERVICE,
}

LAST_NS = 2**63 - 1
TimeNs: TypeAlias = Annotated[int, msgspec.Meta(ge=-(2**63), le=LAST_NS)]
"""A time that messages can carry."""


class AlarmMemory(msgspec.Struct, forbid_unknown_fields=True):
    """Everything that is remembered of an alarm.

    Attributes:
        state: what the operator sees.
        rule: the points behind it; whether its condition stands.
        raised_ns: time of the sample that raised it last; 0 before the first time.
        cleared_ns: time of the sample that cleared it; 0 while it stands.
        value: the chart's statistic when it was last raised or cleared.
        limit: the one that was crossed.
        above: whether it was the upper one.
        unit: of both.
        text: what is wrong, in one sentence; empty before the first time.
        incident: number of its incident; 0: it has not come up since it was raised.
        first_in: whether it began that incident.
        shelved_ns: when it was shelved; 0 if it is not.
        shelved_until_ns: until when; 0 if it is not.
        by: who acted on it last.
        comment: what that person said.
    """

    state: State = State.NORMAL
    rule: PersistenceState = msgspec.field(default_factory=PersistenceState)
    raised_ns: TimeNs = 0
    cleared_ns: TimeNs = 0
    value: float = 0.0
    limit: float = 0.0
    above: bool = False
    unit: str = ""
    text: str = ""
    incident: Count = 0
    first_in: bool = False
    shelved_ns: TimeNs = 0
    shelved_until_ns: TimeNs = 0
    by: str = ""
    comment: str = ""


class ChartAlarm:
    """The alarm of one chart of one signal.

    Args:
        chart: the chart's name.
        signal: the signal's name.
        priority: a key of `PRIORITIES`.
        rule: when points become an alarm.
        dead_band: a point is back in if it is within (1 - dead_band) of the way from the centre to the limit that was
            crossed.

    Attributes:
        name: as in its key: `shewhart/T`.
        priority: as in its messages.
    """

    def __init__(self, chart: str, signal: str, priority: str, rule: Persistence, dead_band: float) -> None:
        self.name = keys.chart_name(chart, signal)
        self.priority = PRIORITIES[priority]
        self._signal = signal
        self._rule = rule
        self._reach = 1 - dead_band
        self._memory = AlarmMemory(rule=rule.state)

    @property
    def memory(self) -> AlarmMemory:
        """Everything that is remembered; to be replaced as a whole."""
        return self._memory

    @memory.setter
    def memory(self, memory: AlarmMemory) -> None:
        self._memory = memory
        self._rule.state = memory.rule

    def judge(self, time_ns: int, judgement: Judgement, unit: str) -> Event | None:
        """Follow the condition.

        Args:
            time_ns: of the sample.
            judgement: of the chart.
            unit: of the statistic.

        Returns:
            `RAISED` or `CLEARED`, to be applied, if the condition changes.
        """
        change = self._rule.update(judgement.out, self._is_back_in(judgement))
        if change is None:
            return None
        memory = self._memory
        memory.value, memory.unit = judgement.statistic, unit
        if not change:
            memory.cleared_ns = time_ns
            memory.text = f"{self._signal} is again what the model expects"
            return Event.CLEARED
        memory.above = judgement.statistic > judgement.centre
        memory.limit = judgement.upper_limit if memory.above else judgement.lower_limit
        memory.raised_ns, memory.cleared_ns = time_ns, 0
        memory.incident, memory.first_in = 0, False
        if memory.state is State.NORMAL:
            memory.by = memory.comment = ""
        off, allowed = abs(judgement.statistic - judgement.centre), abs(memory.limit - judgement.centre)
        memory.text = (
            f"{self._signal} is {off:.3g} {unit} {'above' if memory.above else 'below'} what the model expects "
            f"(allowed: {allowed:.3g} {unit})"
        )
        return Event.RAISED

    def apply(self, event: Event) -> None:
        """Let something happen to it.

        Raises:
            InputError: the table of states refuses it.
        """
        memory = self._memory
        memory.state = next_state(memory.state, event, standing=memory.rule.standing)
        if memory.state is not State.SHELVED:
            memory.shelved_ns = memory.shelved_until_ns = 0

    def message(self, time_ns: int, event: str) -> Alarm:
        """The alarm as it is.

        Args:
            time_ns: of the change.
            event: what made it.
        """
        memory = self._memory
        return Alarm(
            time_ns=time_ns,
            alarm=self.name,
            state=STATES[memory.state],
            priority=self.priority,
            raised_ns=memory.raised_ns,
            cleared_ns=memory.cleared_ns,
            value=memory.value,
            limit=memory.limit,
            unit=memory.unit,
            contributions=[Contribution(signal=self._signal, share=1.0)],
            text=memory.text,
            event=event,
            incident=memory.incident,
            first_in=memory.first_in,
            shelved_until_ns=memory.shelved_until_ns,
            comment=memory.comment,
            by=memory.by,
        )

    def _is_back_in(self, judgement: Judgement) -> bool:
        if judgement.out:
            return False
        off = judgement.statistic - judgement.centre
        if self._memory.above:
            return off <= self._reach * (judgement.upper_limit - judgement.centre)
        return off >= self._reach * (judgement.lower_limit - judgement.centre)
