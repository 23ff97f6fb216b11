"""One row of the extended Kalman filter as one compiled function (the equations are in `filter`).

From one row to the next the state takes two steps of the integrator. They meet in the middle of the row, or at the
breakpoint that lies in it: there the right-hand side jumps, and a step across a jump would lose its order. States that
jump when a row begins do so before its measurements correct them.

What a filter remembers is one vector: the state x, then its covariance P, column by column. The constants are one
vector as well: the parameters, the variances of the sensors, the variances of the process in a minute.
"""

from functools import lru_cache
from math import inf, nan

import casadi as ca
import numpy as np

from reactorwatch.codegen.compiled_function import RowCode
from reactorwatch.process.effect_states import reset_function
from reactorwatch.process.integrate import passed_min, symbolic_step
from reactorwatch.process.model import ProcessModel

COMPILED = 64
"""Models whose functions are kept: to make one takes some ten milliseconds, and to keep it a megabyte."""


@lru_cache(maxsize=COMPILED)
def row_function(model: ProcessModel) -> ca.Function:
    """From one row to the next: (memory, new, constants) -> (memory, told).

    new: [inputs of the row before, inputs, time of the row, first step, second step, measured, limits]; NaN is a value
    that is missing, and a limit is how many standard deviations off a value may be to correct the state.
    told: [prediction, residual, its standard deviations, whitened residual, what that was divided by, 1 if all went
    well]; see `innovations.Innovations`.
    """
    n_u, n_y = len(model.inputs), len(model.outputs)
    memory, new, constants = _symbols(model, 2 * n_u + 3 + 2 * n_y)
    p, r, q = _constants(model, constants)
    parts = np.cumsum([0, n_u, n_u, 1, 1, 1, n_y, n_y]).tolist()
    before, u, now, first, second, measured, limits = ca.vertsplit(new, parts)
    x, P = _predicted(model, memory, before, now, first, second, p, q)
    if model.resets:
        x, P = _jumped(model, x, P, u, p, now)
    inside = ca.logic_and(ca.mmin(x - _bounds(model)[0]) >= 0, ca.mmin(_bounds(model)[1] - x) >= 0)
    expected, H = output_function(model)(x, u, p, now)
    covariance = H @ P @ H.T + ca.diag(r)
    known = ca.fabs(measured) < inf  # false for NaN; CasADi takes x == x for true
    off = ca.if_else(known, measured - expected, 0.0)
    whitened, divisors = _whitened(off, covariance, known)
    sd = ca.sqrt(ca.diag(covariance))
    x, P = _corrected(x, P, H, off, r, ca.logic_and(known, ca.fabs(off) <= limits * sd))
    good = ca.logic_and(inside, ca.fabs(ca.sum1(x) + ca.sum1(ca.vec(P))) < inf)
    x = ca.fmin(ca.fmax(x, _bounds(model)[0]), _bounds(model)[1])
    told = ca.vertcat(expected, measured - expected, sd, ca.if_else(known, whitened, nan), divisors, good)
    results = ca.cse([ca.densify(ca.vertcat(x, ca.vec(P))), ca.densify(told)])
    return ca.Function("row", [memory, new, constants], results, ["memory", "new", "constants"], ["after", "told"])


@lru_cache(maxsize=COMPILED)
def walk_function(model: ProcessModel) -> ca.Function:
    """Part of a way without a measurement: (memory, [inputs, time, first step, second step], constants) -> memory."""
    n_u = len(model.inputs)
    memory, new, constants = _symbols(model, n_u + 3)
    p, _, q = _constants(model, constants)
    x, P = _predicted(model, memory, new[:n_u], new[n_u], new[n_u + 1], new[n_u + 2], p, q)
    return ca.Function("walk", [memory, new, constants], [ca.densify(ca.vertcat(x, ca.vec(P)))])


@lru_cache(maxsize=COMPILED)
def output_function(model: ProcessModel) -> ca.Function:
    """(x, u, p, t) -> (y, dy/dx)."""
    x, u, p = model.arguments()
    t = ca.SX.sym("t")
    y = model.function()(x, u, p, t, t)[1]
    return ca.Function("outputs", [x, u, p, t], [y, ca.densify(ca.jacobian(y, x))])


@lru_cache(maxsize=COMPILED)
def row_code(model: ProcessModel) -> RowCode:
    """`row_function` for row after row, up to the first that does not go well."""
    return RowCode(row_function(model), shared=[2], chained=1, stops=True)


def _symbols(model: ProcessModel, new: int) -> tuple[ca.SX, ca.SX, ca.SX]:
    n_x = len(model.states)
    constants = len(model.parameters) + len(model.outputs) + n_x
    return ca.SX.sym("memory", n_x + n_x * n_x), ca.SX.sym("new", new), ca.SX.sym("constants", constants)


def _constants(model: ProcessModel, constants: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Parameters, variances of the sensors and of the process."""
    n_p, n_y = len(model.parameters), len(model.outputs)
    return constants[:n_p], constants[n_p : n_p + n_y], constants[n_p + n_y :]


def _bounds(model: ProcessModel) -> tuple[ca.DM, ca.DM]:
    return ca.DM([state.lower for state in model.states]), ca.DM([state.upper for state in model.states])


def _predicted(
    model: ProcessModel, memory: ca.SX, u: ca.SX, now: ca.SX, first: ca.SX, second: ca.SX, p: ca.SX, q: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """State and covariance after two steps, the second of which ends now.

    The Jacobian of a step is exp(h (A + A') / 2), with A and A' the Jacobians of the right-hand side at its ends and
    the exponential to fourth order. On the operating branch its entries are within 1 % of those of the step itself, for
    half the cost of the whole row; only the covariance depends on it.
    """
    n = len(model.states)
    step, slope = symbolic_step(model), _jacobian(model)
    start, P = memory[:n], ca.reshape(memory[n:], n, n)
    F, x = ca.SX.eye(n), start
    for begin, h in ((now - second - first, first), (now - second, second)):
        middle = begin + 0.5 * h
        after = step(x, u, p, begin, middle, h)[0]
        passed = passed_min(model, u, p, begin, middle, h)
        M = 0.5 * passed * (slope(x, u, p, begin, middle) + slope(after, u, p, begin + h, middle))
        F, x = exponential(M) @ F, after
    return x, F @ P @ F.T + ca.diag(q * (first + second))


def _jumped(model: ProcessModel, x: ca.SX, P: ca.SX, u: ca.SX, p: ca.SX, now: ca.SX) -> tuple[ca.SX, ca.SX]:
    """State and covariance when a row has begun."""
    reset, before = reset_function(model), ca.SX.sym("before", x.numel())
    after = reset(before, u, p, now)
    after, U = ca.substitute([after, ca.jacobian(after, before)], [before], [x])
    return after, U @ P @ U.T


def _jacobian(model: ProcessModel) -> ca.Function:
    """(x, u, p, t, t_middle) -> d(dx/dt)/dx."""
    symbols = [*model.arguments(), model.clock.now, model.clock.middle]
    return ca.Function("jacobian", symbols, [ca.densify(ca.jacobian(ca.vertcat(*model.rhs), symbols[0]))])


def exponential(M: ca.SX) -> ca.SX:
    """1 + M + M^2/2 + M^3/6 + M^4/24."""
    result = ca.SX.eye(M.size1())
    for divisor in (4, 3, 2, 1):
        result = ca.SX.eye(M.size1()) + M @ result / divisor
    return result


def _corrected(x: ca.SX, P: ca.SX, H: ca.SX, off: ca.SX, r: ca.SX, used: ca.SX) -> tuple[ca.SX, ca.SX]:
    """State and covariance after the measurements that are used, one after the other, in the form of Joseph."""
    predicted = x
    for index in range(off.numel()):
        h = H[index, :]
        K = used[index] * (P @ h.T) / (h @ P @ h.T + r[index])
        x = x + K * (off[index] - h @ (x - predicted))
        rest = ca.SX.eye(x.numel()) - K @ h
        P = rest @ P @ rest.T + K @ K.T * r[index]
    return x, 0.5 * (P + P.T)


def _whitened(off: ca.SX, covariance: ca.SX, known: ca.SX) -> tuple[ca.SX, ca.SX]:
    """L^-1 off, where L L' is the covariance of what is known; and the diagonal of L, 1 where nothing is known."""
    n = off.numel()
    masked = ca.SX(n, n)
    for i in range(n):
        for j in range(n):
            masked[i, j] = (
                ca.if_else(known[i], covariance[i, i], 1.0) if i == j else known[i] * known[j] * covariance[i, j]
            )
    L = ca.chol(masked).T
    return ca.solve(L, off), ca.diag(L)
