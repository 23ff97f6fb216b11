"""One alarm: its chart, the rule that raises and clears it, and the state that the operator sees.

The rule is an on-delay and an off-delay (ISA-18.2), m out of n.

One point beyond 3 sigma comes by chance every 370 samples: at ten samples a minute, every 37 minutes. No operator could
work with that. So an alarm is raised by `raise_count` violating points among the last `window` (on-delay), and cleared
by `clear_count` ordinary points in a row (off-delay). With a dead band a point near the limit is neither violating nor
ordinary, so that a value near its limit gives one alarm and not many. The remaining rate of false alarms is
`spc.m_of_n.false_alarm_rate`.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, NamedTuple, TypeAlias

import msgspec
import numpy as np

from reactorwatch.codegen.numba_kernel import Entry, jit
from reactorwatch.contract import keys
from reactorwatch.contract.alarm_states import CODES, Event, State, next_state
from reactorwatch.contract.messages_pb2 import Alarm, Contribution, Priority, Suspect
from reactorwatch.spc.charts.base import Judgement
from reactorwatch.spc.m_of_n import check_rule
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


class Condition(Memory):
    """Memory of an alarm's condition.

    Attributes:
        recent: last points, newest in the lowest bit (1: violating).
        in_a_row: number of ordinary points in a row.
        standing: True if the condition is active.
    """

    recent: int = 0
    in_a_row: int = 0
    standing: bool = False


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
    """True if a point is within the limit that was crossed, by the dead band.

    Args:
        statistic: statistic of the point.
        centre: centre of the chart.
        lower: lower limit.
        upper: upper limit.
        above: True if the upper limit was crossed.
        reach: share of the way from the centre to the limit that is ordinary.
    """
    deviation = statistic - centre
    return deviation <= reach * (upper - centre) if above else deviation >= reach * (lower - centre)


_ADD_POINT, _RAISES, _IS_ORDINARY = Entry(add_point), Entry(raises), Entry(is_ordinary)


class OnOffDelay:
    """Delays of one alarm.

    Args:
        raise_count: number of violating points among the last `window` that raises the alarm.
        window: number of points in the window.
        clear_count: number of ordinary points in a row that clears the alarm.

    Raises:
        ValueError: the numbers make no rule.
    """

    def __init__(self, raise_count: int, window: int, clear_count: int) -> None:
        check_rule(raise_count, window, clear_count)
        self._raise_count, self._clear_count = raise_count, clear_count
        self._mask = (1 << window) - 1

    def update(self, condition: Condition, violating: bool, ordinary: bool | None = None) -> bool | None:
        """Update a condition with the next point.

        Args:
            condition: the condition, which is changed.
            violating: True if the point is beyond a limit.
            ordinary: True if the point is within the limits by the dead band; None: if it is not violating.

        Returns:
            True if the alarm is raised, False if it is cleared, None if nothing changes.
        """
        if ordinary is None:
            ordinary = not violating
        condition.recent, condition.in_a_row = _ADD_POINT.call(
            condition.recent, condition.in_a_row, self._mask, violating, ordinary
        )
        if condition.standing:
            if condition.in_a_row >= self._clear_count:
                condition.standing, condition.recent = False, 0
                return False
        elif _RAISES.call(condition.recent, self._raise_count, violating):
            condition.standing = True
            return True
        return None


class AlarmMemory(Memory):
    """Memory of an alarm.

    Attributes:
        state: state that the operator sees.
        rule: recent points, and the alarm's condition.
        is_active: True if the alarm was raised, and not cleared since; `rule` is ahead of it within a row.
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
    rule: Condition = msgspec.field(default_factory=Condition)
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


SHARED = (
    "raised_ns", "cleared_ns", "value", "limit", "unit", "text", "incident", "first_in", "shelved_until_ns", "by",
    "comment",
)  # fmt: skip
"""Fields that the state of an alarm and its message have in common."""


class Explanation(NamedTuple):
    """Text and causes of an alarm when it is raised.

    Attributes:
        text: the deviation in one sentence.
        contributions: share of the deviation by signal.
        suspects: causes, if the alarm names its cause itself.
        entries: causes of the whole incident, if the chart finds them.
    """

    text: str
    contributions: dict[str, float]
    suspects: Sequence[SuspectedCause] = ()
    entries: Sequence[SuspectedCause] = ()


class ChartAlarm:
    """The alarm of one chart.

    Args:
        chart: name of the chart.
        signal: name of the signal, or another word in the alarm's key.
        priority: a key of `PRIORITIES`.
        rule: on-delay and off-delay.
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
        is_transient: bool = False,
    ) -> None:
        self.name = keys.chart_name(chart, signal)
        self.priority = PRIORITIES[priority]
        self.names_cause, self.is_transient = names_cause, is_transient
        self._rule = rule
        self._reach = 1 - dead_band
        self.memory = AlarmMemory()

    @property
    def is_idle(self) -> bool:
        """True if a point within the limits would change nothing."""
        rule = self.memory.rule
        return not (rule.standing or rule.recent)

    def update(self, judgement: Judgement) -> bool | None:
        """Update the alarm's condition with a point of the chart.

        Returns:
            True if the alarm is raised, False if it is cleared, which the annunciator's `apply` has to follow; None if
            nothing changes.
        """
        out = bool(judgement.out)
        return self._rule.update(
            self.memory.rule, out, not out and _IS_ORDINARY.call(*judgement[:4], self.memory.above, self._reach)
        )

    def record(self, time_ns: int, change: "AlarmChange") -> Event:
        """Record a change of the condition at a time; returns the event, which is applied."""
        memory, judgement, explanation = self.memory, change.judgement, change.explanation
        memory.value, memory.unit, memory.is_active = judgement.statistic, change.unit, explanation is not None
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
            state=CODES[memory.state],
            priority=self.priority,
            contributions=[Contribution(signal=name, share=share) for name, share in memory.contributions.items()],
            suspects=suspect_messages(memory.suspects),
            event=event,
            names_cause=self.names_cause,
            **{field: getattr(memory, field) for field in SHARED},
        )


class AlarmChange(NamedTuple):
    """Change of an alarm's condition, as the stages of a row return it.

    Attributes:
        alarm: the alarm, whose `update` found the change.
        judgement: point of the chart.
        unit: unit of the statistic.
        explanation: explanation of an alarm that is raised; None: it is cleared.
        time_ns: time of the change; None: that of the row.
    """

    alarm: ChartAlarm
    judgement: Judgement
    unit: str
    explanation: Explanation | None
    time_ns: int | None = None


def suspect_messages(suspects: Iterable[SuspectedCause]) -> list[Suspect]:
    """Possible causes as messages."""
    return [Suspect(**msgspec.structs.asdict(item)) for item in suspects]
