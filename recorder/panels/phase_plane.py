"""Phase plane of the first two outputs, with the steady states of the equations.

In the plane a disturbance is a closed loop, and a reactor that leaves its operating branch does not return. Over time
both look alike at first.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.steady_state import SteadyState, steady_states
from recorder.columns import RunColumns, Times, Values
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
from recorder.panels.signals import find_model

MAX_POINTS = 4000
"""Largest number of points of a path in a segment, as many as a screen can show; beyond it extreme rows are drawn."""

_ACTIVE = (messages.ALARM_STATE_UNACKNOWLEDGED, messages.ALARM_STATE_ACKNOWLEDGED)


def draw(run: RunColumns) -> tuple[PlanePlot, ...]:
    """Path around the operating branch and among all steady states; empty for signals of no known process."""
    model = find_model({name: run.units.get(name, "") for name in run.statistics}, run.process)
    if model is None or len(model.outputs) < 2 or len(model.inputs) != 1:
        return ()
    (input_,), (x_output, y_output) = model.inputs, model.outputs[:2]
    level, x_seen, y_seen = (run.statistics[name] for name in (input_.name, x_output.name, y_output.name))
    time_ns, x, y = _paired_samples(run, x_output.name, y_output.name)
    if not (level.rows and np.isfinite(x).any()):
        return ()
    operating = run.context.levels.get(input_.name, level.mean)
    around = 0.05 * abs(operating)  # the branch is drawn to either side at least
    ends = (min(level.lowest, operating - around), max(level.highest, operating + around))
    branch = operating_branch(model, *ends, operating)
    rounded = float(f"{operating:.4g}")
    states = steady_states_at(model, rounded) if branch else ()
    data = Box(x_seen.lowest, x_seen.highest, y_seen.lowest, y_seen.highest)
    near, far = (_around(points, data) for points in (branch, (*branch, *states)))
    marks = tuple(
        PlaneMark(state.kind, float(x_mark), float(y_mark), STABLE if state.stable else UNSTABLE)
        for state in states
        for x_mark, y_mark in [state.outputs[:2]]
    )
    labels = (f"{x_output.name}, {x_output.unit}", f"{y_output.name}, {y_output.unit}")
    note = f"steady states at {input_.name} = {rounded:g} {input_.unit}"
    path = PlanePlot("", *labels, near, data, int(time_ns[-1]), _paths(run, time_ns, x, y), _curves(branch), note=note)
    events = _events(run, time_ns, x, y)
    return (
        path._replace(title="Around the operating branch", shown=_union(near, data), marks=marks[-1:], events=events),
        path._replace(title="Among all steady states", box=far, shown=_union(far, data), marks=marks),
    )


@lru_cache(maxsize=256)
def steady_states_at(model: ProcessModel, level: float) -> tuple[SteadyState, ...]:
    """All steady states of a process at a level of its only input, computed once; the last is the operating point."""
    return tuple(steady_states(model, np.array([level])))


def operating_branch(model: ProcessModel, lowest: float, highest: float, level: float) -> list[SteadyState]:
    """Steady states of the operating branch between two levels of the only input, by rising level.

    They extend as far as the branch does from the operating level. The grid of levels does not depend on the ends
    unless they are far apart. Empty if the process has no steady state at the operating level.
    """
    bounds = model.inputs[0]
    if not bounds.lower <= level <= bounds.upper:
        return []
    lowest, highest = max(lowest, bounds.lower), min(highest, bounds.upper)
    step = 10.0 ** math.floor(math.log10(max(abs(level), 1e-9))) / 40
    while (highest - lowest) / step > 32:  # points, each of which takes a solution of the equations
        step *= 2.0
    first, last, start = math.ceil(lowest / step), math.floor(highest / step), round(level / step)
    operating = steady_states_at(model, start * step)[-1:]
    if not operating:
        return []
    below = _continue_branch(model, operating[0], [index * step for index in range(start - 1, first - 1, -1)])
    above = _continue_branch(model, operating[0], [index * step for index in range(start + 1, last + 1)])
    return [*reversed(below), *operating, *above]


def _continue_branch(model: ProcessModel, state: SteadyState, levels: list[float]) -> list[SteadyState]:
    """Continue the branch of a steady state from level to level until it ends."""
    scale = np.array([variable.scale for variable in model.states])
    branch: list[SteadyState] = []
    for level in levels:
        candidates = steady_states_at(model, level)
        distances = [float(np.linalg.norm((item.state - state.state) / scale)) for item in candidates]
        if not candidates or min(distances) > 2.0:  # scales of the states: it is another branch
            break
        state = candidates[int(np.argmin(distances))]
        branch.append(state)
    return branch


def _paired_samples(run: RunColumns, x_name: str, y_name: str) -> tuple[Times, Values, Values]:
    """Samples of both signals at equal times, also just before the segment; NaN where one is not measured."""
    both = [
        [item for item in (run.context.last_samples.get(name), run.samples.get(name)) if item is not None]
        for name in (x_name, y_name)
    ]
    if not all(both):
        return np.empty(0, np.int64), np.empty(0), np.empty(0)
    x_times, y_times = (np.concatenate([item.time_ns for item in parts]) for parts in both)
    x, y = (np.concatenate([item.value for item in parts]) for parts in both)
    time_ns, at_x, at_y = np.intersect1d(x_times, y_times, return_indices=True)
    there = np.isfinite(x[at_x]) & np.isfinite(y[at_y])
    return time_ns, np.where(there, x[at_x], np.nan), np.where(there, y[at_y], np.nan)


def _paths(run: RunColumns, time_ns: Times, x: Values, y: Values) -> tuple[PlanePath, ...]:
    """Path, in another colour while an alarm is active."""
    alarmed = _alarm_is_active(run, time_ns)
    rows = _envelope_rows(x, y)
    x, y, alarmed = x[rows], y[rows], alarmed[rows]
    # a step has the state of its end; its first point is included, so that the line is continuous
    towards = np.append(alarmed[1:], alarmed[-1])
    return tuple(
        PlanePath(name, np.where(mask, x, np.nan), np.where(mask, y, np.nan), colour)
        for name, mask, colour in (
            ("no alarm", ~alarmed | ~towards, MEASURED),
            ("alarm active", alarmed | towards, ALARM),
        )
        if mask.any()
    )


def _envelope_rows(x: Values, y: Values) -> NDArray[np.int64]:
    """Rows to draw, in order of time: in each group, those with the lowest and highest value of either output."""
    if x.size <= MAX_POINTS:
        return np.arange(x.size)
    each = -(-x.size // (MAX_POINTS // 4))
    grouped = x.size - x.size % each
    first = np.arange(0, grouped, each)
    rows = [np.arange(grouped, x.size)]
    for values in (x, y):
        groups = values[:grouped].reshape(-1, each)
        rows.append(first + np.argmin(np.where(np.isfinite(groups), groups, np.inf), axis=1))
        rows.append(first + np.argmax(np.where(np.isfinite(groups), groups, -np.inf), axis=1))
    return np.unique(np.concatenate(rows))


def _alarm_is_active(run: RunColumns, time_ns: Times) -> NDArray[np.bool_]:
    """True where any alarm is active, shape (times,)."""
    active = {alarm for alarm, state in run.context.alarm_states.items() if state in _ACTIVE}
    is_active = np.full(time_ns.size, bool(active))
    for change in run.alarms:
        (active.add if change.state in _ACTIVE else active.discard)(change.alarm)
        is_active[np.searchsorted(time_ns, change.time_ns) :] = bool(active)
    return is_active


def _events(run: RunColumns, time_ns: Times, x: Values, y: Values) -> tuple[PlaneMark, ...]:
    """Marks of the onset of the first fault and of the first alarm, if in this segment."""
    onset = run.context.onset_ns
    if onset is None:
        onset = next((change.onset_ns for change in run.faults if change.active), None)
    raised = None
    if not run.context.alarm_states:
        raised = next((change.time_ns for change in run.alarms if change.state in _ACTIVE), None)
    marks = []
    for name, event_ns, colour in (("onset of the fault", onset, FAULT), ("first alarm", raised, ALARM)):
        if event_ns is not None and time_ns[0] <= event_ns <= time_ns[-1]:
            row = int(np.searchsorted(time_ns, event_ns))
            if np.isfinite(x[row]):
                marks.append(PlaneMark(name, float(x[row]), float(y[row]), colour))
    return tuple(marks)


def _curves(branch: Sequence[SteadyState]) -> tuple[PlanePath, ...]:
    """Stable and unstable part of the operating branch; a step has the stability of its end."""
    if not branch:
        return ()
    points = np.array([state.outputs[:2] for state in branch])
    stable = np.array([state.stable for state in branch])
    unstable = ~stable | np.append(~stable[1:], False) if not stable.all() else np.zeros(stable.size, bool)
    return tuple(
        PlanePath(name, np.where(mask, points[:, 0], np.nan), np.where(mask, points[:, 1], np.nan), colour, width=3.0)
        for name, mask, colour in (("stable branch", stable, STABLE), ("unstable branch", unstable, UNSTABLE))
        if mask.any()
    )


def _around(states: Sequence[SteadyState], data: Box) -> Box:
    """Bounding box of steady states; that of the data if there are none."""
    if not states:
        return data
    points = np.array([state.outputs[:2] for state in states])
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
