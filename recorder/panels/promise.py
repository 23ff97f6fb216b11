"""Promise of false alarms beside the alarms that came, and the deviations that would be seen."""

import numpy as np

from reactorwatch.records.record import to_minutes
from recorder.columns.run import PromiseReport, RunColumns
from recorder.panels.base import ALARM, LIMIT, QUIET, Event, EventLog, Panel, Series, TimePlot, View


def draw(run: RunColumns) -> tuple[View, ...]:
    """Plot of alarms found and promised, and a log of the promise in words with the power."""
    if not run.promises:
        return ()
    time_ns = np.array([item.time_ns for item in run.promises], np.int64)
    found, promised = (
        np.array([getattr(item, name) for item in run.promises], np.float64) for name in ("found", "expected")
    )
    plot = TimePlot(
        "Alarms since the training: found and promised",
        "",
        (
            Series("promised", time_ns, promised, LIMIT),
            Series("found", time_ns, found, ALARM, held=True),
        ),
    )
    return plot, EventLog("Promise and power", tuple(_events(run.promises, run.zero_ns)))


def _events(promises: tuple[PromiseReport, ...], zero_ns: int) -> list[Event]:
    """One event for each change of what is stated; the counts alone are drawn."""
    events: list[Event] = []
    before: tuple[object, ...] = ()
    for item in promises:
        stated = (item.found, item.holds, item.power)
        if stated == before:
            continue
        at = f"{to_minutes(item.time_ns, zero_ns):.1f} min"
        events.append(Event(item.time_ns, "promise", f"{at}  {item.text}", QUIET if item.holds else ALARM))
        if not before or item.power != before[2]:
            events += [Event(item.time_ns, "power", f"{at}  seen in nine of ten: {line}", QUIET) for line in item.power]
        before = stated
    return events


PANEL = Panel("Promise", draw)
