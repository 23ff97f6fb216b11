"""What a deviation of any shape in time does to a filter's innovations, linearised; for all causes at once.

Whitened innovations w of a filter that does not know of a deviation have the mean g(m), linear in its course m(t)
(`reactorwatch.process.filter_errors` has the equations). Three things are asked of that map again and again, and each
costs one pass over the record:

- `shown`: the signature g of some given courses, forwards.
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

from reactorwatch.compiled import compiled
from reactorwatch.process.filter_errors import Ways
from reactorwatch.process.model import Array

_DEAD = 1e-150
"""Of an error of the state: its square is still a number."""


class Onsets(NamedTuple):
    """Of a course that sets in right after a row; each of shape (rows - 1, causes).

    Attributes:
        step_a: sum(w g) of a step of size 1.
        step_b: sum(g g) of it.
        other_a: sum(w g) of the other course.
        other_b: sum(g g) of it.
    """

    step_a: Array
    step_b: Array
    other_a: Array
    other_b: Array


def shown(ways: Ways, cause: int, over_row: Array, at_row: Array) -> Array:
    """The signatures of some courses of one cause, shape (rows - 1, n_y, courses).

    Args:
        ways: between the rows.
        cause: which of the sizes.
        over_row: mean deviation from each row to the next one, shape (rows - 1, courses).
        at_row: the deviation at each row but the first, likewise.
    """
    G, D = np.ascontiguousarray(ways.G[:, :, cause]), np.ascontiguousarray(ways.D[:, :, cause])
    return np.asarray(_shown(*_common(ways), G, D, over_row, at_row))


def sought(ways: Ways) -> tuple[Array, Array]:
    """How sum(w g) grows with the deviation over each way, and at the row after it; shapes (rows - 1, causes)."""
    over_row, at_row = _sought(*_common(ways), *_of_sizes(ways), np.ascontiguousarray(ways.w))
    return np.asarray(over_row), np.asarray(at_row)


def onsets(ways: Ways, beta: Array, gamma: Array, mean: Array) -> Onsets:
    """Of a step and of one other course, at every onset.

    Args:
        ways: between the rows.
        beta: of each way, see the module; shape (rows - 1,).
        gamma: likewise.
        mean: over the way the deviation is a + mean b on average.
    """
    return Onsets(*_onsets(*_common(ways), *_of_sizes(ways), np.ascontiguousarray(ways.w), beta, gamma, mean))


def _common(ways: Ways) -> tuple[Array, Array, Array, Array]:
    F, H, K, L_inverse = (np.ascontiguousarray(item) for item in (ways.F, ways.H, ways.K, ways.L_inverse))
    return F, H, K, L_inverse


def _of_sizes(ways: Ways) -> tuple[Array, Array]:
    return np.ascontiguousarray(ways.G), np.ascontiguousarray(ways.D)


@compiled
def _shown(F: Array, H: Array, K: Array, L_inverse: Array, G: Array, D: Array, over_row: Array, at_row: Array) -> Array:
    rows, n_x, n_y, courses = F.shape[0], F.shape[1], H.shape[1], over_row.shape[1]
    found = np.zeros((rows, n_y, courses))
    e, before, off = np.zeros((n_x, courses)), np.zeros((n_x, courses)), np.zeros((n_y, courses))
    for k in range(rows):  # courses innermost, so that several are taken at once
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
                by = L_inverse[k, i, j]
                for c in range(courses):
                    found[k, i, c] += by * off[j, c]
    return found


@compiled
def _sought(F: Array, H: Array, K: Array, L_inverse: Array, G: Array, D: Array, w: Array) -> tuple[Array, Array]:
    rows, n_x, n_y, causes = F.shape[0], F.shape[1], H.shape[1], G.shape[2]
    over_row, at_row = np.zeros((rows, causes)), np.zeros((rows, causes))
    after, before, off = np.zeros(n_x), np.zeros(n_x), np.zeros(n_y)
    for k in range(rows - 1, -1, -1):
        for i in range(n_y):
            value = 0.0
            for j in range(i, n_y):
                value += L_inverse[k, j, i] * w[k, j]
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


@compiled
def _onsets(
    F: Array,
    H: Array,
    K: Array,
    L_inverse: Array,
    G: Array,
    D: Array,
    w: Array,
    beta: Array,
    gamma: Array,
    mean: Array,
) -> tuple[Array, Array, Array, Array]:
    rows, n_x, n_y, causes = F.shape[0], F.shape[1], H.shape[1], G.shape[2]
    size = n_x + 2  # z = (e, a, b)
    step_a, step_b = np.zeros((rows, causes)), np.zeros((rows, causes))
    other_a, other_b = np.zeros((rows, causes)), np.zeros((rows, causes))
    M, V = np.zeros((size, size)), np.zeros((n_y, size))  # z <- M z, g = V z
    NM, n_before = np.zeros((size, size)), np.zeros(size)
    before, off = np.zeros((n_x, size)), np.zeros((n_y, size))
    for c in range(causes):
        N, n = np.zeros((size, size)), np.zeros(size)  # sum(g g) = z'N z, sum(w g) = n'z
        for k in range(rows - 1, -1, -1):
            for i in range(n_x):
                for j in range(n_x):
                    before[i, j] = F[k, i, j]
                before[i, n_x] = G[k, i, c]
                before[i, n_x + 1] = G[k, i, c] * mean[k]
            for i in range(n_y):
                for j in range(n_x):
                    off[i, j] = 0.0
                off[i, n_x] = D[k, i, c]
                off[i, n_x + 1] = D[k, i, c] * beta[k]
                for j in range(size):
                    for place in range(n_x):
                        off[i, j] += H[k, i, place] * before[place, j]
            for i in range(n_x):
                for j in range(size):
                    value = before[i, j]
                    for place in range(n_y):
                        value -= K[k, i, place] * off[place, j]
                    M[i, j] = value
            M[n_x, n_x], M[n_x, n_x + 1], M[n_x + 1, n_x + 1] = 1.0, beta[k], gamma[k]
            for i in range(n_y):
                for j in range(size):
                    value = 0.0
                    for place in range(i + 1):
                        value += L_inverse[k, i, place] * off[place, j]
                    V[i, j] = value
            for i in range(size):
                for j in range(size):
                    value = 0.0
                    for place in range(size):
                        value += N[i, place] * M[place, j]
                    NM[i, j] = value
            for i in range(size):
                value = 0.0
                for place in range(size):
                    value += M[place, i] * n[place]
                for place in range(n_y):
                    value += V[place, i] * w[k, place]
                n_before[i] = value
                for j in range(i + 1):
                    value = 0.0
                    for place in range(size):
                        value += M[place, i] * NM[place, j]
                    for place in range(n_y):
                        value += V[place, i] * V[place, j]
                    N[i, j] = value
                    N[j, i] = value
            for i in range(size):
                n[i] = n_before[i]
            step_a[k, c], step_b[k, c] = n[n_x], N[n_x, n_x]
            other_a[k, c], other_b[k, c] = n[n_x + 1], N[n_x + 1, n_x + 1]
    return step_a, step_b, other_a, other_b
