"""Alarm states over time, and a log of alarms, suspects and injected faults."""

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.alarm_text import suspects_text
from reactorwatch.records.record import to_minutes
from recorder.columns.run import AlarmChange, RunColumns
from recorder.columns.run_reader import LISTED, SUSPECTED
from recorder.panels.base import (
    ALARM,
    FAULT,
    INPUT,
    MEASURED,
    PREDICTED,
    QUIET,
    RESIDUAL,
    Colour,
    Event,
    EventLog,
    Panel,
    StateLine,
    StateLines,
    View,
)

_WORDS: dict[int, str] = {
    messages.ALARM_STATE_NORMAL: "normal",
    messages.ALARM_STATE_UNACKNOWLEDGED: "raised",
    messages.ALARM_STATE_ACKNOWLEDGED: "acknowledged",
    messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED: "cleared",
    messages.ALARM_STATE_SHELVED: "shelved",
    messages.ALARM_STATE_SUPPRESSED_BY_DESIGN: "suppressed",
    messages.ALARM_STATE_OUT_OF_SERVICE: "out of service",
}
_COLOURS: dict[str, Colour] = {
    "normal": INPUT,
    "raised": ALARM,
    "acknowledged": PREDICTED,
    "cleared": RESIDUAL,
    "shelved": MEASURED,
    "suppressed": QUIET,
    "out of service": QUIET,
}


def draw(run: RunColumns) -> tuple[View, ...]:
    """State lanes of the alarms, and one log of alarms, suspects and faults."""
    last_ns = run.context.suspects_ns
    suspects = {  # alarms of one time have the same suspects
        change.time_ns: change for change in run.alarms if change.event == SUSPECTED and change.time_ns != last_ns
    }
    logged = (change for change in run.alarms if change.event not in (SUSPECTED, LISTED))
    events = [_alarm_event(change, run.zero_ns) for change in logged]
    events += [_suspects_event(change, run.zero_ns) for change in suspects.values()]
    events += [_fault_event(change, run.zero_ns) for change in run.faults]
    log = EventLog("Alarms and faults", tuple(sorted(events, key=lambda event: event.time_ns)))
    lines = tuple(_line(run, alarm) for alarm in dict.fromkeys(change.alarm for change in run.alarms))
    return (StateLines("Alarm states", lines, _COLOURS), log)


def _line(run: RunColumns, alarm: str) -> StateLine:
    """States of an alarm; normal before the first change, if that raises it."""
    changes = {
        change.time_ns: change for change in run.alarms if change.alarm == alarm
    }  # the last one of equal times counts
    first = next(iter(changes.values()))
    times, states = list(changes), [_word(change.state) for change in changes.values()]
    start_ns = max(run.first_ns, run.zero_ns)  # later than the run's start if it was joined late
    if alarm not in run.context.alarm_states and first.event == "raised" and start_ns < first.time_ns:
        times, states = [start_ns, *times], ["normal", *states]
    return StateLine(alarm, tuple(times), tuple(states))


def _word(state: int) -> str:
    return _WORDS.get(state, str(state))


def _alarm_event(change: AlarmChange, zero_ns: int) -> Event:
    word = _word(change.state)
    colour = ALARM if change.state == messages.ALARM_STATE_UNACKNOWLEDGED else QUIET
    return Event(change.time_ns, word, f"{_at(change.time_ns, zero_ns)}  {change.alarm}: {change.text}", colour)


def _suspects_event(change: AlarmChange, zero_ns: int) -> Event:
    text = suspects_text(change.suspects, zero_ns)
    return Event(change.time_ns, "suspect", f"{_at(change.time_ns, zero_ns)}  {text}", ALARM)


def _fault_event(change: messages.Fault, zero_ns: int) -> Event:
    action = "injected" if change.active else "removed"
    return Event(
        change.time_ns,
        "fault",
        f"{_at(change.time_ns, zero_ns)}  {action}: {change.specification or change.cause}",
        FAULT,
    )


def _at(time_ns: int, zero_ns: int) -> str:
    return f"{to_minutes(time_ns, zero_ns):.1f} min"


PANEL = Panel("Alarms", draw)
