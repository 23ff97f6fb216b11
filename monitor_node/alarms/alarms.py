"""One alarm: the chart that it comes from, the rule that raises and clears it, and the state that the operator sees."""

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, NamedTuple, TypeAlias

import msgspec

from monitor_node.alarms.incidents import Count
from monitor_node.alarms.on_off_delay import Persistence, PersistenceState
from monitor_node.alarms.states import Event, State, next_state
from reactorwatch.contract import keys
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, Contribution, Priority, Suspect
from reactorwatch.spc.charts.base import Judgement, quantity

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

STUCK_SENSOR = "stuck_sensor"
"""The cause that the check for stuck values names."""

LAST_NS = 2**63 - 1
TimeNs: TypeAlias = Annotated[int, msgspec.Meta(ge=-(2**63), le=LAST_NS)]
"""A time that messages can carry."""


class SuspectedCause(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A cause that an alarm may come from; the fields of a `Suspect` message."""

    cause: str
    probability: float
    profile: str = ""
    size: float = 0.0
    size_sd: float = 0.0
    unit: str = ""
    onset_ns: TimeNs = 0
    onset_sd_min: float = 0.0
    kind: str = ""


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
        contributions: each signal's share of it.
        suspects: what it may come from, the likeliest first; empty while nobody has looked.
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
    contributions: dict[str, float] = msgspec.field(default_factory=dict)
    suspects: list[SuspectedCause] = msgspec.field(default_factory=list)
    incident: Count = 0
    first_in: bool = False
    shelved_ns: TimeNs = 0
    shelved_until_ns: TimeNs = 0
    by: str = ""
    comment: str = ""


def remembered(alarm: Alarm) -> AlarmMemory:
    """What a monitor remembered of an alarm when it said this of it, as far as the message tells."""
    standing = alarm.raised_ns != 0 and alarm.cleared_ns == 0
    return AlarmMemory(
        state=next((state for state, told in STATES.items() if told == alarm.state), State.NORMAL),
        rule=PersistenceState(standing=standing),
        raised_ns=alarm.raised_ns,
        cleared_ns=alarm.cleared_ns,
        value=alarm.value,
        limit=alarm.limit,
        above=alarm.limit > 0.0,
        unit=alarm.unit,
        text=alarm.text,
        contributions={item.signal: item.share for item in alarm.contributions},
        suspects=[
            SuspectedCause(**{field: getattr(item, field) for field in SuspectedCause.__struct_fields__})
            for item in alarm.suspects
        ],
        incident=alarm.incident,
        first_in=alarm.first_in,
        shelved_ns=alarm.time_ns if alarm.shelved_until_ns else 0,
        shelved_until_ns=alarm.shelved_until_ns,
        by=alarm.by,
        comment=alarm.comment,
    )


class Explanation(NamedTuple):
    """What an alarm says when it is raised.

    Attributes:
        text: what is wrong, in one sentence.
        contributions: each signal's share of it.
        suspects: where the alarm itself says what it comes from.
    """

    text: str
    contributions: dict[str, float]
    suspects: Sequence[SuspectedCause] = ()


class ChartAlarm:
    """The alarm of one chart.

    Args:
        chart: the chart's name.
        signal: what it is of: a signal's name, or another word in its key.
        priority: a key of `PRIORITIES`.
        rule: when points become an alarm.
        dead_band: a point is back in if it is within (1 - dead_band) of the way from the centre to the limit that was
            crossed.
        tells_cause: whether it says itself what its cause is.

    Attributes:
        name: as in its key: `shewhart/T`.
        priority: as in its messages.
        tells_cause: as given.
    """

    def __init__(
        self,
        chart: str,
        signal: str,
        priority: str,
        rule: Persistence,
        dead_band: float,
        *,
        tells_cause: bool = False,
    ) -> None:
        self.name = keys.chart_name(chart, signal)
        self.priority = PRIORITIES[priority]
        self.tells_cause = tells_cause
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

    @property
    def at_rest(self) -> bool:
        """Whether a point that is not out would change nothing."""
        rule = self._memory.rule
        return not (rule.standing or rule.recent)

    def judge(
        self, time_ns: int, judgement: Judgement, unit: str, explain: Callable[[Judgement], Explanation] | None = None
    ) -> Event | None:
        """Follow the condition.

        Args:
            time_ns: of the sample.
            judgement: of the chart.
            unit: of the statistic.
            explain: asked for what to say if the alarm is raised; without it, what a residual's chart says.

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
            memory.text = f"{self.name} is back within its limits"
            return Event.CLEARED
        memory.above = judgement.statistic > judgement.centre
        memory.limit = judgement.upper_limit if memory.above else judgement.lower_limit
        memory.raised_ns, memory.cleared_ns = time_ns, 0
        memory.incident, memory.first_in = 0, False
        if memory.state is State.NORMAL:
            memory.by = memory.comment = ""
        explanation = explain(judgement) if explain is not None else self._plainly(judgement, unit)
        memory.text, memory.contributions = explanation.text, explanation.contributions
        memory.suspects = list(explanation.suspects)
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
            contributions=[Contribution(signal=name, share=share) for name, share in memory.contributions.items()],
            suspects=[Suspect(**msgspec.structs.asdict(item)) for item in memory.suspects],
            text=memory.text,
            event=event,
            incident=memory.incident,
            first_in=memory.first_in,
            shelved_until_ns=memory.shelved_until_ns,
            comment=memory.comment,
            by=memory.by,
        )

    def _plainly(self, judgement: Judgement, unit: str) -> Explanation:
        off = judgement.statistic - judgement.centre
        allowed = abs(self._memory.limit - judgement.centre)
        text = (
            f"{self._signal} is {quantity(abs(off), unit)} {'above' if off > 0 else 'below'} what the model expects "
            f"(allowed: {quantity(allowed, unit)})"
        )
        return Explanation(text, {self._signal: 1.0})

    def _is_back_in(self, judgement: Judgement) -> bool:
        if judgement.out:
            return False
        off = judgement.statistic - judgement.centre
        if self._memory.above:
            return off <= self._reach * (judgement.upper_limit - judgement.centre)
        return off >= self._reach * (judgement.lower_limit - judgement.centre)
