"""The life of each alarm as a line of its states, and a log of what was raised and cleared and of the true faults."""

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.suspects import suspects_text
from reactorwatch.records.record import to_minutes
from recorder.columns.run import AlarmChange, FaultChange, Run
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


def draw(run: Run) -> tuple[View, ...]:
    """The lanes, and one log of alarms, suspects and faults."""
    known_ns = run.earlier.suspected_ns
    looks = {  # alarms of one look agree
        change.time_ns: change for change in run.alarms if change.event == SUSPECTED and change.time_ns != known_ns
    }
    logged = (change for change in run.alarms if change.event not in (SUSPECTED, LISTED))
    events = [_of_alarm(change, run.zero_ns) for change in logged]
    events += [_of_suspects(change, run.zero_ns) for change in looks.values()]
    events += [_of_fault(change, run.zero_ns) for change in run.faults]
    log = EventLog("Alarms and faults", tuple(sorted(events, key=lambda event: event.time_ns)))
    lines = tuple(_line(run, alarm) for alarm in dict.fromkeys(change.alarm for change in run.alarms))
    return (StateLines("Alarm states", lines, _COLOURS), log)


def _line(run: Run, alarm: str) -> StateLine:
    """The states of an alarm; one that is raised as the first thing that is heard of it was normal until then."""
    changes = {change.time_ns: change for change in run.alarms if change.alarm == alarm}  # the last of a moment counts
    first = next(iter(changes.values()))
    times, states = list(changes), [_word(change.state) for change in changes.values()]
    begun_ns = max(run.first_ns, run.zero_ns)  # of a run that is joined late, the first sample heard is not its first
    if alarm not in run.earlier.states and first.event == "raised" and begun_ns < first.time_ns:
        times, states = [begun_ns, *times], ["normal", *states]
    return StateLine(alarm, tuple(times), tuple(states))


def _word(state: int) -> str:
    return _WORDS.get(state, str(state))


def _of_alarm(change: AlarmChange, zero_ns: int) -> Event:
    word = _word(change.state)
    colour = ALARM if change.state == messages.ALARM_STATE_UNACKNOWLEDGED else QUIET
    return Event(change.time_ns, word, f"{_at(change.time_ns, zero_ns)}  {change.alarm}: {change.text}", colour)


def _of_suspects(change: AlarmChange, zero_ns: int) -> Event:
    told = suspects_text(change.suspects, zero_ns)
    return Event(change.time_ns, "suspect", f"{_at(change.time_ns, zero_ns)}  {told}", ALARM)


def _of_fault(change: FaultChange, zero_ns: int) -> Event:
    done = "injected" if change.active else "taken away"
    return Event(
        change.time_ns,
        "fault",
        f"{_at(change.time_ns, zero_ns)}  {done}: {change.specification or change.cause}",
        FAULT,
    )


def _at(time_ns: int, zero_ns: int) -> str:
    return f"{to_minutes(time_ns, zero_ns):.1f} min"


PANEL = Panel("Alarms", draw)
