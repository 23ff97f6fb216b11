"""One step of the extended Kalman filter, from row to row, as one compiled function (equations: see `ekf`).

Between two rows the state takes two integration steps. They meet in the middle of the interval, or at the breakpoint in
it: there the right-hand side jumps, and a step across a jump would lose its order. States that jump at a row do so
before its measurements correct them.

The belief of a filter is one vector: the state x, then its covariance P, column by column. The constants are one vector
as well: parameters, variances of the sensors, variances of the process per minute.
"""

from collections.abc import Sequence
from functools import lru_cache
from math import inf, nan
from typing import Any

import casadi as ca
import msgspec
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import CompiledFunction
from reactorwatch.process.model import MODEL_CACHE_SIZE, ProcessModel
from reactorwatch.process.simulate import reset_function, state_time_step, symbolic_step

LEAST_PROCESS_SD = 1e-6  # in scales of the state; without any process noise its covariance would underflow

MOST_SHARED = 100
"""Size of a belief up to which common subexpressions are looked for. With 14 states that takes a tenth of a second, and
spares a tenth of the operations, a second in two million rows."""


class NoiseLevels(msgspec.Struct, frozen=True):
    """Noise of a process and of its sensors.

    Attributes:
        measurement_sd: standard deviation of each output's noise, in its unit.
        process_sd: one a state, in its unit per square root of a minute: dx = f(x) dt + sd dW.
    """

    measurement_sd: tuple[float, ...]
    process_sd: tuple[float, ...]


def variances(model: ProcessModel, noise: NoiseLevels) -> Array:
    """Variances of the sensors and of the process per minute, as the constants of `row_function`."""
    least = [LEAST_PROCESS_SD * state.scale for state in model.states]
    return np.asarray(np.square(np.concatenate([noise.measurement_sd, np.maximum(noise.process_sd, least)])))


def fill_row(
    new: Any,
    before: Sequence[float] | Array,
    inputs: Sequence[float] | Array,
    time_min: float,
    first_min: float,
    second_min: float,
    measured: Sequence[float] | Array,
    limit: float,
) -> None:
    """Fill the `new` values of `row_function` in place, with one limit for all outputs; kernels compile it."""
    n_u, n_y = len(inputs), len(measured)
    for i in range(n_u):
        new[i], new[n_u + i] = before[i], inputs[i]
    row = 2 * n_u
    new[row], new[row + 1], new[row + 2] = time_min, first_min, second_min
    for i in range(n_y):
        new[row + 3 + i], new[row + 3 + n_y + i] = measured[i], limit


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def row_function(model: ProcessModel) -> ca.Function:
    """Filter a row: (belief, new, constants) -> (belief, outputs).

    new: [inputs of the row before, inputs, time of the row, first step, second step, measured, limits]; NaN is a
    missing value, and a limit is the number of standard deviations beyond which a value does not correct the state.
    outputs: [prediction, innovation, its standard deviation, normalised innovation, its scale, ok flag]; see
    `batch.FilterResult`.
    """
    n_u, n_y = len(model.inputs), len(model.outputs)
    belief, new, constants = _symbols(model, 2 * n_u + 3 + 2 * n_y)
    p, r, q = _constants(model, constants)
    parts = np.cumsum([0, n_u, n_u, 1, 1, 1, n_y, n_y]).tolist()
    before, u, now, first, second, measured, limits = ca.vertsplit(new, parts)
    x, P = _predict(model, belief, before, now, first, second, p, q)
    if model.resets:
        x, P = _reset(model, x, P, u, p, now)
    inside = ca.logic_and(ca.mmin(x - _bounds(model)[0]) >= 0, ca.mmin(_bounds(model)[1] - x) >= 0)
    expected, H = output_function(model)(x, u, p, now)
    beyond = model.noise_function()
    r = r if beyond is None else r + beyond(u, p, now)
    covariance = H @ P @ H.T + ca.diag(r)
    present = ca.fabs(measured) < inf  # false for NaN; CasADi takes x == x for true
    residual = ca.if_else(present, measured - expected, 0.0)
    normalized, scale = _normalize(residual, covariance, present)
    sd = ca.sqrt(ca.diag(covariance))
    x, P = _correct(x, P, H, residual, r, ca.logic_and(present, ca.fabs(residual) <= limits * sd))
    good = ca.logic_and(inside, ca.fabs(ca.sum1(x) + ca.sum1(ca.vec(P))) < inf)
    x = ca.fmin(ca.fmax(x, _bounds(model)[0]), _bounds(model)[1])
    outputs = ca.vertcat(expected, measured - expected, sd, ca.if_else(present, normalized, nan), scale, good)
    results = [ca.densify(ca.vertcat(x, ca.vec(P))), ca.densify(outputs)]
    if belief.numel() <= MOST_SHARED:
        results = ca.cse(results)
    return ca.Function("row", [belief, new, constants], results, ["belief", "new", "constants"], ["after", "outputs"])


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def predict_function(model: ProcessModel) -> ca.Function:
    """Predict two integration steps: (belief, [inputs, time, first step, second step], constants) -> belief."""
    n_u = len(model.inputs)
    belief, new, constants = _symbols(model, n_u + 3)
    p, _, q = _constants(model, constants)
    x, P = _predict(model, belief, new[:n_u], new[n_u], new[n_u + 1], new[n_u + 2], p, q)
    return ca.Function("predict", [belief, new, constants], [ca.densify(ca.vertcat(x, ca.vec(P)))])


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def output_function(model: ProcessModel) -> ca.Function:
    """(x, u, p, t) -> (y, dy/dx)."""
    x, u, p, t, y = model.output_expressions()
    return ca.Function("outputs", [x, u, p, t], [y, ca.densify(ca.jacobian(y, x))])


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def compiled_row(model: ProcessModel) -> CompiledFunction:
    """`row_function` compiled for row after row, up to the first whose ok flag is not set."""
    return CompiledFunction(row_function(model), shared=[2], chained=1, stops=True)


def _symbols(model: ProcessModel, new: int) -> tuple[ca.SX, ca.SX, ca.SX]:
    n_x = len(model.states)
    constants = len(model.parameters) + len(model.outputs) + n_x
    return ca.SX.sym("belief", n_x + n_x * n_x), ca.SX.sym("new", new), ca.SX.sym("constants", constants)


def _constants(model: ProcessModel, constants: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Split into parameters, variances of the sensors and of the process."""
    n_p, n_y = len(model.parameters), len(model.outputs)
    return constants[:n_p], constants[n_p : n_p + n_y], constants[n_p + n_y :]


def _bounds(model: ProcessModel) -> tuple[ca.DM, ca.DM]:
    return ca.DM([state.lower for state in model.states]), ca.DM([state.upper for state in model.states])


def transition(
    model: ProcessModel, point: tuple[ca.SX, ca.SX, ca.SX], steps: Sequence[tuple[ca.SX, ca.SX]], size: ca.SX
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """State after some integration steps, and its derivatives with respect to the state before and to sizes.

    With A and B the Jacobians of the right-hand side at the ends of a step, the derivative with respect to the state is
    the exponential of the mean of A, to fourth order, and that with respect to the sizes follows from the trapezoidal
    rule. On the operating branch the former's entries are within 1 % of those of the step itself, for half the cost of
    the whole row; only covariances and error dynamics depend on it. It neglects that a size that shifts the clock
    shortens the time step of the states.

    Args:
        model: the process.
        point: state before, inputs and parameters.
        steps: start and length of each step.
        size: symbols of the model, a column.
    """
    symbols = [*model.arguments(), model.clock.now, model.clock.middle]
    by = (ca.densify(ca.jacobian(ca.vertcat(*model.rhs), item)) for item in (symbols[0], size))
    slope, step = ca.Function("slope", symbols, list(by)), symbolic_step(model)
    x, u, p = point
    F, G = ca.SX.eye(x.numel()), ca.SX.zeros(x.numel(), size.numel())
    for begin, h in steps:
        middle, before = begin + 0.5 * h, x
        x = step(before, u, p, begin, middle, h)[0]
        passed = state_time_step(model, u, p, begin, middle, h)
        (A, B), (A_end, B_end) = slope(before, u, p, begin, middle), slope(x, u, p, begin + h, middle)
        E = exponential(0.5 * passed * (A + A_end))
        F, G = E @ F, E @ (G + 0.5 * passed * B) + 0.5 * passed * B_end
    return x, F, G


def _predict(
    model: ProcessModel, belief: ca.SX, u: ca.SX, now: ca.SX, first: ca.SX, second: ca.SX, p: ca.SX, q: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Prior mean and covariance after two integration steps, the second of which ends now."""
    n = len(model.states)
    steps = ((now - second - first, first), (now - second, second))
    x, F, _ = transition(model, (belief[:n], u, p), steps, ca.SX(0, 1))
    return x, F @ ca.reshape(belief[n:], n, n) @ F.T + ca.diag(q * (first + second))


def _reset(model: ProcessModel, x: ca.SX, P: ca.SX, u: ca.SX, p: ca.SX, now: ca.SX) -> tuple[ca.SX, ca.SX]:
    """State and covariance after the jumps at a row."""
    reset, before = reset_function(model), ca.SX.sym("before", x.numel())
    after = reset(before, u, p, now)
    after, U = ca.substitute([after, ca.jacobian(after, before)], [before], [x])
    return after, U @ P @ U.T


def exponential(M: ca.SX) -> ca.SX:
    """Matrix exponential to fourth order: 1 + M + M^2/2 + M^3/6 + M^4/24."""
    result = ca.SX.eye(M.size1())
    for divisor in (4, 3, 2, 1):
        result = ca.SX.eye(M.size1()) + M @ result / divisor
    return result


def _correct(x: ca.SX, P: ca.SX, H: ca.SX, residual: ca.SX, r: ca.SX, used: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Posterior mean and covariance after the used measurements, one after the other, in Joseph form."""
    predicted = x
    for index in range(residual.numel()):
        h = H[index, :]
        K = used[index] * (P @ h.T) / (h @ P @ h.T + r[index])
        x = x + K * (residual[index] - h @ (x - predicted))
        I_KH = ca.SX.eye(x.numel()) - K @ h
        P = I_KH @ P @ I_KH.T + K @ K.T * r[index]
    return x, 0.5 * (P + P.T)


def _normalize(residual: ca.SX, covariance: ca.SX, present: ca.SX) -> tuple[ca.SX, ca.SX]:
    """L^-1 residual, with L L' the covariance of the present values; and the diagonal of L, 1 for missing values."""
    n = residual.numel()
    masked = ca.SX(n, n)
    for i in range(n):
        for j in range(n):
            masked[i, j] = (
                ca.if_else(present[i], covariance[i, i], 1.0) if i == j else present[i] * present[j] * covariance[i, j]
            )
    L = ca.chol(masked).T
    return ca.solve(L, residual), ca.diag(L)
