"""The equations of a filter's own errors: how a small deviation shows in what it is off by.

A deviation that the filter does not know of makes its state wrong, and so its predictions. With e the error of the
state and m the size of the deviation, between two rows and at a row

    e <- F e + G m,        off = H e + D m,        e <- e - K off,

with F and G the derivatives of the way between the rows, H and D those of the outputs, and K the filter's gain. Where
the filter was, about which all this is linearised, is known from its run; rows that are far apart are walked in pieces.
All of it is machine code that takes row after row, so that a thousand rows cost a millisecond.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from math import ceil

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import LANES, RowCode
from reactorwatch.codegen.numba_kernel import compiled
from reactorwatch.kalman.ekf import NoiseLevels
from reactorwatch.kalman.ekf_step import exponential
from reactorwatch.kalman.input_uncertainty import Doubt
from reactorwatch.process.integrate import LONGEST_STEP_MIN, passed_min, symbolic_step
from reactorwatch.process.model import ProcessModel

_LEAST_PIVOT = 1e-12
_LONGEST_PIECE_MIN = 1.001 * 2 * LONGEST_STEP_MIN  # a piece is two steps; times are rounded


@dataclass(frozen=True, eq=False)
class Ways:
    """From each row but the last to the next one: the first axis has one place a way.

    They have no gaps in memory, but G and D of some sizes among more.

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
        spread: how uncertain there is, standard deviations, where nobody knows when inputs changed, shape (n_x,).
        shown: the outputs in each row, shape (rows, n_y).
        H: d outputs / d state, shape (rows, n_y, n_x).
        D: d outputs / d sizes, shape (rows, n_y, sizes).
    """

    there: Array
    F: Array
    G: Array
    spread: Array
    shown: Array
    H: Array
    D: Array


class FilterErrors:
    """Linearises the filter of a model about its run over a record.

    Args:
        model: that the filter ran with.
        noise: of the plant and its sensors.
        of_rates: symbols of the model, the sizes as they act in the balances.
        of_outputs: the same sizes as they act in the outputs; may be the same symbols.

    Attributes:
        noise: as given.
        changes: parameters that differ from the model's values.
    """

    def __init__(
        self, model: ProcessModel, noise: NoiseLevels, of_rates: Sequence[ca.SX], of_outputs: Sequence[ca.SX]
    ) -> None:
        self.model, self.noise = model, noise
        self.changes: Mapping[str, float] = {}
        self._code = _Code(model, tuple(of_rates), tuple(of_outputs))

    def with_noise(self, noise: NoiseLevels) -> "FilterErrors":
        """The same with another noise; what was compiled is."""
        other = copy(self)
        other.noise = noise
        return other

    def ways(
        self,
        time_min: Array,
        inputs: Array,
        x: Array,
        P: Array,
        residual: Array,
        used: NDArray[np.bool_],
        began: NDArray[np.bool_] | None = None,
        doubt: Doubt | None = None,
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
            doubt: ways on which nobody knows when inputs changed; None: there are none.
        """
        with np.errstate(over="ignore", invalid="ignore"):  # about a run that has lost an unstable plant
            R, q = np.square(self.noise.measurement_sd), np.square(self.noise.process_sd)
            p = self.model.values(self.changes)
            there, F, G, spread = self._walked(x[:-1], inputs[:-1], time_min, p, doubt)
            H, D = self._code.shown.over(there, inputs[1:], p, time_min[1:])
            L_inverse, w, K = _whitened(F, H, P, q, np.diff(time_min), spread, R, residual, used)
        if began is not None:
            anew = began[1:, None, None]
            kept = np.zeros(F.shape[1:])
            kept[self.model.lasting, self.model.lasting] = 1.0
            F = np.where(anew, kept, F)
            G, H, D, K = (np.where(anew, 0.0, item) for item in (G, H, D, K))
        return Ways(*(np.ascontiguousarray(item) for item in (F, G, H, D, K, L_inverse, w)))  # once, for all kernels

    def prepare(self) -> None:
        """Compile now what `ways` needs, by calls on a made-up path: for one row, and for as many as taken at once."""
        n_x, n_u, n_y = len(self.model.states), len(self.model.inputs), len(self.model.outputs)
        for rows in (2, LANES + 1):
            x = np.tile([state.scale for state in self.model.states], (rows, 1))
            P, nothing = np.tile(np.eye(n_x), (rows, 1, 1)), np.zeros((rows, n_y))
            time_min = np.linspace(0.0, LONGEST_STEP_MIN, rows)
            self.ways(time_min, np.ones((rows, n_u)), x, P, nothing, np.zeros((rows, n_y), dtype=np.bool_))

    def about(self, time_min: Array, inputs: Array, x: Array, doubt: Doubt | None = None) -> "Path":
        """The equations along a path that need not be a filter's.

        Args:
            time_min: shape (rows,).
            inputs: shape (rows, n_u).
            x: the path, shape (rows, n_x).
            doubt: ways on which nobody knows when inputs changed; None: there are none.
        """
        p = self.model.values()
        there, F, G, spread = self._walked(x[:-1], inputs[:-1], time_min, p, doubt)
        H, D = self._code.shown.over(x, inputs, p, time_min)
        (y,) = self._code.outputs.over(x, inputs, p, time_min)
        of_each = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
        return Path(there, F, G, of_each, y[:, :, 0], H, D)

    def _walked(
        self, x: Array, u: Array, time_min: Array, p: Array, doubt: Doubt | None
    ) -> tuple[Array, Array, Array, Array]:
        """Where the ways lead, their derivatives, and the covariance of the first because of its inputs."""
        t, step = time_min[:-1], np.diff(time_min)
        there, F, G = self._walked_surely(x, u, t, step, p)
        spread = np.zeros((*there.shape, there.shape[1]))
        if doubt is not None:
            of_ways = doubt.of_rows(slice(1, None))
            for moments in np.unique(of_ways.moments[of_ways.rows]).tolist():
                rows = np.flatnonzero(of_ways.moments == moments)
                held = (there[rows], F[rows], G[rows])
                ends = self._walked_in_doubt(
                    x[rows], u[rows], time_min[rows], time_min[rows + 1], p, of_ways, rows, held
                )
                there[rows], F[rows], G[rows] = (np.mean(item, axis=0) for item in ends)
                apart = ends[0] - there[rows]
                spread[rows] = np.einsum("mki,mkj->kij", apart, apart) / moments
        return there, F, G, spread

    def _walked_in_doubt(
        self,
        x: Array,
        u: Array,
        begin_min: Array,
        end_min: Array,
        p: Array,
        doubt: Doubt,
        rows: NDArray[np.intp],
        unchanged: tuple[Array, Array, Array],
    ) -> tuple[Array, Array, Array]:
        """Where ways with as many moments lead from each, and their derivatives; the first axis is that of moments."""
        ends: list[tuple[Array, Array, Array]] = []
        for moment in np.linspace(doubt.first_min[rows], doubt.last_min[rows], doubt.moments[rows[0]]):
            changed = np.clip(moment, begin_min, end_min)
            if np.array_equal(changed, end_min):
                ends.append(unchanged)
                continue
            held, F, G = self._walked_surely(x, u, begin_min, changed - begin_min, p)
            there, of_x, of_size = self._walked_surely(held, doubt.inputs[rows], changed, end_min - changed, p)
            ends.append((there, of_x @ F, of_x @ G + of_size))
        there, F, G = (np.stack(items) for items in zip(*ends, strict=True))
        return there, F, G

    def _walked_surely(self, x: Array, u: Array, t: Array, step: Array, p: Array) -> tuple[Array, Array, Array]:
        pieces = np.maximum(np.ceil(step / _LONGEST_PIECE_MIN), 1.0)
        there, F, G = self._code.piece.over(x, u, p, t, step / pieces)
        there = there[:, :, 0]
        for number in range(1, ceil(pieces.max())):
            rows = np.flatnonzero(pieces > number)
            length = step[rows] / pieces[rows]
            after, of_x, of_size = self._code.piece.over(there[rows], u[rows], p, t[rows] + number * length, length)
            there[rows], F[rows], G[rows] = after[:, :, 0], of_x @ F[rows], of_x @ G[rows] + of_size
        return there, F, G


@dataclass(frozen=True, eq=False)
class _Code:
    """What is compiled, when it is first used."""

    model: ProcessModel
    of_rates: tuple[ca.SX, ...]
    of_outputs: tuple[ca.SX, ...]

    @cached_property
    def piece(self) -> RowCode:
        return RowCode(piece_function(self.model, self.of_rates), shared=[2])

    @cached_property
    def shown(self) -> RowCode:
        return RowCode(shown_function(self.model, self.of_outputs), shared=[2])

    @cached_property
    def outputs(self) -> RowCode:
        x, u, p, t, y = self.model.shown()
        return RowCode(ca.Function("outputs", [x, u, p, t], [y]), shared=[2])


@compiled
def _whitened(
    F: Array,
    H: Array,
    P: Array,
    q: Array,
    step: Array,
    spread: Array,
    R: Array,
    residual: Array,
    used: NDArray[np.bool_],
) -> tuple[Array, Array, Array]:
    """What whitens each way's innovation, that innovation, and the gain.

    About a run that has lost the plant these are anything; pivots are kept positive.
    """
    ways, n_x, n_y = F.shape[0], F.shape[1], H.shape[1]
    L_inverse, w, K = np.zeros((ways, n_y, n_y)), np.zeros((ways, n_y)), np.zeros((ways, n_x, n_y))
    FP, prior, HP = np.zeros((n_x, n_x)), np.zeros((n_x, n_x)), np.zeros((n_y, n_x))
    S, L, known = np.zeros((n_y, n_y)), np.zeros((n_y, n_y)), np.zeros(n_y, dtype=np.bool_)
    for k in range(ways):
        for i in range(n_x):
            for j in range(n_x):
                value = 0.0
                for m in range(n_x):
                    value += F[k, i, m] * P[k, m, j]
                FP[i, j] = value
        for i in range(n_x):
            for j in range(n_x):
                value = spread[k, i, j]
                if i == j:
                    value += q[i] * step[k]
                for m in range(n_x):
                    value += FP[i, m] * F[k, j, m]
                prior[i, j] = value
        for i in range(n_y):
            for j in range(n_x):
                value = 0.0
                for m in range(n_x):
                    value += H[k, i, m] * prior[m, j]
                HP[i, j] = value
        for i in range(n_y):
            known[i] = np.isfinite(residual[k + 1, i])
            for j in range(n_y):
                value = R[i] if i == j else 0.0
                for m in range(n_x):
                    value += HP[i, m] * H[k, j, m]
                S[i, j] = value
                known[i] = known[i] and np.isfinite(value)
        for i in range(n_y):
            for j in range(n_y):
                if not (known[i] and known[j]):
                    S[i, j] = 1.0 if i == j else 0.0
        for i in range(n_y):
            for j in range(i + 1):
                left = S[i, j]
                for m in range(j):
                    left -= L[i, m] * L[j, m]
                L[i, j] = np.sqrt(max(left, _LEAST_PIVOT * abs(S[i, i]))) if i == j else left / L[j, j]
        for j in range(n_y):  # column by column of the inverse; 0 where nothing was measured
            for i in range(j, n_y):
                value = 1.0 if i == j else 0.0
                for m in range(j, i):
                    value -= L[i, m] * L_inverse[k, m, j]
                L_inverse[k, i, j] = value / L[i, i] if known[i] and known[j] else 0.0
        for i in range(n_y):
            for j in range(i + 1):
                if known[j]:
                    w[k, i] += L_inverse[k, i, j] * residual[k + 1, j]
        for i in range(n_x):
            for j in range(n_y):
                if used[k + 1, j]:
                    value = 0.0
                    for m in range(n_x):
                        value += P[k + 1, i, m] * H[k, j, m]
                    K[k, i, j] = value / R[j]
    return L_inverse, w, K


def piece_function(model: ProcessModel, sizes: Sequence[ca.SX]) -> ca.Function:
    """(x, u, p, t, h) -> x after two steps, and its derivatives by x and by the sizes.

    With A and B the Jacobians of the right-hand side at the ends of a step, the derivative by x is the exponential of
    the mean of A, as in the filter, and that by the sizes follows from the trapezoidal rule. That the states go on for
    less while a size moves the clock is not in it.
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
        passed = passed_min(model, u, p, begin, middle, half)
        E = exponential(0.5 * passed * (A + A_end))
        F, G, point = E @ F, E @ (G + 0.5 * passed * B) + 0.5 * passed * B_end, end
    return ca.Function("piece", [x, u, p, t, h], [ca.densify(item) for item in ca.cse([point, F, G])])


def shown_function(model: ProcessModel, sizes: Sequence[ca.SX]) -> ca.Function:
    """(x, u, p, t) -> derivatives of the outputs by x and by the sizes."""
    x, u, p, t, y = model.shown()
    by = [ca.densify(ca.jacobian(y, item)) for item in (x, ca.vertcat(*sizes))]
    return ca.Function("shown", [x, u, p, t], ca.cse(by))
