"""State table of an alarm after ANSI/ISA-18.2 (2016) and IEC 62682 (2014).

An alarm has a *condition*, active or normal, which only samples change, and a *state*, which the operator sees. Four
states are annunciated: normal; unacknowledged (active, not acknowledged); acknowledged (active); returned
unacknowledged (normal again, not acknowledged). Three are not: shelved, by an operator and for a time; suppressed by
design, while the alarm is meaningless, as in a start-up; out of service, for maintenance.

The condition of an alarm that is not annunciated is still evaluated. An alarm that is annunciated again is
unacknowledged if its condition is active then, even if it had been acknowledged before, and normal if not.

The table has an entry for every pair of state and event: the next state, or why the event is refused there. The
diagram in docs/alarms.md is drawn from it.
"""

from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import NamedTuple, TypeAlias

from reactorwatch.contract.messages_pb2 import AlarmState
from reactorwatch.errors import InputError


class State(StrEnum):
    """Alarm state that the operator sees; the names are those of `AlarmState` in messages.proto."""

    NORMAL = "normal"
    UNACKNOWLEDGED = "unacknowledged"
    ACKNOWLEDGED = "acknowledged"
    RETURNED_UNACKNOWLEDGED = "returned unacknowledged"
    SHELVED = "shelved"
    SUPPRESSED_BY_DESIGN = "suppressed by design"
    OUT_OF_SERVICE = "out of service"


CODES: Mapping[State, AlarmState] = {state: getattr(AlarmState, f"ALARM_STATE_{state.name}") for state in State}
"""State on the bus, by state."""


class Event(StrEnum):
    """Event of an alarm: the first two come from samples, `SHELF_TIME_OVER` from time, the others from operators."""

    RAISED = "raised"
    CLEARED = "cleared"
    ACKNOWLEDGE = "acknowledge"
    SHELVE = "shelve"
    UNSHELVE = "unshelve"
    SHELF_TIME_OVER = "shelf time over"
    SUPPRESS = "suppress"
    UNSUPPRESS = "unsuppress"
    TAKE_OUT_OF_SERVICE = "take out of service"
    RETURN_TO_SERVICE = "return to service"


class ByCondition(NamedTuple):
    """Next states by condition.

    Attributes:
        active: next state if the condition is active.
        normal: next state if not.
    """

    active: State
    normal: State


class Refused(NamedTuple):
    """Refusal of an event in a state.

    Attributes:
        reason: text after "the alarm": "is not shelved".
    """

    reason: str


Outcome: TypeAlias = State | ByCondition | Refused

OUT_OF_SIGHT = frozenset({State.SHELVED, State.SUPPRESSED_BY_DESIGN, State.OUT_OF_SERVICE})
"""States that are not annunciated."""

UNACKNOWLEDGED_STATES = frozenset({State.UNACKNOWLEDGED, State.RETURNED_UNACKNOWLEDGED})
"""States that an operator can acknowledge."""

_IN_SIGHT_AGAIN = ByCondition(State.UNACKNOWLEDGED, State.NORMAL)
_NOT_SHELVED = Refused("is not shelved")
_NOT_SUPPRESSED = Refused("is not suppressed")
_IN_SERVICE = Refused("is in service")
_STANDS = Refused("stands already")
_OVER = Refused("does not stand")

_FROM_SIGHT: Mapping[Event, Outcome] = {
    Event.SHELVE: State.SHELVED,
    Event.UNSHELVE: _NOT_SHELVED,
    Event.SHELF_TIME_OVER: _NOT_SHELVED,
    Event.SUPPRESS: State.SUPPRESSED_BY_DESIGN,
    Event.UNSUPPRESS: _NOT_SUPPRESSED,
    Event.TAKE_OUT_OF_SERVICE: State.OUT_OF_SERVICE,
    Event.RETURN_TO_SERVICE: _IN_SERVICE,
}

TABLE: Mapping[State, Mapping[Event, Outcome]] = MappingProxyType(
    {
        State.NORMAL: {
            Event.RAISED: State.UNACKNOWLEDGED,
            Event.CLEARED: _OVER,
            Event.ACKNOWLEDGE: Refused("is normal, there is nothing to acknowledge"),
            **_FROM_SIGHT,
        },
        State.UNACKNOWLEDGED: {
            Event.RAISED: _STANDS,
            Event.CLEARED: State.RETURNED_UNACKNOWLEDGED,
            Event.ACKNOWLEDGE: State.ACKNOWLEDGED,
            **_FROM_SIGHT,
        },
        State.ACKNOWLEDGED: {
            Event.RAISED: _STANDS,
            Event.CLEARED: State.NORMAL,
            Event.ACKNOWLEDGE: Refused("is acknowledged already"),
            **_FROM_SIGHT,
        },
        State.RETURNED_UNACKNOWLEDGED: {
            Event.RAISED: State.UNACKNOWLEDGED,
            Event.CLEARED: _OVER,
            Event.ACKNOWLEDGE: State.NORMAL,
            **_FROM_SIGHT,
        },
        State.SHELVED: {
            Event.RAISED: State.SHELVED,
            Event.CLEARED: State.SHELVED,
            Event.ACKNOWLEDGE: Refused("is shelved; unshelve it first"),
            Event.SHELVE: State.SHELVED,  # with a new time
            Event.UNSHELVE: _IN_SIGHT_AGAIN,
            Event.SHELF_TIME_OVER: _IN_SIGHT_AGAIN,
            Event.SUPPRESS: Refused("is shelved; unshelve it first"),
            Event.UNSUPPRESS: _NOT_SUPPRESSED,
            Event.TAKE_OUT_OF_SERVICE: State.OUT_OF_SERVICE,
            Event.RETURN_TO_SERVICE: _IN_SERVICE,
        },
        State.SUPPRESSED_BY_DESIGN: {
            Event.RAISED: State.SUPPRESSED_BY_DESIGN,
            Event.CLEARED: State.SUPPRESSED_BY_DESIGN,
            Event.ACKNOWLEDGE: Refused("is suppressed by design; unsuppress it first"),
            Event.SHELVE: Refused("is suppressed by design and not shown anyway"),
            Event.UNSHELVE: _NOT_SHELVED,
            Event.SHELF_TIME_OVER: _NOT_SHELVED,
            Event.SUPPRESS: Refused("is suppressed already"),
            Event.UNSUPPRESS: _IN_SIGHT_AGAIN,
            Event.TAKE_OUT_OF_SERVICE: State.OUT_OF_SERVICE,
            Event.RETURN_TO_SERVICE: _IN_SERVICE,
        },
        State.OUT_OF_SERVICE: {
            Event.RAISED: State.OUT_OF_SERVICE,
            Event.CLEARED: State.OUT_OF_SERVICE,
            Event.ACKNOWLEDGE: Refused("is out of service; return it to service first"),
            Event.SHELVE: Refused("is out of service and not shown anyway"),
            Event.UNSHELVE: _NOT_SHELVED,
            Event.SHELF_TIME_OVER: _NOT_SHELVED,
            Event.SUPPRESS: Refused("is out of service and not shown anyway"),
            Event.UNSUPPRESS: _NOT_SUPPRESSED,
            Event.TAKE_OUT_OF_SERVICE: Refused("is out of service already"),
            Event.RETURN_TO_SERVICE: _IN_SIGHT_AGAIN,
        },
    }
)


def next_state(state: State, event: Event, *, active: bool) -> State:
    """The next state of an alarm.

    Args:
        state: present state.
        event: event.
        active: True if the condition is active after the event.

    Raises:
        InputError: the table refuses the event in this state; the text is the reason.
    """
    outcome = TABLE[state][event]
    if isinstance(outcome, Refused):
        raise InputError(outcome.reason)
    if isinstance(outcome, ByCondition):
        return outcome.active if active else outcome.normal
    return outcome


def is_consistent(state: State, *, active: bool) -> bool:
    """True if an alarm can be in this state with such a condition."""
    return state in OUT_OF_SIGHT or active == (state in (State.UNACKNOWLEDGED, State.ACKNOWLEDGED))


def diagram() -> str:
    """The table as a Mermaid state diagram, arrows between the same two states drawn as one."""
    arrows: dict[tuple[State, State], list[str]] = {}
    for state, row in TABLE.items():
        for event, outcome in row.items():
            if isinstance(outcome, ByCondition):
                arrows.setdefault((state, outcome.active), []).append(f"{event}, stands")
                arrows.setdefault((state, outcome.normal), []).append(f"{event}, over")
            elif isinstance(outcome, State):
                arrows.setdefault((state, outcome), []).append(event)
    names = [f'    state "{state}" as {state.name}' for state in State]
    lines = [f"    {start.name} --> {end.name}: {' / '.join(events)}" for (start, end), events in arrows.items()]
    return "\n".join(["stateDiagram-v2", *names, f"    [*] --> {State.NORMAL.name}", *lines])
