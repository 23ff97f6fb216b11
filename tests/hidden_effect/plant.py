"""Events of a run and their measurements. The equations are in `reactor.py`."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from tests.hidden_effect import reactor
from tests.hidden_effect.courses import Array, HiddenCourse, values
from tests.hidden_effect.solver import Places, analysed, run

STEP_MIN = 0.0025
BEFORE_MIN = 30.0
"""So long before its first row a plant has been running, at the first command."""

PUSH_MIN = 0.02
"""The process noise is white but held so long."""

TOGETHER_MIN = 1e-9
"""Moments nearer to each other are one, by rounding."""

HISTORY_MIN = 0.01
"""So often the concentration is remembered, where an analyser shows an old one."""


class Controller(NamedTuple):
    """A proportional controller: qc = base + dither + gain (T - set point), within what the valve can do.

    Attributes:
        gain: l/min/K.
        base: l/min, at the set point.
        lower: l/min.
        upper: l/min.
    """

    gain: float
    base: float
    lower: float
    upper: float


@dataclass(frozen=True, eq=False)
class Plan:
    """Plan of a run.

    Attributes:
        time_min: times of the rows.
        command: command in each row, l/min, held until the next one; with a controller the dither.
        deviations: deviations by name of the effect.
        constants: constants of the effects, see `reactor`.
        interpolated: true if the command is linear between rows instead.
        controller: controller of the valve, if any.
        set_point_K: set point of the controller in each row.
        measured_noise_K: noise of the controller's temperature in each row.
        process_sd: process noise of C and T, each in its unit per square root of a minute.
        seed: seed of the process noise.
        start: C and T in the first row; None: the state after `BEFORE_MIN`.
    """

    time_min: Array
    command: Array
    deviations: Mapping[str, HiddenCourse] = field(default_factory=dict)
    constants: tuple[float, float, float] = (15e3, 100.0, 2.0)
    interpolated: bool = False
    controller: Controller | None = None
    set_point_K: Array | None = None  # noqa: N815 # K is the unit
    measured_noise_K: Array | None = None  # noqa: N815 # as above
    process_sd: tuple[float, float] = (0.0, 0.0)
    seed: int = 0
    start: tuple[float, float] | None = None


class Played(NamedTuple):
    """Course of a run, row by row.

    Attributes:
        qc: commanded flow, l/min.
        concentration: noise-free reading of the analyser, mol/l.
        temperature: noise-free reading of the thermometer, K.
        state: C and T in the reactor, shape (rows, 2).
    """

    qc: Array
    concentration: Array
    temperature: Array
    state: Array


def play(plan: Plan, step_min: float = STEP_MIN) -> Played:
    """Run a plan."""
    names = list(plan.deviations)
    effects = np.array([reactor.EFFECTS.index(name) for name in names], dtype=np.int64)
    numbers = [plan.deviations[name].numbers for name in names]
    offsets = np.concatenate([[0], np.cumsum([item.size for item in numbers])]).astype(np.int64)
    flat = np.concatenate([*numbers, np.empty(0)])
    timing = plan.deviations.get("sample_timing")
    input_min, command = _applied(plan, timing)
    moments = _moments(plan, input_min)
    rows = np.full(moments.size, -1)
    rows[np.searchsorted(moments, plan.time_min)] = np.arange(plan.time_min.size)
    middle = 0.5 * (moments[1:] + moments[:-1])
    place = np.maximum(np.searchsorted(input_min, middle, "right") - 1, 0)
    given, slope = command[place], np.zeros(middle.size)
    if plan.interpolated:
        after = np.minimum(place + 1, command.size - 1)
        slope = (command[after] - command[place]) / np.maximum(input_min[after] - input_min[place], 1e-9)
        slope[middle < input_min[0]] = 0.0
        given = given + slope * (moments[:-1] - input_min[place])
    push = _push(plan, moments)
    controller = plan.controller or Controller(0.0, 0.0, 0.0, 0.0)
    count = plan.time_min.size
    zeros = np.zeros(count)
    state, T, qc = run(
        moments,
        rows,
        given,
        slope,
        push,
        plan.controller is not None,
        np.array(controller),
        zeros if plan.set_point_K is None else plan.set_point_K,
        zeros if plan.measured_noise_K is None else plan.measured_noise_K,
        plan.command,
        effects,
        flat,
        offsets,
        np.array(plan.constants),
        np.array(_start(plan)),
        step_min,
    )
    delay = plan.deviations.get("concentration_delay")
    C = analysed(plan.time_min, moments, state, effects, flat, offsets, delay is not None)
    at_rows = state[np.searchsorted(moments, plan.time_min), :2]
    return Played(qc if plan.controller is not None else plan.command, C, T, at_rows)


def _start(plan: Plan) -> tuple[float, float]:
    return (0.1, 438.54) if plan.start is None else plan.start


def _applied(plan: Plan, timing: HiddenCourse | None) -> tuple[Array, Array]:
    """When the plant feels the command change, and to what; what is stamped m too late is felt m before its stamp."""
    if timing is None:
        return plan.time_min, plan.command

    def row(time_min: Array, middle: Array) -> Places:
        late = values(timing.numbers, time_min, middle)
        return np.maximum(np.searchsorted(plan.time_min, time_min + late + 1e-12, "right") - 1, 0)

    grid = np.arange(plan.time_min[0] - 1.0, plan.time_min[-1] + 0.005, 0.005)
    sides = np.unique(np.concatenate([grid, timing.breaks_min(grid[0], grid[-1])]))
    low, high = sides[:-1].copy(), sides[1:].copy()
    before, after = row(low, low + 1e-9), row(high, high - 1e-9)
    for _ in range(30):
        half = 0.5 * (low + high)
        passed = row(half, half) != before
        low, high = np.where(passed, low, half), np.where(passed, half, high)
    moved = before != after
    times = np.concatenate([sides[:-1], high[moved]])
    order = np.argsort(times, kind="stable")
    rows = np.concatenate([before, after[moved]])[order]
    new = np.append(True, np.diff(rows) != 0)
    return times[order][new], plan.command[rows[new]]


def _moments(plan: Plan, input_min: Array) -> Array:
    begin, end = float(plan.time_min[0]), float(plan.time_min[-1])
    if plan.start is None:
        begin -= BEFORE_MIN
    parts = [plan.time_min, np.array([begin]), input_min]
    parts += [course.breaks_min(begin, end) for course in plan.deviations.values()]
    if any(plan.process_sd):
        parts.append(np.arange(begin, end, PUSH_MIN))
    if "concentration_delay" in plan.deviations:
        parts.append(np.arange(begin, end, HISTORY_MIN))
    moments = np.unique(np.concatenate(parts))
    moments = moments[(moments >= begin) & (moments <= end)]
    row = np.isin(moments, plan.time_min)
    near = np.diff(moments) < TOGETHER_MIN
    near_row = np.append(near & row[1:], False) | np.append(False, near & row[:-1])
    return np.asarray(moments[row | ~(near_row | np.append(False, near))])


def _push(plan: Plan, moments: Array) -> Array:
    """Process noise added to the rates of C and T, held from moment to moment."""
    if not any(plan.process_sd):
        return np.zeros((moments.size - 1, 2))
    place = np.floor((moments[:-1] - moments[0]) / PUSH_MIN + 1e-6).astype(int)
    drawn = np.random.default_rng([plan.seed, 7]).standard_normal((place[-1] + 1, 2))
    return np.asarray(drawn[place] * np.array(plan.process_sd) / np.sqrt(PUSH_MIN))
