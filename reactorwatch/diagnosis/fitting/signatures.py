"""What a deviation of any shape in time does to a filter's innovations, linearised; for all causes at once.

Whitened innovations w of a filter that does not know of a deviation have the mean g(m), linear in its course m(t)
(`reactorwatch.kalman.error_dynamics` has the equations). Four things are asked of that map again and again, and each
costs one pass over the record:

- `shown`: the signature g of some given courses, forwards; and `products`: their sums of products alone.
- `sought`: for every row, by how much sum(w g) grows with the deviation in that row, backwards. It is the adjoint, so
  that sum(w g) of any course is the sum over rows of course times this.
- `onsets`: sum(w g) and sum(g g) of a course that sets in after a row, for every row, backwards: the value of a
  quadratic form in the filter's error and in what is still to come. With m(t) = a after the onset, where from row to
  row a <- a + beta b and b <- gamma b, (a, b) begins as (1, 0) for a step and as (0, 1) for a ramp (beta the row's
  length, gamma 1) or a decay (gamma the share of the way that is left after a row, beta 1 - gamma).

For a course of the likeliest size, twice the logarithm of the likelihood ratio is sum(w g)^2 / sum(g g) (Willsky &
Jones 1976, A generalized likelihood ratio approach to the detection and estimation of jumps in linear systems, IEEE
Trans. Automatic Control 21).
"""

from typing import NamedTuple

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.kalman.error_dynamics import ErrorDynamics

PART = 256
"""Rows whose signatures are summed up while they are still at hand."""

_DEAD = 1e-150
"""Of an error of the state: its square is still a number."""


class Onsets(NamedTuple):
    """Of courses that set in right after a row.

    Attributes:
        step_a: sum(w g) of a step of size 1, shape (rows - 1, causes).
        step_b: sum(g g) of it, likewise.
        other_a: sum(w g) of each other course, shape (others, rows - 1, causes).
        other_b: sum(g g) of them, likewise.
    """

    step_a: Array
    step_b: Array
    other_a: Array
    other_b: Array


def shown(ways: ErrorDynamics, cause: int, over_row: Array, at_row: Array) -> Array:
    """The signatures of some courses of one cause, shape (rows - 1, n_y, courses).

    Args:
        ways: between the rows.
        cause: which of the sizes.
        over_row: mean deviation from each row to the next one, shape (rows - 1, courses).
        at_row: the deviation at each row but the first, likewise.
    """
    G, D = np.ascontiguousarray(ways.G[:, :, cause]), np.ascontiguousarray(ways.D[:, :, cause])
    return np.asarray(_shown(*_common(ways), G, D, over_row, at_row))


def products(ways: ErrorDynamics, cause: int, over_row: Array, at_row: Array) -> tuple[Array, Array]:
    """The sums w g of all such signatures, shape (courses,), and g g of any two, shape (courses, courses)."""
    G, D = np.ascontiguousarray(ways.G[:, :, cause]), np.ascontiguousarray(ways.D[:, :, cause])
    a, b = _products(*_common(ways), G, D, np.ascontiguousarray(ways.w), over_row, at_row)
    return np.asarray(a), np.asarray(b)


def sought(ways: ErrorDynamics) -> tuple[Array, Array]:
    """How sum(w g) grows with the deviation over each way, and at the row after it; shapes (rows - 1, causes)."""
    over_row, at_row = _sought(*_common(ways), *_of_sizes(ways), np.ascontiguousarray(ways.w))
    return np.asarray(over_row), np.asarray(at_row)


def onsets(ways: ErrorDynamics, beta: Array, gamma: Array, mean: Array) -> Onsets:
    """Of a step and of other courses, at every onset.

    Args:
        ways: between the rows.
        beta: of each way, for each other course, see the module; shape (others, rows - 1).
        gamma: likewise.
        mean: over the way the deviation is a + mean b on average, likewise.
    """
    return Onsets(*_onsets(*_common(ways), *_of_sizes(ways), np.ascontiguousarray(ways.w), beta, gamma, mean))


def _common(ways: ErrorDynamics) -> tuple[Array, Array, Array, Array]:
    return ways.F, ways.H, ways.K, ways.whitening


def _of_sizes(ways: ErrorDynamics) -> tuple[Array, Array]:
    return np.ascontiguousarray(ways.G), np.ascontiguousarray(ways.D)


@jit
def _shown(F: Array, H: Array, K: Array, whitening: Array, G: Array, D: Array, over_row: Array, at_row: Array) -> Array:
    rows, n_x, n_y, courses = F.shape[0], F.shape[1], H.shape[1], over_row.shape[1]
    found = np.zeros((rows, n_y, courses))
    _show(F, H, K, whitening, G, D, over_row, at_row, 0, np.zeros((n_x, courses)), found)
    return found


@jit
def _products(
    F: Array, H: Array, K: Array, whitening: Array, G: Array, D: Array, w: Array, over_row: Array, at_row: Array
) -> tuple[Array, Array]:
    rows, n_x, n_y, courses = F.shape[0], F.shape[1], H.shape[1], over_row.shape[1]
    a, b, e = np.zeros(courses), np.zeros((courses, courses)), np.zeros((n_x, courses))
    part = np.zeros((PART, n_y, courses))
    for begin in range(0, rows, PART):
        count = min(PART, rows - begin)
        part[:] = 0.0
        _show(F, H, K, whitening, G, D, over_row, at_row, begin, e, part[:count])
        g = part[:count].reshape(count * n_y, courses)
        a += g.T @ w[begin : begin + count].copy().reshape(count * n_y)
        b += g.T @ g
    return a, b


@jit
def _show(
    F: Array,
    H: Array,
    K: Array,
    whitening: Array,
    G: Array,
    D: Array,
    over_row: Array,
    at_row: Array,
    begin: int,
    e: Array,
    found: Array,
) -> None:
    """The signatures of rows from one on, of which `found` is still empty; `e` are the errors of the state there."""
    n_x, n_y, courses = F.shape[1], H.shape[1], over_row.shape[1]
    before, off = np.zeros((n_x, courses)), np.zeros((n_y, courses))
    for place in range(found.shape[0]):  # courses innermost, so that several are taken at once
        k = begin + place
        for i in range(n_x):
            by = G[k, i]
            for c in range(courses):
                before[i, c] = by * over_row[k, c]
            for j in range(n_x):
                by = F[k, i, j]
                for c in range(courses):
                    before[i, c] += by * e[j, c]
        for i in range(n_y):
            by = D[k, i]
            for c in range(courses):
                off[i, c] = by * at_row[k, c]
            for j in range(n_x):
                by = H[k, i, j]
                for c in range(courses):
                    off[i, c] += by * before[j, c]
        for i in range(n_x):
            for c in range(courses):
                e[i, c] = before[i, c]
            for j in range(n_y):
                by = K[k, i, j]
                for c in range(courses):
                    e[i, c] -= by * off[j, c]
            for c in range(courses):  # what has died away takes a hundred times as long to multiply
                e[i, c] = e[i, c] if abs(e[i, c]) > _DEAD else 0.0
        for i in range(n_y):
            for j in range(i + 1):
                by = whitening[k, i, j]
                for c in range(courses):
                    found[place, i, c] += by * off[j, c]


@jit
def _sought(F: Array, H: Array, K: Array, whitening: Array, G: Array, D: Array, w: Array) -> tuple[Array, Array]:
    rows, n_x, n_y, causes = F.shape[0], F.shape[1], H.shape[1], G.shape[2]
    over_row, at_row = np.zeros((rows, causes)), np.zeros((rows, causes))
    after, before, off = np.zeros(n_x), np.zeros(n_x), np.zeros(n_y)
    for k in range(rows - 1, -1, -1):
        for i in range(n_y):
            value = 0.0
            for j in range(i, n_y):
                value += whitening[k, j, i] * w[k, j]
            for j in range(n_x):
                value -= K[k, j, i] * after[j]
            off[i] = value
        for i in range(n_x):
            value = after[i]
            for j in range(n_y):
                value += H[k, j, i] * off[j]
            before[i] = value
        for c in range(causes):
            for i in range(n_y):
                at_row[k, c] += D[k, i, c] * off[i]
            for i in range(n_x):
                over_row[k, c] += G[k, i, c] * before[i]
        for i in range(n_x):
            value = 0.0
            for j in range(n_x):
                value += F[k, j, i] * before[j]
            after[i] = value
    return over_row, at_row


@jit
def _add(into: Array, by: Array, columns: Array) -> None:
    """Add by @ columns, all columns at once."""
    for i in range(by.shape[0]):
        for j in range(by.shape[1]):
            value = by[i, j]
            for c in range(columns.shape[1]):
                into[i, c] += value * columns[j, c]


@jit
def _add_transposed(into: Array, by: Array, columns: Array) -> None:
    """Add by.T @ columns."""
    for i in range(by.shape[1]):
        for j in range(by.shape[0]):
            value = by[j, i]
            for c in range(columns.shape[1]):
                into[i, c] += value * columns[j, c]


@jit
def _add_dots(into: Array, one: Array, other: Array) -> None:
    """Add the products of each column with that of the other matrix."""
    for i in range(one.shape[0]):
        for c in range(one.shape[1]):
            into[0, c] += one[i, c] * other[i, c]


@jit
def _mix(into: Array, share: float, one: Array, slope: float, other: Array) -> None:
    """Make it share * one + slope * other."""
    for i in range(one.shape[0]):
        for c in range(one.shape[1]):
            into[i, c] = share * one[i, c] + slope * other[i, c]


@jit
def _onsets(
    F: Array,
    H: Array,
    K: Array,
    whitening: Array,
    G: Array,
    D: Array,
    w: Array,
    beta: Array,
    gamma: Array,
    mean: Array,
) -> tuple[Array, Array, Array, Array]:
    """Of z = (e, a, b) behind a row, sum(g g) = z'N z and sum(w g) = n'z; what only e is in, all causes share.

    Over a row e <- A e + m a + mb b and g = V e + v a + vb b. What a and b do comes from what moves the state (mg, vg)
    and from what a sensor shows (md, vd), in shares of their own for each other course.
    """
    rows, n_x, n_y, causes, others = F.shape[0], F.shape[1], H.shape[1], G.shape[2], beta.shape[0]
    step_a, step_b = np.zeros((rows, causes)), np.zeros((rows, causes))
    other_a, other_b = np.zeros((others, rows, causes)), np.zeros((others, rows, causes))
    one = (1, causes)  # what is one number a cause has two axes, too
    N_ee, n_e, N_before, n_before = np.zeros((n_x, n_x)), np.zeros((n_x, 1)), np.zeros((n_x, n_x)), np.zeros((n_x, 1))
    N_ea, N_aa, n_a = np.zeros((n_x, causes)), np.zeros(one), np.zeros(one)
    N_eb = np.zeros((others, n_x, causes))
    N_ab, N_bb, n_b = np.zeros((others, *one)), np.zeros((others, *one)), np.zeros((others, *one))
    HF, A, V, NA = np.zeros((n_y, n_x)), np.zeros((n_x, n_x)), np.zeros((n_y, n_x)), np.zeros((n_x, n_x))
    HG, mg, md, m = np.zeros((n_y, causes)), np.zeros((n_x, causes)), np.zeros((n_x, causes)), np.zeros((n_x, causes))
    vg, vd, v, vb = np.zeros((n_y, causes)), np.zeros((n_y, causes)), np.zeros((n_y, causes)), np.zeros((n_y, causes))
    mb, q, of_a, of_b = np.zeros((n_x, causes)), np.zeros((n_x, causes)), np.zeros(one), np.zeros(one)
    K_minus, of_row = np.zeros((n_x, n_y)), np.zeros((n_y, 1))
    for k in range(rows - 1, -1, -1):
        of_row[:, 0], K_minus[:], A[:], mg[:] = w[k], -K[k], F[k], G[k]
        for item in (HF, V, NA, N_before, HG, vg, vd, md):
            item[:] = 0.0
        _add(HF, H[k], F[k])
        _add(HG, H[k], G[k])
        _add(A, K_minus, HF)
        _add(mg, K_minus, HG)
        _add(md, K_minus, D[k])
        _add(V, whitening[k], HF)
        _add(vg, whitening[k], HG)
        _add(vd, whitening[k], D[k])
        _mix(m, 1.0, mg, 1.0, md)
        _mix(v, 1.0, vg, 1.0, vd)
        for o in range(others):
            slope, left = beta[o, k], gamma[o, k]
            _mix(mb, mean[o, k], mg, slope, md)
            _mix(vb, mean[o, k], vg, slope, vd)
            # What N makes of the column of b: q of e, and of a and of b.
            _mix(q, slope, N_ea, left, N_eb[o])
            _mix(of_a, slope, N_aa, left, N_ab[o])
            _mix(of_b, slope, N_ab[o], left, N_bb[o])
            _add(q, N_ee, mb)
            _add_dots(of_a, N_ea, mb)
            _add_dots(of_b, N_eb[o], mb)
            N_ab[o] = of_a
            _mix(N_bb[o], slope, of_a, left, of_b)
            _mix(n_b[o], slope, n_a, left, n_b[o])
            N_eb[o] = 0.0
            _add_dots(N_ab[o], m, q)
            _add_dots(N_ab[o], v, vb)
            _add_dots(N_bb[o], mb, q)
            _add_dots(N_bb[o], vb, vb)
            _add_transposed(n_b[o], n_e, mb)
            _add_transposed(n_b[o], of_row, vb)
            _add_transposed(N_eb[o], A, q)
            _add_transposed(N_eb[o], V, vb)
            other_a[o, k], other_b[o, k] = n_b[o, 0], N_bb[o, 0]
        q[:] = N_ea
        _add(q, N_ee, m)
        _add_dots(N_aa, m, q)
        _add_dots(N_aa, m, N_ea)
        _add_dots(N_aa, v, v)
        _add_transposed(n_a, n_e, m)
        _add_transposed(n_a, of_row, v)
        N_ea[:] = 0.0
        _add_transposed(N_ea, A, q)
        _add_transposed(N_ea, V, v)
        step_a[k], step_b[k] = n_a[0], N_aa[0]
        n_before[:] = 0.0
        _add(NA, N_ee, A)
        _add_transposed(N_before, A, NA)
        _add_transposed(N_before, V, V)
        _add_transposed(n_before, A, n_e)
        _add_transposed(n_before, V, of_row)
        _mix(N_ee, 0.5, N_before, 0.5, N_before.T)
        n_e[:] = n_before
    return step_a, step_b, other_a, other_b
