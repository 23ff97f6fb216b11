"""The reactor's state in the plane of concentration and temperature.

In the plane a disturbance is a loop that comes back, and a reactor that leaves its operating branch goes away for
good, which over time both look like a swing at first.
"""

import numpy as np
from numpy.typing import NDArray

from reactorwatch.contract import messages_pb2 as messages
from recorder.panels.base import ALARM, FAULT, MEASURED, Panel, PlaneMark, PlanePath, PlanePlot
from recorder.run import Run

_STANDING = (messages.ALARM_STATE_UNACKNOWLEDGED, messages.ALARM_STATE_ACKNOWLEDGED)


def draw(run: Run) -> tuple[PlanePlot, ...]:
    """The path, in another colour while an alarm stands; nothing if C and T were never measured together."""
    if "C" not in run.measured or "T" not in run.measured:
        return ()
    concentration, temperature = run.measured["C"], run.measured["T"]
    time_ns, at_c, at_t = np.intersect1d(concentration.time_ns, temperature.time_ns, return_indices=True)
    c, t = concentration.value[at_c], temperature.value[at_t]
    together = np.isfinite(c) & np.isfinite(t)
    if not together.any():
        return ()
    c, t = np.where(together, c, np.nan), np.where(together, t, np.nan)
    alarmed = _alarm_stands(run, time_ns)
    # a step belongs to the state that it ends in; its first point too, so that the line is not broken there
    towards = np.append(alarmed[1:], alarmed[-1])
    paths = [
        PlanePath(name, np.where(mask, c, np.nan), np.where(mask, t, np.nan), colour)
        for name, mask, colour in (
            ("no alarm", ~alarmed | ~towards, MEASURED),
            ("alarm stands", alarmed | towards, ALARM),
        )
        if mask.any()
    ]
    marks: list[PlaneMark] = []
    onset = next((change.onset_ns for change in run.faults if change.active), None)
    raised = next((change.time_ns for change in run.alarms if change.state in _STANDING), None)
    for name, event_ns, colour in (("fault", onset, FAULT), ("alarm", raised, ALARM)):
        row = int(np.searchsorted(time_ns, event_ns)) if event_ns is not None else time_ns.size
        if row < time_ns.size and together[row]:
            marks.append(PlaneMark(name, float(c[row]), float(t[row]), colour))
    labels = (f"C, {run.units['C']}", f"T, {run.units['T']}")
    return (PlanePlot("Phase plane", *labels, tuple(paths), tuple(marks)),)


def _alarm_stands(run: Run, time_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Shape (times,): whether any alarm stands."""
    stands = np.zeros(time_ns.size, bool)
    standing: set[str] = set()
    for change in run.alarms:
        (standing.add if change.state in _STANDING else standing.discard)(change.alarm)
        stands[np.searchsorted(time_ns, change.time_ns) :] = bool(standing)
    return stands


PANEL = Panel("Phase plane", draw)
