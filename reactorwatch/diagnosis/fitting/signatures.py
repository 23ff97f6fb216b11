"""Signatures: the linearised effect of any deviation m(t) on a filter's innovations, for all causes at once.

The normalised innovations w of a filter without the deviation have the mean g(m), linear in m
(`reactorwatch.kalman.error_dynamics` has the equations). Each of these operations is one pass over the record:

- `forward_signatures`: signatures g of given profiles; `gram`: their sums of products alone.
- `adjoint`: derivative of sum(w g) by the deviation in each row, backwards; sum(w g) of any profile is the sum over
  rows of the profile times this.
- `onset_scan`: sum(w g) and sum(g g) of a profile that sets in after a row, for every row, backwards: the value of a
  quadratic form in the filter's error and the deviation's state. With m(t) = a after the onset, and a <- a + beta b, b
  <- gamma b from row to row, (a, b) starts as (1, 0) for a step and as (0, 1) for a ramp (beta the row's length, gamma
  1) or a decay (gamma the fraction that remains after a row, beta 1 - gamma).

At the most likely magnitude, twice the log likelihood ratio is sum(w g)^2 / sum(g g) (Willsky & Jones 1976, A
generalized likelihood ratio approach to the detection and estimation of jumps in linear systems, IEEE Trans. Automatic
Control 21).

Least squares from the normal equations: bounded solutions and covariances.
"""

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.kalman.error_dynamics import ErrorDynamics

_TURNS, _RIDGE = 4, 1e-9


def solve_bounded(gram: Array, by: Array, lowest: Array, highest: Array) -> tuple[float, Array]:
    """Solve by an active set: coefficients beyond a bound are fixed to it.

    Returns twice the gain in log likelihood, and the solution.
    """
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    free, solution = np.ones(by.size, dtype=bool), np.zeros(by.size)
    for _ in range(_TURNS):
        if not free.any():
            break
        inner = gram[np.ix_(free, free)] / np.outer(scale[free], scale[free])
        inner[np.diag_indices_from(inner)] += _RIDGE
        residual = by[free] - gram[np.ix_(free, ~free)] @ solution[~free]
        solution[free] = np.linalg.solve(inner, residual / scale[free]) / scale[free]
        inside = np.clip(solution, lowest, highest)
        beyond = free & (inside != solution)
        solution = inside
        if not beyond.any():
            break
        free &= ~beyond
    return float(solution @ (2.0 * by - gram @ solution)), solution


def inverse(information: Array) -> Array:
    """Pseudo-inverse of an information matrix, scaled so that the units of the parameters do not matter."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    inner = np.linalg.pinv(information / np.outer(scale, scale), rcond=1e-12, hermitian=True)
    return np.asarray(inner / np.outer(scale, scale))


CHUNK_ROWS = 256
"""Rows whose signatures are summed while they are in the cache."""

BLOCK, NEGLIGIBLE = 512, 1e-9
"""Rows of columns that are multiplied at once, and the fraction of a column's maximum below which it counts as 0."""

SMALLEST = 1e-100
"""Values below this count as 0: their products would be denormal numbers, which take a hundred times as long."""

_DEAD = 1e-150
"""Errors of the state below this are set to 0; its square is still a normal number."""


def forward_signatures(dynamics: ErrorDynamics, cause: int, interval_mean: Array, sample_value: Array) -> Array:
    """Signatures of profiles of one cause, shape (rows - 1, n_y, profiles).

    Args:
        dynamics: error equations between the rows.
        cause: index of the cause.
        interval_mean: mean deviation from each row to the next, shape (rows - 1, profiles).
        sample_value: deviation at each row but the first, shape (rows - 1, profiles).
    """
    one = slice(cause, cause + 1)
    return np.asarray(_forward_signatures(*_matrices(dynamics, one), interval_mean, sample_value))


def constant_signatures(dynamics: ErrorDynamics, causes: int) -> Array:
    """Signatures of a unit deviation of each of the first causes in all rows, shape (values, causes)."""
    ones = np.ones((len(dynamics.F), 1))
    g = _forward_signatures(*_matrices(dynamics, slice(0, causes)), ones, ones)
    return np.asarray(g).reshape(g.shape[0] * g.shape[1], causes)


def gram(dynamics: ErrorDynamics, cause: int, interval_mean: Array, sample_value: Array) -> tuple[Array, Array]:
    """Sums w g of such signatures, shape (profiles,), and g g of each two, shape (profiles, profiles)."""
    one, w = slice(cause, cause + 1), np.ascontiguousarray(dynamics.w)
    a, b = _gram(*_matrices(dynamics, one), w, interval_mean, sample_value)
    return np.asarray(a), np.asarray(b)


def gram_of_columns(columns: Array) -> Array:
    """Gram matrix of columns, shape (values, n). Most of a hat function's column is 0 and costs nothing."""
    sizes, products = np.abs(columns), np.zeros((columns.shape[1],) * 2)
    least = np.maximum(NEGLIGIBLE * np.max(sizes, axis=0), SMALLEST)
    for begin in range(0, len(columns), BLOCK):
        part = slice(begin, begin + BLOCK)
        present = np.flatnonzero(np.max(sizes[part], axis=0) > least)
        shown = columns[part, present]
        products[np.ix_(present, present)] += shown.T @ shown
    return products


def adjoint(dynamics: ErrorDynamics) -> tuple[Array, Array]:
    """Derivatives of sum(w g) by each interval's mean and by the value at its end, shapes (rows - 1, causes)."""
    interval_mean, sample_value = _adjoint(*_matrices(dynamics), np.ascontiguousarray(dynamics.w))
    return np.asarray(interval_mean), np.asarray(sample_value)


def onset_scan(dynamics: ErrorDynamics, beta: Array, gamma: Array, mean: Array) -> tuple[Array, Array]:
    """Scan all onsets of a unit step and of other profiles that set in right after each row.

    Args:
        dynamics: error equations between the rows.
        beta: see the module, shape (others, rows - 1).
        gamma: see the module, shape (others, rows - 1).
        mean: the mean deviation of an interval is a + mean b, shape (others, rows - 1).

    Returns:
        sum(w g) and sum(g g) of the step, then of each other profile, each of shape (1 + others, rows - 1, causes).
    """
    a, b = _onset_scan(*_matrices(dynamics), np.ascontiguousarray(dynamics.w), beta, gamma, mean)
    return np.asarray(a), np.asarray(b)


def _matrices(dynamics: ErrorDynamics, causes: slice = slice(None)) -> tuple[Array, Array, Array, Array, Array, Array]:
    G, D = np.ascontiguousarray(dynamics.G[:, :, causes]), np.ascontiguousarray(dynamics.D[:, :, causes])
    return dynamics.F, dynamics.H, dynamics.K, dynamics.whitening, G, D


@jit
def _forward_signatures(
    F: Array, H: Array, K: Array, whitening: Array, G: Array, D: Array, interval_mean: Array, sample_value: Array
) -> Array:
    columns = G.shape[2] * interval_mean.shape[1]
    result, e = np.zeros((F.shape[0], H.shape[1], columns)), np.zeros((F.shape[1], columns))
    _propagate(F, H, K, whitening, G, D, interval_mean, sample_value, 0, e, result)
    return result


@jit
def _gram(
    F: Array,
    H: Array,
    K: Array,
    whitening: Array,
    G: Array,
    D: Array,
    w: Array,
    interval_mean: Array,
    sample_value: Array,
) -> tuple[Array, Array]:
    rows, n_x, n_y, profiles = F.shape[0], F.shape[1], H.shape[1], interval_mean.shape[1]
    a, b, e = np.zeros(profiles), np.zeros((profiles, profiles)), np.zeros((n_x, profiles))
    part = np.zeros((CHUNK_ROWS, n_y, profiles))
    for begin in range(0, rows, CHUNK_ROWS):
        count = min(CHUNK_ROWS, rows - begin)
        part[:] = 0.0
        _propagate(F, H, K, whitening, G, D, interval_mean, sample_value, begin, e, part[:count])
        g = part[:count].reshape(count * n_y, profiles)
        a += g.T @ w[begin : begin + count].copy().reshape(count * n_y)
        b += g.T @ g
    return a, b


@jit
def _propagate(
    F: Array,
    H: Array,
    K: Array,
    whitening: Array,
    G: Array,
    D: Array,
    interval_mean: Array,
    sample_value: Array,
    begin: int,
    e: Array,
    result: Array,
) -> None:
    """Add the signatures of rows from `begin` on to zeros; `e` holds the errors of the state and is updated.

    The columns are profiles of one cause, or causes with one profile.
    """
    n_x, n_y, columns = F.shape[1], H.shape[1], e.shape[1]
    predicted, innovation = np.zeros((n_x, columns)), np.zeros((n_y, columns))
    for index in range(result.shape[0]):  # columns innermost, for SIMD
        k = begin + index
        _multiply(predicted, G, interval_mean, k)
        _multiply(innovation, D, sample_value, k)
        for i in range(n_x):
            for j in range(n_x):
                by = F[k, i, j]
                for c in range(columns):
                    predicted[i, c] += by * e[j, c]
        for i in range(n_y):
            for j in range(n_x):
                by = H[k, i, j]
                for c in range(columns):
                    innovation[i, c] += by * predicted[j, c]
        for i in range(n_x):
            for c in range(columns):
                e[i, c] = predicted[i, c]
            for j in range(n_y):
                by = K[k, i, j]
                for c in range(columns):
                    e[i, c] -= by * innovation[j, c]
            for c in range(columns):  # denormal numbers take a hundred times as long to multiply
                e[i, c] = e[i, c] if abs(e[i, c]) > _DEAD else 0.0
        for i in range(n_y):
            for j in range(i + 1):
                by = whitening[k, i, j]
                for c in range(columns):
                    result[index, i, c] += by * innovation[j, c]


@jit
def _multiply(into: Array, by: Array, profiles: Array, k: int) -> None:
    """Set to the products of the causes and the profiles of a row; there is one cause or one profile."""
    for i in range(into.shape[0]):
        if by.shape[2] == 1:
            for c in range(into.shape[1]):
                into[i, c] = by[k, i, 0] * profiles[k, c]
        else:
            for c in range(into.shape[1]):
                into[i, c] = by[k, i, c] * profiles[k, 0]


@jit
def _adjoint(F: Array, H: Array, K: Array, whitening: Array, G: Array, D: Array, w: Array) -> tuple[Array, Array]:
    rows, n_x, n_y, causes = F.shape[0], F.shape[1], H.shape[1], G.shape[2]
    interval_mean, sample_value = np.zeros((rows, causes)), np.zeros((rows, causes))
    after, predicted, innovation = np.zeros(n_x), np.zeros(n_x), np.zeros(n_y)
    for k in range(rows - 1, -1, -1):
        for i in range(n_y):
            value = 0.0
            for j in range(i, n_y):
                value += whitening[k, j, i] * w[k, j]
            for j in range(n_x):
                value -= K[k, j, i] * after[j]
            innovation[i] = value
        for i in range(n_x):
            value = after[i]
            for j in range(n_y):
                value += H[k, j, i] * innovation[j]
            predicted[i] = value
        for c in range(causes):
            for i in range(n_y):
                sample_value[k, c] += D[k, i, c] * innovation[i]
            for i in range(n_x):
                interval_mean[k, c] += G[k, i, c] * predicted[i]
        for i in range(n_x):
            value = 0.0
            for j in range(n_x):
                value += F[k, j, i] * predicted[j]
            after[i] = value
    return interval_mean, sample_value


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
    """Add the dot products of corresponding columns."""
    for i in range(one.shape[0]):
        for c in range(one.shape[1]):
            into[0, c] += one[i, c] * other[i, c]


@jit
def _mix(into: Array, share: float, one: Array, slope: float, other: Array) -> None:
    """Set to share * one + slope * other."""
    for i in range(one.shape[0]):
        for c in range(one.shape[1]):
            into[i, c] = share * one[i, c] + slope * other[i, c]


@jit
def _onset_scan(
    F: Array, H: Array, K: Array, whitening: Array, G: Array, D: Array, w: Array, beta: Array, gamma: Array, mean: Array
) -> tuple[Array, Array]:
    """Backward recursion: with z = (e, a, b) after a row, sum(g g) = z'N z and sum(w g) = n'z.

    All causes share N_ee and n_e. Over a row e <- A e + m a + mb b and g = V e + v a + vb b. The parts of a and b come
    from what acts on the state (mg, vg) and on the sensor (md, vd), in other proportions for each other profile.
    """
    rows, n_x, n_y, causes, others = F.shape[0], F.shape[1], H.shape[1], G.shape[2], beta.shape[0]
    all_a, all_b = np.zeros((1 + others, rows, causes)), np.zeros((1 + others, rows, causes))
    one = (1, causes)  # scalars of each cause have two axes, too
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
            slope, decay = beta[o, k], gamma[o, k]
            _mix(mb, mean[o, k], mg, slope, md)
            _mix(vb, mean[o, k], vg, slope, vd)
            # Column b of N: q for e, of_a for a, of_b for b.
            _mix(q, slope, N_ea, decay, N_eb[o])
            _mix(of_a, slope, N_aa, decay, N_ab[o])
            _mix(of_b, slope, N_ab[o], decay, N_bb[o])
            _add(q, N_ee, mb)
            _add_dots(of_a, N_ea, mb)
            _add_dots(of_b, N_eb[o], mb)
            N_ab[o] = of_a
            _mix(N_bb[o], slope, of_a, decay, of_b)
            _mix(n_b[o], slope, n_a, decay, n_b[o])
            N_eb[o] = 0.0
            _add_dots(N_ab[o], m, q)
            _add_dots(N_ab[o], v, vb)
            _add_dots(N_bb[o], mb, q)
            _add_dots(N_bb[o], vb, vb)
            _add_transposed(n_b[o], n_e, mb)
            _add_transposed(n_b[o], of_row, vb)
            _add_transposed(N_eb[o], A, q)
            _add_transposed(N_eb[o], V, vb)
            all_a[1 + o, k], all_b[1 + o, k] = n_b[o, 0], N_bb[o, 0]
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
        all_a[0, k], all_b[0, k] = n_a[0], N_aa[0]
        n_before[:] = 0.0
        _add(NA, N_ee, A)
        _add_transposed(N_before, A, NA)
        _add_transposed(N_before, V, V)
        _add_transposed(n_before, A, n_e)
        _add_transposed(n_before, V, of_row)
        _mix(N_ee, 0.5, N_before, 0.5, N_before.T)
        n_e[:] = n_before
    return all_a, all_b
