"""Alarms, the promise of false alarms, and the health of the nodes: three panels."""

from collections.abc import Callable
from itertools import cycle
from operator import attrgetter

import numpy as np

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.records.record import to_minutes
from reactorwatch.results.promise import state_promise
from reactorwatch.sentences.alarm import suspects_text
from reactorwatch.sentences.promise import describe_sizes
from recorder.columns import LISTED, RunColumns, times_of
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

_STATES: dict[int, tuple[str, Colour]] = {
    messages.ALARM_STATE_NORMAL: ("normal", INPUT),
    messages.ALARM_STATE_UNACKNOWLEDGED: ("raised", ALARM),
    messages.ALARM_STATE_ACKNOWLEDGED: ("acknowledged", PREDICTED),
    messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED: ("cleared", RESIDUAL),
    messages.ALARM_STATE_SHELVED: ("shelved", MEASURED),
    messages.ALARM_STATE_SUPPRESSED_BY_DESIGN: ("suppressed", QUIET),
    messages.ALARM_STATE_OUT_OF_SERVICE: ("out of service", QUIET),
}
"""Word and colour of each state of an alarm."""


def draw_alarms(run: RunColumns) -> tuple[View, ...]:
    """State lanes of the alarms, and one log of alarms, suspects and faults."""
    events = []
    for change in run.alarms:
        if change.event != LISTED:
            colour = ALARM if change.state == messages.ALARM_STATE_UNACKNOWLEDGED else QUIET
            text = f"{change.alarm}: {change.text}"
            events.append(_event(run, change.time_ns, _word(change.state), text, colour))
    for incident in run.incidents:
        text = suspects_text(incident.suspects, run.zero_ns)
        events.append(_event(run, incident.time_ns, "suspect", text, ALARM))
    for fault in run.faults:
        text = f"{'injected' if fault.active else 'removed'}: {fault.specification or fault.cause}"
        events.append(_event(run, fault.time_ns, "fault", text, FAULT))
    log = EventLog("Alarms and faults", tuple(sorted(events, key=lambda event: event.time_ns)))
    lines = tuple(_line(run, alarm) for alarm in dict.fromkeys(change.alarm for change in run.alarms))
    return (StateLines("Alarm states", lines, dict(_STATES.values())), log)


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
    return _STATES[state][0] if state in _STATES else str(state)


def _event(run: RunColumns, time_ns: int, kind: str, text: str, colour: Colour) -> Event:
    """Event whose text begins with its minute."""
    return Event(time_ns, kind, f"{to_minutes(time_ns, run.zero_ns):.1f} min  {text}", colour)


ALARMS = Panel("Alarms", draw_alarms)


def draw_promise(run: RunColumns) -> tuple[View, ...]:
    """Plot of alarms found and promised, and a log of the promise in words with the power."""
    if not run.promises:
        return ()
    time_ns = times_of(run.promises)
    promised = np.array([item.expected_so_far for item in run.promises], np.float64)
    found = np.array([item.found for item in run.promises], np.float64)
    plot = TimePlot(
        "Alarms since the training: found and promised",
        "",
        (Series("promised", time_ns, promised, LIMIT), Series("found", time_ns, found, ALARM, held=True)),
    )
    return plot, EventLog("Promise and power", tuple(_promise_events(run)))


def _promise_events(run: RunColumns) -> list[Event]:
    """One event for each change of what is stated; the counts alone are drawn."""
    events: list[Event] = []
    before: tuple[object, ...] = ()
    for item in run.promises:
        holds = item.kept and not item.drifted
        power = [describe_sizes(each) for each in state_promise(item)[1]]
        stated = (item.found, holds, power)
        if stated == before:
            continue
        events.append(_event(run, item.time_ns, "promise", item.text, QUIET if holds else ALARM))
        if not before or power != before[2]:
            events += [_event(run, item.time_ns, "power", f"seen in nine of ten: {line}", QUIET) for line in power]
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
    lags = _health_lines(run, attrgetter("lag_ms"))
    problems = _health_lines(
        run, lambda item: item.lost + item.late + item.refused + item.duplicated + item.out_of_order, held=True
    )
    return (
        StateLines("Node phases", lanes, _PHASES),
        TimePlot("Lag between receipt and the end of processing", "ms", lags),
        TimePlot("Lost, late, refused, duplicate or out of order", "messages since the start", problems),
    )


def _health_lines(run: RunColumns, of: Callable[[messages.Health], float], *, held: bool = False) -> tuple[Series, ...]:
    return tuple(
        Series(node, times_of(reports), np.array([of(item) for item in reports], np.float64), colour, held=held)
        for (node, reports), colour in zip(sorted(run.health.items()), cycle(SEVERAL), strict=False)
    )


HEALTH = Panel("Health", draw_health)
