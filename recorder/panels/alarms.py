"""What was raised and cleared, beside what the plant was really made to suffer."""

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.suspects import suspects_text
from reactorwatch.records.record import to_minutes
from recorder.panels.base import ALARM, FAULT, QUIET, Event, EventLog, Panel
from recorder.run import AlarmChange, FaultChange, Run

SUSPECTED = "suspected"
"""The event of alarms whose suspects are new."""

_WORDS: dict[int, str] = {
    messages.ALARM_STATE_NORMAL: "normal",
    messages.ALARM_STATE_UNACKNOWLEDGED: "raised",
    messages.ALARM_STATE_ACKNOWLEDGED: "acknowledged",
    messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED: "cleared",
    messages.ALARM_STATE_SHELVED: "shelved",
    messages.ALARM_STATE_SUPPRESSED_BY_DESIGN: "suppressed",
    messages.ALARM_STATE_OUT_OF_SERVICE: "out of service",
}


def draw(run: Run) -> tuple[EventLog, ...]:
    """One log of both."""
    first_ns, _ = run.span_ns
    looks = {change.time_ns: change for change in run.alarms if change.event == SUSPECTED}  # alarms of one look agree
    events = [_of_alarm(change, first_ns) for change in run.alarms if change.event != SUSPECTED]
    events += [_of_suspects(change, first_ns) for change in looks.values()]
    events += [_of_fault(change, first_ns) for change in run.faults]
    return (EventLog("Alarms and faults", tuple(sorted(events, key=lambda event: event.time_ns))),)


def _of_alarm(change: AlarmChange, first_ns: int) -> Event:
    word = _WORDS.get(change.state, str(change.state))
    colour = ALARM if change.state == messages.ALARM_STATE_UNACKNOWLEDGED else QUIET
    return Event(change.time_ns, word, f"{_at(change.time_ns, first_ns)}  {change.alarm}: {change.text}", colour)


def _of_suspects(change: AlarmChange, first_ns: int) -> Event:
    told = suspects_text(change.suspects, first_ns)
    return Event(change.time_ns, "suspect", f"{_at(change.time_ns, first_ns)}  {told}", ALARM)


def _of_fault(change: FaultChange, first_ns: int) -> Event:
    done = "injected" if change.active else "taken away"
    return Event(
        change.time_ns,
        "fault",
        f"{_at(change.time_ns, first_ns)}  {done}: {change.specification or change.cause}",
        FAULT,
    )


def _at(time_ns: int, first_ns: int) -> str:
    return f"{to_minutes(time_ns, first_ns):.1f} min"


PANEL = Panel("Alarms", draw)
