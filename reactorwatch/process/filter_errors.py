"""The equations of a filter's own errors: how a small deviation shows in what it is off by.

A deviation that the filter does not know of makes its state wrong, and so its predictions. With e the error of the
state and m the size of the deviation, between two rows and at a row

    e <- F e + G m,        off = H e + D m,        e <- e - K off,

with F and G the derivatives of the way between the rows, H and D those of the outputs, and K the filter's gain. Where
the filter was, about which all this is linearised, is known from its run; rows that are far apart are walked in pieces.
All of it is one compiled map over many rows, so that a thousand rows cost some milliseconds.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from reactorwatch.process.array_function import ArrayFunction, mapped, over_rows
from reactorwatch.process.filter import NoiseLevels
from reactorwatch.process.filter_step import exponential
from reactorwatch.process.integrate import LONGEST_STEP_MIN, symbolic_step
from reactorwatch.process.model import Array, ProcessModel

CHUNK = 32
_LEAST_PIVOT = 1e-12
_LONGEST_PIECE_MIN = 1.001 * 2 * LONGEST_STEP_MIN  # a piece is two steps; times are rounded


@dataclass(frozen=True, eq=False)
class Ways:
    """From each row but the last to the next one: the first axis has one place a way.

    Attributes:
        F: d state / d state before, shape (n_x, n_x).
        G: d state / d sizes, shape (n_x, sizes).
        H: d outputs / d state, shape (n_y, n_x).
        D: d outputs / d sizes, shape (n_y, sizes).
        K: the filter's gain, shape (n_x, n_y).
        L_inverse: whitens what the filter is off by, shape (n_y, n_y); 0 where nothing was measured.
        w: what it was off by, whitened, shape (n_y,); 0 where nothing was measured.
    """

    F: Array
    G: Array
    H: Array
    D: Array
    K: Array
    L_inverse: Array
    w: Array


@dataclass(frozen=True, eq=False)
class Path:
    """The equations along a path through the states; of ways the first axis has one place a way.

    Attributes:
        there: where the way from each row but the last leads, shape (n_x,).
        F: d there / d state before, shape (n_x, n_x).
        G: d there / d sizes, shape (n_x, sizes).
        shown: the outputs in each row, shape (rows, n_y).
        H: d outputs / d state, shape (rows, n_y, n_x).
        D: d outputs / d sizes, shape (rows, n_y, sizes).
    """

    there: Array
    F: Array
    G: Array
    shown: Array
    H: Array
    D: Array


class FilterErrors:
    """Linearises the filter of a model about its run over a record.

    Args:
        model: that the filter ran with.
        noise: of the plant and its sensors.
        piece: see `piece_function`.
        shown: see `shown_function`.

    Attributes:
        noise: as given.
        changes: parameters that differ from the model's values.
    """

    def __init__(self, model: ProcessModel, noise: NoiseLevels, piece: ca.Function, shown: ca.Function) -> None:
        self.model, self.noise = model, noise
        self.changes: Mapping[str, float] = {}
        self._piece, self._shown = (mapped(function, CHUNK, parameters=2) for function in (piece, shown))

    @classmethod
    def of(
        cls, model: ProcessModel, noise: NoiseLevels, of_rates: Sequence[ca.SX], of_outputs: Sequence[ca.SX]
    ) -> "FilterErrors":
        """With respect to some sizes.

        Args:
            model: see the class.
            noise: likewise.
            of_rates: symbols of the model, the sizes as they act in the balances.
            of_outputs: the same sizes as they act in the outputs; may be the same symbols.
        """
        return cls(model, noise, piece_function(model, of_rates), shown_function(model, of_outputs))

    def ways(
        self,
        time_min: Array,
        inputs: Array,
        x: Array,
        P: Array,
        residual: Array,
        used: NDArray[np.bool_],
        began: NDArray[np.bool_] | None = None,
    ) -> Ways:
        """Those between the rows of a record.

        Args:
            time_min: shape (rows,).
            inputs: shape (rows, n_u).
            x: the filter's state after each row, shape (rows, n_x).
            P: its covariance, shape (rows, n_x, n_x).
            residual: what it was off by, shape (rows, n_y); NaN where nothing was measured.
            used: whether a value corrected the filter, shape (rows, n_y).
            began: rows that it began anew with, shape (rows,), so that what was before is forgotten, but for states
                that never change; None: none.
        """
        with np.errstate(over="ignore", invalid="ignore"):  # about a run that has lost an unstable plant
            found = self._ways(time_min, inputs, x, P, residual, used)
        if began is None:
            return found
        kept = np.zeros(found.F.shape[1:])
        kept[self.model.lasting, self.model.lasting] = 1.0
        F = np.where(began[1:, None, None], kept, found.F)
        G, H, D, K = (np.where(began[1:, None, None], 0.0, item) for item in (found.G, found.H, found.D, found.K))
        return Ways(F, G, H, D, K, found.L_inverse, found.w)

    def _ways(
        self, time_min: Array, inputs: Array, x: Array, P: Array, residual: Array, used: NDArray[np.bool_]
    ) -> Ways:
        R, q = np.square(self.noise.measurement_sd), np.square(self.noise.process_sd)
        p, step = self.model.values(self.changes), np.diff(time_min)
        there, F, G = self._walked(x[:-1], inputs[:-1], time_min[:-1], step, p)
        H, D = self._over(self._shown, p, there, inputs[1:], time_min[1:, None])
        prior = F @ P[:-1] @ F.transpose(0, 2, 1) + np.eye(there.shape[1]) * q * step[:, None, None]
        covariance = H @ prior @ H.transpose(0, 2, 1) + np.diag(R)
        known = np.isfinite(residual[1:]) & np.all(np.isfinite(covariance), axis=2)
        both = known[:, :, None] & known[:, None, :]
        L = _cholesky(np.where(both, covariance, np.eye(R.size)))
        L_inverse = np.asarray(np.linalg.inv(L) * both)
        w = np.einsum("kij,kj->ki", L_inverse, np.where(known, residual[1:], 0.0))
        K = P[1:] @ H.transpose(0, 2, 1) * (used[1:] / R)[:, None, :]
        return Ways(F, G, H, D, K, L_inverse, w)

    def about(self, time_min: Array, inputs: Array, x: Array) -> "Path":
        """The equations along a path that need not be a filter's.

        Args:
            time_min: shape (rows,).
            inputs: shape (rows, n_u).
            x: the path, shape (rows, n_x).
        """
        p = self.model.values()
        there, F, G = self._walked(x[:-1], inputs[:-1], time_min[:-1], np.diff(time_min), p)
        H, D = self._over(self._shown, p, x, inputs, time_min[:, None])
        (y,) = self._over(self._outputs, p, x, inputs, time_min[:, None])
        return Path(there, F, G, y[:, :, 0], H, D)

    @cached_property
    def _outputs(self) -> ArrayFunction:
        x, u, p = self.model.arguments()
        t = ca.SX.sym("t")
        y = ca.substitute(ca.vertcat(*(item.expression for item in self.model.outputs)), self.model.clock.now, t)
        y = ca.substitute(y, self.model.clock.middle, t)
        return mapped(ca.Function("outputs", [x, u, p, t], [ca.densify(y)]), CHUNK, parameters=2)

    def _walked(self, x: Array, u: Array, t: Array, step: Array, p: Array) -> tuple[Array, Array, Array]:
        """Where the ways lead, and their derivatives."""
        pieces = np.maximum(np.ceil(step / _LONGEST_PIECE_MIN), 1.0)
        there, F, G = self._over(self._piece, p, x, u, t[:, None], (step / pieces)[:, None])
        there = there[:, :, 0]
        for number in range(1, ceil(pieces.max())):
            rows = np.flatnonzero(pieces > number)
            length = step[rows] / pieces[rows]
            after, of_x, of_size = self._over(
                self._piece, p, there[rows], u[rows], (t[rows] + number * length)[:, None], length[:, None]
            )
            there[rows], F[rows], G[rows] = after[:, :, 0], of_x @ F[rows], of_x @ G[rows] + of_size
        return there, F, G

    def _over(self, function: ArrayFunction, p: Array, *values: Array) -> list[Array]:
        """A function of (x, u, p, ...) for many rows; each result has the rows as its first axis."""
        return over_rows(function, CHUNK, p, values)


def _cholesky(A: Array) -> Array:
    """L with L L' = A, of many matrices, shape (n, m, m); about a run that has lost the plant these are anything."""
    L = np.zeros_like(A)
    for i in range(A.shape[1]):
        for j in range(i + 1):
            left = A[:, i, j] - np.sum(L[:, i, :j] * L[:, j, :j], axis=1)
            L[:, i, j] = np.sqrt(np.maximum(left, _LEAST_PIVOT * np.abs(A[:, i, i]))) if i == j else left / L[:, j, j]
    return L


def piece_function(model: ProcessModel, sizes: Sequence[ca.SX]) -> ca.Function:
    """(x, u, p, t, h) -> x after two steps, and its derivatives by x and by the sizes.

    With A and B the Jacobians of the right-hand side at the ends of a step, the derivative by x is the exponential of
    the mean of A, as in the filter, and that by the sizes follows from the trapezoidal rule.
    """
    size = ca.vertcat(*sizes)
    x, u, p = model.arguments()
    t, h = ca.SX.sym("t"), ca.SX.sym("h")
    symbols = [x, u, p, model.clock.now, model.clock.middle]
    rhs = ca.vertcat(*model.rhs)
    slope = ca.Function("slope", symbols, [ca.densify(ca.jacobian(rhs, x)), ca.densify(ca.jacobian(rhs, size))])
    step = symbolic_step(model)
    F, G, point, half = ca.SX.eye(x.numel()), ca.SX.zeros(x.numel(), size.numel()), x, 0.5 * h
    for begin in (t, t + half):
        middle = begin + 0.5 * half
        end = step(point, u, p, begin, middle, half)[0]
        A, B = slope(point, u, p, begin, middle)
        A_end, B_end = slope(end, u, p, begin + half, middle)
        E = exponential(0.5 * half * (A + A_end))
        F, G, point = E @ F, E @ (G + 0.5 * half * B) + 0.5 * half * B_end, end
    return ca.Function("piece", [x, u, p, t, h], [ca.densify(item) for item in ca.cse([point, F, G])])


def shown_function(model: ProcessModel, sizes: Sequence[ca.SX]) -> ca.Function:
    """(x, u, p, t) -> derivatives of the outputs by x and by the sizes."""
    x, u, p = model.arguments()
    t = ca.SX.sym("t")
    y = ca.vertcat(*(output.expression for output in model.outputs))
    y = ca.substitute(ca.substitute(y, model.clock.now, t), model.clock.middle, t)
    by = [ca.densify(ca.jacobian(y, item)) for item in (x, ca.vertcat(*sizes))]
    return ca.Function("shown", [x, u, p, t], by)
