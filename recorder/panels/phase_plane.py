"""The process in the plane of its first two outputs, among the steady states of its equations.

In the plane a disturbance is a loop that comes back, and a reactor that leaves its operating branch goes away for
good, which over time both look like a swing at first.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.process.steady_state import SteadyState
from recorder.columns.process_annotations import operating_branch, process_of, rests
from recorder.columns.run import Run, Times, Values
from recorder.panels.base import (
    ALARM,
    FAULT,
    MEASURED,
    STABLE,
    UNSTABLE,
    Box,
    Panel,
    PlaneMark,
    PlanePath,
    PlanePlot,
)

MOST_POINTS = 4000
"""Of the path in a stretch; of more rows those are drawn that are farthest out."""
MARGIN = 0.05
"""The branch is drawn over the levels of the input that there were, and this share of it to either side at least."""

_STANDING = (messages.ALARM_STATE_UNACKNOWLEDGED, messages.ALARM_STATE_ACKNOWLEDGED)


def draw(run: Run) -> tuple[PlanePlot, ...]:
    """The path close by, and among all steady states; nothing if no process is known that has these signals."""
    model = process_of({name: run.units.get(name, "") for name in run.seen})
    if model is None or len(model.outputs) < 2 or len(model.inputs) != 1:
        return ()
    (input_,), (x_output, y_output) = model.inputs, model.outputs[:2]
    level, x_seen, y_seen = (run.seen[name] for name in (input_.name, x_output.name, y_output.name))
    time_ns, x, y = _together(run, x_output.name, y_output.name)
    if not (level.rows and np.isfinite(x).any()):
        return ()
    around = MARGIN * abs(level.mean)
    ends = (min(level.lowest, level.mean - around), max(level.highest, level.mean + around))
    branch = operating_branch(model.name, *ends, level.mean)
    said = float(f"{level.mean:.4g}")
    states = rests(model.name, said) if branch else ()
    data = Box(x_seen.lowest, x_seen.highest, y_seen.lowest, y_seen.highest)
    near, far = (_around(points, data) for points in (branch, (*branch, *states)))
    marks = tuple(_mark(state) for state in states)
    labels = (f"{x_output.name}, {x_output.unit}", f"{y_output.name}, {y_output.unit}")
    note = f"steady states at {input_.name} = {said:g} {input_.unit}"
    path = PlanePlot("", *labels, near, data, int(time_ns[-1]), _paths(run, time_ns, x, y), _curves(branch), note=note)
    at_hand = tuple(mark for mark, state in zip(marks, states, strict=True) if state is states[-1])
    return (
        path._replace(
            title="Around the operating branch",
            shown=_union(near, data),
            marks=at_hand,
            events=_events(run, time_ns, x, y),
        ),
        path._replace(title="Among all steady states", box=far, shown=_union(far, data), marks=marks),
    )


def _together(run: Run, x_name: str, y_name: str) -> tuple[Times, Values, Values]:
    """Both where both were measured at one time, also just before the stretch; NaN where one is unusable."""
    both = [
        [item for item in (run.earlier.last.get(name), run.measured.get(name)) if item is not None]
        for name in (x_name, y_name)
    ]
    if not all(both):
        return np.empty(0, np.int64), np.empty(0), np.empty(0)
    x_times, y_times = (np.concatenate([item.time_ns for item in parts]) for parts in both)
    x, y = (np.concatenate([item.value for item in parts]) for parts in both)
    time_ns, at_x, at_y = np.intersect1d(x_times, y_times, return_indices=True)
    there = np.isfinite(x[at_x]) & np.isfinite(y[at_y])
    return time_ns, np.where(there, x[at_x], np.nan), np.where(there, y[at_y], np.nan)


def _paths(run: Run, time_ns: Times, x: Values, y: Values) -> tuple[PlanePath, ...]:
    """The path, in another colour while an alarm stands."""
    alarmed = _alarm_stands(run, time_ns)
    rows = _farthest(x, y)
    x, y, alarmed = x[rows], y[rows], alarmed[rows]
    # a step belongs to the state that it ends in; its first point too, so that the line is not broken there
    towards = np.append(alarmed[1:], alarmed[-1])
    return tuple(
        PlanePath(name, np.where(mask, x, np.nan), np.where(mask, y, np.nan), colour)
        for name, mask, colour in (
            ("no alarm", ~alarmed | ~towards, MEASURED),
            ("alarm stands", alarmed | towards, ALARM),
        )
        if mask.any()
    )


def _farthest(x: Values, y: Values) -> NDArray[np.int64]:
    """The rows to draw: of each group of rows the lowest and the highest of either output, in order of time."""
    if x.size <= MOST_POINTS:
        return np.arange(x.size)
    each = -(-x.size // (MOST_POINTS // 4))
    whole = x.size - x.size % each
    first = np.arange(0, whole, each)
    rows = [np.arange(whole, x.size)]
    for values in (x, y):
        groups = values[:whole].reshape(-1, each)
        rows.append(first + np.argmin(np.where(np.isfinite(groups), groups, np.inf), axis=1))
        rows.append(first + np.argmax(np.where(np.isfinite(groups), groups, -np.inf), axis=1))
    return np.unique(np.concatenate(rows))


def _alarm_stands(run: Run, time_ns: Times) -> NDArray[np.bool_]:
    """Shape (times,): whether any alarm stands."""
    standing = {alarm for alarm, state in run.earlier.states.items() if state in _STANDING}
    stands = np.full(time_ns.size, bool(standing))
    for change in run.alarms:
        (standing.add if change.state in _STANDING else standing.discard)(change.alarm)
        stands[np.searchsorted(time_ns, change.time_ns) :] = bool(standing)
    return stands


def _events(run: Run, time_ns: Times, x: Values, y: Values) -> tuple[PlaneMark, ...]:
    """Where the first fault set in and the first alarm was raised, if that was in this stretch."""
    onset = run.earlier.onset_ns
    if onset is None:
        onset = next((change.onset_ns for change in run.faults if change.active), None)
    raised = None
    if not run.earlier.states:
        raised = next((change.time_ns for change in run.alarms if change.state in _STANDING), None)
    marks = []
    for name, event_ns, colour in (("fault sets in", onset, FAULT), ("first alarm", raised, ALARM)):
        if event_ns is not None and time_ns[0] <= event_ns <= time_ns[-1]:
            row = int(np.searchsorted(time_ns, event_ns))
            if np.isfinite(x[row]):
                marks.append(PlaneMark(name, float(x[row]), float(y[row]), colour))
    return tuple(marks)


def _mark(state: SteadyState) -> PlaneMark:
    x, y = state.outputs[:2].tolist()
    return PlaneMark(state.kind, x, y, STABLE if state.stable else UNSTABLE)


def _curves(branch: Sequence[SteadyState]) -> tuple[PlanePath, ...]:
    """The operating branch, stable and not; a step belongs to the state that it ends in."""
    if not branch:
        return ()
    points = np.array([rest.outputs[:2] for rest in branch])
    stable = np.array([rest.stable for rest in branch])
    unstable = ~stable | np.append(~stable[1:], False) if not stable.all() else np.zeros(stable.size, bool)
    return tuple(
        PlanePath(name, np.where(mask, points[:, 0], np.nan), np.where(mask, points[:, 1], np.nan), colour, width=3.0)
        for name, mask, colour in (("stable branch", stable, STABLE), ("unstable branch", unstable, UNSTABLE))
        if mask.any()
    )


def _around(rests_there: Sequence[SteadyState], data: Box) -> Box:
    """What holds these steady states; what holds the data, if there are none."""
    if not rests_there:
        return data
    points = np.array([rest.outputs[:2] for rest in rests_there])
    (x_lower, y_lower), (x_upper, y_upper) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    return Box(x_lower, x_upper, y_lower, y_upper)


def _union(one: Box, other: Box) -> Box:
    return Box(
        min(one.x_lower, other.x_lower),
        max(one.x_upper, other.x_upper),
        min(one.y_lower, other.y_lower),
        max(one.y_upper, other.y_upper),
    )


PANEL = Panel("Phase plane", draw, arranged="grid")
