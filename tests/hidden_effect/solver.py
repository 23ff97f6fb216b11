"""Solves the equations of `reactor.py` row by row: valve logic, controller and sensors in between.

Between two moments (rows, jumps of the input, onsets, kinks) everything is smooth, so the classical fourth-order method
of Runge and Kutta with short steps, shorter where a lag is, is exact to eight digits: `test_plant.py` holds it against
a solver of SciPy with a tight tolerance, and against its order.
"""

import numpy as np
from numpy.typing import NDArray

from reactorwatch.codegen.numba_kernel import jit
from tests.hidden_effect import reactor
from tests.hidden_effect.courses import Array, value
from tests.hidden_effect.reactor import (
    C_,
    CONCENTRATION_DELAY,
    DUTY,
    FLOW,
    JACKET_LAG,
    LEAST_LAG_MIN,
    STATES,
    T_,
    TEMPERATURE_LAG,
    THERMOMETER_HYSTERESIS,
    VALVE_BACKLASH,
    VALVE_LAG,
    VALVE_STICTION,
    WALL,
    WELL,
    duty_of,
    flow_of,
    outlet_concentration,
    outlet_temperature,
    rates,
    shown_concentration,
    shown_temperature,
)

Places = NDArray[np.int64]

STEPS_A_LAG = 4.0
DEVIATIONS = len(reactor.EFFECTS)


@jit
def remembered(moments: Array, state: Array, t: float) -> float:
    """The concentration at any time, from values and slopes by Hermite's cubic."""
    if t <= moments[0]:
        return float(state[0, C_])
    after = min(max(int(np.searchsorted(moments, t)), 1), moments.size - 1)
    h = float(moments[after] - moments[after - 1])
    s = (t - float(moments[after - 1])) / h
    low, high = float(state[after - 1, C_]), float(state[after, C_])
    low_slope, high_slope = h * float(state[after - 1, STATES]), h * float(state[after, STATES])
    bend = (1.0 - s) * (low_slope - (high - low)) - s * (high_slope - (high - low))
    return low + s * (high - low) + s * (1.0 - s) * bend


@jit
def deviate(m: Array, effects: Places, flat: Array, offsets: Places, t: float, middle: float) -> None:
    for number in range(effects.size):
        m[effects[number]] = value(flat[offsets[number] : offsets[number + 1]], t, middle)


@jit
def analysed(
    time_min: Array, moments: Array, state: Array, effects: Places, flat: Array, offsets: Places, delayed: bool
) -> Array:
    """Reading of the analyser in each row."""
    m = np.zeros(DEVIATIONS)
    shown = np.empty(time_min.size)
    for row in range(time_min.size):
        t = time_min[row]
        deviate(m, effects, flat, offsets, t, t + 1e-9)
        C = state[np.searchsorted(moments, t), C_]
        if delayed:
            C = remembered(moments, state, t - m[CONCENTRATION_DELAY])
        shown[row] = shown_concentration(outlet_concentration(C, m), m)
    return shown


@jit
def follow(x: Array, valve: float, m: Array) -> None:
    """States behind a lag that there is not are where what they follow is."""
    if m[VALVE_LAG] <= LEAST_LAG_MIN:
        x[FLOW] = valve
    if m[JACKET_LAG] <= LEAST_LAG_MIN:
        x[DUTY] = duty_of(x[T_], flow_of(x[FLOW], m), m)
    if m[TEMPERATURE_LAG] <= LEAST_LAG_MIN:
        x[WELL] = outlet_temperature(x[T_], m)


@jit
def moved(valve: float, command: float, m: Array) -> float:
    """Position of the valve after a command."""
    if m[VALVE_BACKLASH] > 0.0:
        half = 0.5 * float(m[VALVE_BACKLASH])
        return min(max(valve, command - half), command + half)
    return command if abs(command - valve) > m[VALVE_STICTION] else valve


@jit
def run(
    moments: Array,
    rows: Places,
    given: Array,
    slope: Array,
    push: Array,
    controlled: bool,
    controller: Array,
    set_point: Array,
    measured_noise: Array,
    dither: Array,
    effects: Places,
    flat: Array,
    offsets: Places,
    constants: Array,
    start: Array,
    step_min: float,
) -> tuple[Array, Array, Array]:
    history, T_shown, qc = np.zeros((moments.size, STATES + 1)), np.zeros(dither.size), np.zeros(dither.size)
    m = np.zeros(DEVIATIONS)
    x, trial = np.zeros(STATES), np.zeros(STATES)
    k1, k2, k3, k4 = np.zeros(STATES), np.zeros(STATES), np.zeros(STATES), np.zeros(STATES)
    held = controller[1]
    valve = held if controlled else given[0]
    x[C_], x[T_] = start
    x[WALL], x[FLOW] = x[T_], valve
    deviate(m, effects, flat, offsets, moments[0], moments[0] + 1e-9)
    x[DUTY], x[WELL] = duty_of(x[T_], flow_of(valve, m), m), outlet_temperature(x[T_], m)
    stuck = x[WELL]
    for place in range(moments.size):
        t, row = moments[place], rows[place]
        deviate(m, effects, flat, offsets, t, t + 1e-9)
        follow(x, valve, m)
        if m[THERMOMETER_HYSTERESIS] > 0.0:
            half = 0.5 * m[THERMOMETER_HYSTERESIS]
            stuck = min(max(stuck, x[WELL] - half), x[WELL] + half)
        else:
            stuck = x[WELL]
        if row >= 0:
            T_shown[row] = shown_temperature(stuck, m)
            if controlled:
                error = T_shown[row] + measured_noise[row] - set_point[row]
                held = controller[1] + dither[row] + controller[0] * error
                held = min(max(held, controller[2]), controller[3])
                qc[row] = held
        history[place, :STATES] = x
        if place == moments.size - 1:
            break
        end = moments[place + 1]
        middle = 0.5 * (t + end)
        while t < end:
            deviate(m, effects, flat, offsets, t, middle)
            h = step_min
            for lag in (m[VALVE_LAG], m[JACKET_LAG], m[TEMPERATURE_LAG]):
                if lag > LEAST_LAG_MIN:
                    h = min(h, lag / STEPS_A_LAG)
            h = (end - t) / np.ceil((end - t) / h - 1e-9)
            command = held if controlled else given[place] + slope[place] * (t + 0.5 * h - moments[place])
            valve = moved(valve, command, m)
            follow(x, valve, m)
            rates(x, valve, m, constants, k1)
            k1[:2] += push[place]
            if t == moments[place]:
                history[place, STATES] = k1[C_]
            trial[:] = x + 0.5 * h * k1
            deviate(m, effects, flat, offsets, t + 0.5 * h, middle)
            rates(trial, valve, m, constants, k2)
            k2[:2] += push[place]
            trial[:] = x + 0.5 * h * k2
            rates(trial, valve, m, constants, k3)
            k3[:2] += push[place]
            trial[:] = x + h * k3
            last = t + h > end - 1e-12
            t = end if last else t + h
            deviate(m, effects, flat, offsets, t, middle)
            rates(trial, valve, m, constants, k4)
            k4[:2] += push[place]
            x += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    history[-1, STATES] = history[-2, STATES]
    return history, T_shown, qc
