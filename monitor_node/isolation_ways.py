"""The equations of a filter's own errors: how a small deviation shows in what it is off by.

From each row of a window to the next one the way is linearised about where the filter was, with respect to the state
and to the sizes of all effects; rows that are far apart are walked in pieces. All of it is one compiled map over many
rows, so that a window costs a few milliseconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import ceil

import casadi as ca
import numpy as np

from monitor_node.isolation_window import Window
from reactorwatch.process.array_function import ArrayFunction, mapped
from reactorwatch.process.effects.base import Effect
from reactorwatch.process.filter import NoiseLevels
from reactorwatch.process.filter_step import COMPILED, exponential
from reactorwatch.process.integrate import LONGEST_STEP_MIN, symbolic_step
from reactorwatch.process.model import Array, ProcessModel

CHUNK = 32
_LONGEST_PIECE_MIN = 1.001 * 2 * LONGEST_STEP_MIN  # a piece is two steps; times are rounded


@dataclass(frozen=True, eq=False)
class Ways:
    """From each row but the last to the next one: the first axis has one place a way.

    Attributes:
        A: d (the filter's state, what it is off by, whitened) / d its state before, shape (n_x + n_y, n_x).
        G: likewise by the sizes, through what they do on the way, shape (n_x + n_y, causes).
        D: likewise by the sizes, through what they do to the outputs, shape (n_x + n_y, causes).
        w: what it was off by, whitened, shape (n_y,); 0 where nothing was measured.
    """

    A: Array
    G: Array
    D: Array
    w: Array


def linearisable(model: ProcessModel, effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """The effects that act on the model's own states: from no new state there is no infinitesimal deviation."""
    return tuple(effect for effect in effects if effect.extend(model).state_names == model.state_names)


class Linearisation:
    """Linearises the filter of a model.

    Args:
        model: of the plant.
        noise: of the plant and its sensors.
        effects: whose sizes to differentiate by; each acts on the model's own states.
    """

    def __init__(self, model: ProcessModel, noise: NoiseLevels, effects: Sequence[Effect]) -> None:
        extended = _extended(model, tuple(effects))
        self._p = extended.values()
        self._piece = mapped(_piece(extended, len(effects)), CHUNK, parameters=2)
        self._shown = mapped(_shown(extended, len(effects)), CHUNK, parameters=2)
        self._R, self._q = np.square(noise.measurement_sd), np.square(noise.process_sd)

    def ways(self, window: Window) -> Ways:
        """Those between the rows of a window."""
        step = np.diff(window.time_min)
        x, P = window.x, window.covariance
        there, F, G = self._walked(x[:-1], window.inputs[:-1], window.time_min[:-1], step)
        H, D = self._over(self._shown, there, window.inputs[1:], window.time_min[1:, None])
        prior = F @ P[:-1] @ F.transpose(0, 2, 1) + np.eye(x.shape[1]) * self._q * step[:, None, None]
        known = np.isfinite(window.residual[1:])
        both = known[:, :, None] & known[:, None, :]
        covariance = H @ prior @ H.transpose(0, 2, 1) + np.diag(self._R)
        L = np.linalg.cholesky(np.where(both, covariance, np.eye(len(self._R))))
        L_inverse = np.asarray(np.linalg.inv(L) * both)
        w = np.einsum("kij,kj->ki", L_inverse, np.where(known, window.residual[1:], 0.0))
        K = P[1:] @ H.transpose(0, 2, 1) * (window.used[1:] / self._R)[:, None, :]
        by_state = np.concatenate([np.eye(x.shape[1]) - K @ H, L_inverse @ H], axis=1)
        return Ways(by_state @ F, by_state @ G, np.concatenate([-K, L_inverse], axis=1) @ D, w)

    def _walked(self, x: Array, u: Array, t: Array, step: Array) -> tuple[Array, Array, Array]:
        """Where the ways lead, and their derivatives."""
        pieces = np.maximum(np.ceil(step / _LONGEST_PIECE_MIN), 1.0)
        there, F, G = self._over(self._piece, x, u, t[:, None], (step / pieces)[:, None])
        there = there[:, :, 0]
        for number in range(1, ceil(pieces.max())):
            rows = np.flatnonzero(pieces > number)
            length = step[rows] / pieces[rows]
            after, of_x, of_size = self._over(
                self._piece, there[rows], u[rows], (t[rows] + number * length)[:, None], length[:, None]
            )
            there[rows], F[rows], G[rows] = after[:, :, 0], of_x @ F[rows], of_x @ G[rows] + of_size
        return there, F, G

    def _over(self, function: ArrayFunction, *values: Array) -> list[Array]:
        """A function of (x, u, p, ...) for many rows; each result has the rows as its first axis."""
        rows = len(values[0])
        arguments = (*function.arguments[:2], *function.arguments[3:])
        function.arguments[2][0] = self._p
        results = [np.empty((rows, item.shape[0] // CHUNK, item.shape[1])) for item in function.results]
        for first in range(0, rows, CHUNK):
            part = slice(first, min(first + CHUNK, rows))
            for argument, value in zip(arguments, values, strict=True):
                argument[: part.stop - first] = value[part]
            function()
            for result, found in zip(results, function.results, strict=True):
                result[part] = found.reshape(CHUNK, *result.shape[1:])[: part.stop - first]
        return [result.transpose(0, 2, 1) for result in results]


@lru_cache(maxsize=COMPILED)
def _extended(model: ProcessModel, effects: tuple[Effect, ...]) -> ProcessModel:
    for effect in effects:
        model = effect.extend(model)
    return model


@lru_cache(maxsize=COMPILED)
def _piece(model: ProcessModel, sizes: int) -> ca.Function:
    """(x, u, p, t, h) -> x after two steps, and its derivatives by x and by the sizes, which are the last of p.

    With A and B the Jacobians of the right-hand side at the ends of a step, the derivative by x is the exponential of
    the mean of A, as in the filter, and that by the sizes follows from the trapezoidal rule.
    """
    x, u, p = model.arguments()
    t, h = ca.SX.sym("t"), ca.SX.sym("h")
    symbols = [x, u, p, model.clock.now, model.clock.middle]
    rhs, size = ca.vertcat(*model.rhs), p[p.numel() - sizes :]
    slope = ca.Function("slope", symbols, [ca.densify(ca.jacobian(rhs, x)), ca.densify(ca.jacobian(rhs, size))])
    step = symbolic_step(model)
    F, G, point, half = ca.SX.eye(x.numel()), ca.SX.zeros(x.numel(), sizes), x, 0.5 * h
    for begin in (t, t + half):
        middle = begin + 0.5 * half
        end = step(point, u, p, begin, middle, half)[0]
        A, B = slope(point, u, p, begin, middle)
        A_end, B_end = slope(end, u, p, begin + half, middle)
        E = exponential(0.5 * half * (A + A_end))
        F, G, point = E @ F, E @ (G + 0.5 * half * B) + 0.5 * half * B_end, end
    return ca.Function("piece", [x, u, p, t, h], [ca.densify(item) for item in ca.cse([point, F, G])])


@lru_cache(maxsize=COMPILED)
def _shown(model: ProcessModel, sizes: int) -> ca.Function:
    """(x, u, p, t) -> derivatives of the outputs by x and by the sizes, which are the last of p."""
    x, u, p = model.arguments()
    t = ca.SX.sym("t")
    y, size = model.function()(x, u, p, t, t)[1], p[p.numel() - sizes :]
    return ca.Function("shown", [x, u, p, t], [ca.densify(ca.jacobian(y, item)) for item in (x, size)])
