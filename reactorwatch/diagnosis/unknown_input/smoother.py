"""Kalman filter and smoother with an unknown input as a state, linearised about a path.

With d the true state minus the path and m the forcing, between rows and at a row

    d <- offset + F d + G m + noise,    m <- kept m + red noise,    seen = H d + D m + noise,

all Gaussian, so the likelihood has a closed form (Kalman 1960) for any course of m. Known parts of the forcing are
columns: the first column of `offset` and `seen` is the constant part, each other column is the effect of one more term
at unit coefficient. The filter is linear, so it whitens all columns at once, and the coefficients follow from least
squares (de Jong 1991, The diffuse Kalman filter, Annals of Statistics 19).

The smoother is that of de Jong (1989, Smoothing and interpolation with the state-space model, J. American Statistical
Association 84), which needs no matrix inverse.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit


class PathModel(NamedTuple):
    """Equations about a path, with one item for each row; those of an interval are at its end.

    Attributes:
        F: transition matrices, shape (rows, n_x, n_x); unused in the first row.
        G: input vectors of the forcing, shape (rows, n_x).
        H: output matrices, shape (rows, n_y, n_x).
        D: feedthrough of the forcing, shape (rows, n_y).
        q: variance that the interval adds to each state, shape (rows, n_x).
        used: mask of measured values that are used, shape (rows, n_y).
        restarts: rows at which the filter restarts, shape (rows,).
        start: d at these rows, shape (rows, n_x).
        start_covariance: covariance of d at these rows, shape (rows, n_x, n_x).
    """

    F: Array
    G: Array
    H: Array
    D: Array
    q: Array
    used: NDArray[np.bool_]
    restarts: NDArray[np.bool_]
    start: Array
    start_covariance: Array


def normalize_columns(
    about: PathModel, r: Array, kept: Array, variance: float, offset: Array, seen: Array
) -> tuple[Array, float]:
    """Normalised innovations of all columns.

    Args:
        about: the equations.
        r: variance of the sensors' noise, shape (n_y,).
        kept: factor by which the forcing decays over each interval, shape (rows,).
        variance: stationary variance of the forcing.
        offset: shape (rows, n_x, columns).
        seen: shape (rows, n_y, columns).

    Returns:
        Shape (rows, n_y, columns), 0 where not measured; and the sum of the logarithms of the standard deviations.
    """
    result, logs = _normalize_columns(about, r, kept, variance, offset, seen)
    return np.asarray(result), float(logs)


def smooth(about: PathModel, r: Array, kept: Array, variance: float, offset: Array, seen: Array) -> tuple[Array, Array]:
    """Most likely d and m, shapes (rows, n_x) and (rows,).

    Args:
        about: the equations.
        r: see `normalize_columns`.
        kept: see `normalize_columns`.
        variance: see `normalize_columns`.
        offset: shape (rows, n_x).
        seen: shape (rows, n_y).
    """
    result = np.asarray(_smooth(about, r, kept, variance, offset, seen))
    return result[:, :-1], result[:, -1]


@jit
def _normalize_columns(
    about: PathModel, r: Array, kept: Array, variance: float, offset: Array, seen: Array
) -> tuple[Array, float]:
    F, G, H, D, q, used, restarts, start, start_covariance = about
    rows, n, n_y, columns = F.shape[0], F.shape[1], H.shape[1], offset.shape[2]
    result, logs = np.zeros((rows, n_y, columns)), 0.0
    x, predicted = np.zeros((n + 1, columns)), np.zeros((n, columns))
    P, A, c, Pc = np.zeros((n + 1, n + 1)), np.zeros((n + 1, n + 1)), np.zeros(n + 1), np.zeros(n + 1)
    AP, innovation = np.zeros((n + 1, n + 1)), np.zeros(columns)  # loops over columns innermost, contiguous
    for k in range(rows):
        if restarts[k]:
            x[:] = 0.0
            P[:] = 0.0
            x[:n, 0] = start[k]
            P[:n, :n] = start_covariance[k]
            P[n, n] = variance
            continue
        for i in range(n):
            for j in range(columns):
                predicted[i, j] = offset[k, i, j] + G[k, i] * x[n, j]
            for index in range(n):
                by = F[k, i, index]
                for j in range(columns):
                    predicted[i, j] += by * x[index, j]
        for i in range(n):
            for j in range(columns):
                x[i, j] = predicted[i, j]
        for j in range(columns):
            x[n, j] *= kept[k]
        _predict_covariance(F[k], G[k], q[k], kept[k], variance, A, AP, P)
        for i in range(n_y):
            if not used[k, i]:
                continue
            for j in range(n):
                c[j] = H[k, i, j]
            c[n] = D[k, i]
            s = _project(P, c, Pc) + r[i]
            sd = np.sqrt(s)
            logs += np.log(sd)
            for j in range(columns):
                innovation[j] = seen[k, i, j]
            for index in range(n + 1):
                by = c[index]
                for j in range(columns):
                    innovation[j] -= by * x[index, j]
            for j in range(columns):
                result[k, i, j] = innovation[j] / sd
            for index in range(n + 1):
                by = Pc[index] / s
                for j in range(columns):
                    x[index, j] += by * innovation[j]
            _correct(P, Pc, s)
    return result, logs


@jit
def _predict_covariance(
    F: Array, G: Array, q: Array, kept: float, variance: float, A: Array, AP: Array, P: Array
) -> None:
    """P <- A P A' + noise, with A of the states and the forcing."""
    n = F.shape[0]
    for i in range(n):
        for j in range(n):
            A[i, j] = F[i, j]
        A[i, n] = G[i]
        A[n, i] = 0.0
    A[n, n] = kept
    for i in range(n + 1):
        for j in range(n + 1):
            value = 0.0
            for index in range(n + 1):
                value += A[i, index] * P[index, j]
            AP[i, j] = value
    for i in range(n + 1):
        for j in range(i + 1):
            value = 0.0
            for index in range(n + 1):
                value += AP[i, index] * A[j, index]
            P[i, j] = value
            P[j, i] = value
    for i in range(n):
        P[i, i] += q[i]
    P[n, n] += variance * (1.0 - kept * kept)


@jit
def _project(P: Array, c: Array, Pc: Array) -> float:
    """Write P c to Pc; return c' P c."""
    total = 0.0
    for i in range(c.size):
        value = 0.0
        for j in range(c.size):
            value += P[i, j] * c[j]
        Pc[i] = value
        total += c[i] * value
    return total


@jit
def _correct(P: Array, Pc: Array, s: float) -> None:
    for i in range(Pc.size):
        for j in range(Pc.size):
            P[i, j] -= Pc[i] * Pc[j] / s


@jit
def _smooth(about: PathModel, r: Array, kept: Array, variance: float, offset: Array, seen: Array) -> Array:
    F, G, H, D, q, used, restarts, start, start_covariance = about
    rows, n, n_y = F.shape[0], F.shape[1], H.shape[1]
    x_all, P_all = np.zeros((rows, n + 1)), np.zeros((rows, n + 1, n + 1))  # predicted, before the row's update
    gains, offs, sizes = np.zeros((rows, n_y, n + 1)), np.zeros((rows, n_y)), np.ones((rows, n_y))
    x, moved = np.zeros(n + 1), np.zeros(n + 1)
    P, A, AP = np.zeros((n + 1, n + 1)), np.zeros((n + 1, n + 1)), np.zeros((n + 1, n + 1))
    c, Pc = np.zeros(n + 1), np.zeros(n + 1)
    for k in range(rows):
        if restarts[k]:
            x[:n], x[n] = start[k], 0.0
            P[:] = 0.0
            P[:n, :n] = start_covariance[k]
            P[n, n] = variance
            x_all[k], P_all[k] = x, P
            continue
        for i in range(n):
            value = offset[k, i] + G[k, i] * x[n]
            for j in range(n):
                value += F[k, i, j] * x[j]
            moved[i] = value
        moved[n] = kept[k] * x[n]
        x[:] = moved
        _predict_covariance(F[k], G[k], q[k], kept[k], variance, A, AP, P)
        x_all[k], P_all[k] = x, P
        for i in range(n_y):
            if not used[k, i]:
                continue
            c[:n], c[n] = H[k, i], D[k, i]
            s = _project(P, c, Pc) + r[i]
            innovation = seen[k, i]
            for j in range(n + 1):
                innovation -= c[j] * x[j]
            offs[k, i], sizes[k, i] = innovation, s
            for j in range(n + 1):
                gains[k, i, j] = Pc[j] / s
                x[j] += Pc[j] * innovation / s
            _correct(P, Pc, s)
    result, to_come, back = np.zeros((rows, n + 1)), np.zeros(n + 1), np.zeros(n + 1)
    for k in range(rows - 1, -1, -1):
        if not restarts[k]:
            for i in range(n_y - 1, -1, -1):
                if used[k, i]:
                    c[:n], c[n] = H[k, i], D[k, i]
                    value = offs[k, i] / sizes[k, i]
                    for j in range(n + 1):
                        value -= gains[k, i, j] * to_come[j]
                    for j in range(n + 1):
                        to_come[j] += c[j] * value
        for i in range(n + 1):
            value = x_all[k, i]
            for j in range(n + 1):
                value += P_all[k, i, j] * to_come[j]
            result[k, i] = value
        if restarts[k]:
            to_come[:] = 0.0
            continue
        for j in range(n):
            value = 0.0
            for i in range(n):
                value += F[k, i, j] * to_come[i]
            back[j] = value
        value = kept[k] * to_come[n]
        for i in range(n):
            value += G[k, i] * to_come[i]
        back[n] = value
        to_come[:] = back
    return result
