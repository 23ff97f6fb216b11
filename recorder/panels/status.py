"""Alarms, the promise of false alarms, and the health of the nodes: three panels."""

from collections.abc import Callable, Iterator
from operator import attrgetter

import numpy as np

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.alarm_text import suspects_text
from reactorwatch.contract.promise_text import describe_sizes, promise_fields
from reactorwatch.records.record import to_minutes
from recorder.columns import LISTED, RunColumns
from recorder.panels.base import (
    ALARM,
    FAULT,
    INPUT,
    LIMIT,
    MEASURED,
    PREDICTED,
    QUIET,
    RESIDUAL,
    SEVERAL,
    Colour,
    Event,
    EventLog,
    Panel,
    Series,
    StateLine,
    StateLines,
    TimePlot,
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


def draw_alarms(run: RunColumns) -> tuple[View, ...]:
    """State lanes of the alarms, and one log of alarms, suspects and faults."""
    logged = (change for change in run.alarms if change.event != LISTED)
    events = [_alarm_event(change, run.zero_ns) for change in logged]
    events += [_suspects_event(incident, run.zero_ns) for incident in run.incidents]
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


def _alarm_event(change: messages.Alarm, zero_ns: int) -> Event:
    word = _word(change.state)
    colour = ALARM if change.state == messages.ALARM_STATE_UNACKNOWLEDGED else QUIET
    return Event(change.time_ns, word, f"{_at(change.time_ns, zero_ns)}  {change.alarm}: {change.text}", colour)


def _suspects_event(incident: messages.Incident, zero_ns: int) -> Event:
    text = suspects_text(incident.suspects, zero_ns)
    return Event(incident.time_ns, "suspect", f"{_at(incident.time_ns, zero_ns)}  {text}", ALARM)


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


ALARMS = Panel("Alarms", draw_alarms)


def draw_promise(run: RunColumns) -> tuple[View, ...]:
    """Plot of alarms found and promised, and a log of the promise in words with the power."""
    if not run.promises:
        return ()
    time_ns = np.array([item.time_ns for item in run.promises], np.int64)
    found, promised = (
        np.array([getattr(item, name) for item in run.promises], np.float64) for name in ("found", "expected_so_far")
    )
    plot = TimePlot(
        "Alarms since the training: found and promised",
        "",
        (
            Series("promised", time_ns, promised, LIMIT),
            Series("found", time_ns, found, ALARM, held=True),
        ),
    )
    return plot, EventLog("Promise and power", tuple(_promise_events(run.promises, run.zero_ns)))


def _promise_events(promises: tuple[messages.Promise, ...], zero_ns: int) -> list[Event]:
    """One event for each change of what is stated; the counts alone are drawn."""
    events: list[Event] = []
    before: tuple[object, ...] = ()
    for item in promises:
        holds = item.kept and not item.drifted
        power = [describe_sizes(each) for each in promise_fields(item)["power"]]
        stated = (item.found, holds, power)
        if stated == before:
            continue
        at = f"{to_minutes(item.time_ns, zero_ns):.1f} min"
        events.append(Event(item.time_ns, "promise", f"{at}  {item.text}", QUIET if holds else ALARM))
        if not before or power != before[2]:
            events += [Event(item.time_ns, "power", f"{at}  seen in nine of ten: {line}", QUIET) for line in power]
        before = stated
    return events


PROMISE = Panel("Promise", draw_promise)


_PHASES = {
    "waiting": FAULT,
    "training": MEASURED,
    "watching": INPUT,
    "running": INPUT,
    "recording": INPUT,
    "not recording": ALARM,
    "stopped": QUIET,
}


def draw_health(run: RunColumns) -> tuple[View, ...]:
    """Lanes of the nodes' phases, and plots of their lags and of problem counts."""
    if not run.health:
        return ()
    lanes = tuple(
        StateLine(node, tuple(report.time_ns for report in reports), tuple(report.phase for report in reports))
        for node, reports in sorted(run.health.items())
    )
    return (
        StateLines("Node phases", lanes, _PHASES),
        TimePlot(
            "Lag between receipt and the end of processing", "ms", tuple(_health_lines(run, attrgetter("lag_ms")))
        ),
        TimePlot(
            "Lost, late, refused, duplicate or out of order",
            "messages since the start",
            tuple(_health_lines(run, _problems, held=True)),
        ),
    )


def _problems(report: messages.Health) -> float:
    return float(report.lost + report.late + report.refused + report.duplicated + report.out_of_order)


def _health_lines(run: RunColumns, of: Callable[[messages.Health], float], *, held: bool = False) -> Iterator[Series]:
    for index, (node, reports) in enumerate(sorted(run.health.items())):
        time_ns = np.array([report.time_ns for report in reports], np.int64)
        yield Series(node, time_ns, np.array([of(item) for item in reports]), SEVERAL[index % len(SEVERAL)], held=held)


HEALTH = Panel("Health", draw_health)
