"""A Kalman filter and smoother in which a forcing of unknown course is a state beside the errors of a path.

About a path through the states that the model follows only roughly, with d the true state less the path and m the
forcing, from row to row and at a row

    d <- offset + F d + G m + noise,    m <- kept m + red noise,    seen = H d + D m + noise,

all of it Gaussian, so the likelihood of what was seen has a closed form (Kalman 1960), whatever the course of m. Known
parts of the forcing come in columns: the first column of `offset` and `seen` is what is there, each of the others what
a further term does, of unit size. The filter is linear, so it whitens all columns at once, and the sizes follow from
least squares (de Jong 1991, The diffuse Kalman filter, Annals of Statistics 19).

The smoother is that of de Jong (1989, Smoothing and interpolation with the state-space model, J. American Statistical
Association 84): it inverts nothing.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit


class Linear(NamedTuple):
    """The equations about a path; the first axis has one place a row, and what is said of a way is said of its end.

    Attributes:
        F: shape (rows, n_x, n_x); of the first row nothing.
        G: shape (rows, n_x).
        H: shape (rows, n_y, n_x).
        D: shape (rows, n_y).
        q: variance that the way adds to each state, shape (rows, n_x).
        known: whether a value was measured and counts, shape (rows, n_y).
        began: rows in which all begins anew, shape (rows,).
        start: d there, shape (rows, n_x); and
        start_covariance: its covariance, shape (rows, n_x, n_x).
    """

    F: Array
    G: Array
    H: Array
    D: Array
    q: Array
    known: NDArray[np.bool_]
    began: NDArray[np.bool_]
    start: Array
    start_covariance: Array


def whitened(about: Linear, r: Array, kept: Array, variance: float, offset: Array, seen: Array) -> tuple[Array, float]:
    """What is seen, column by column, less what the filter expects of it, over its standard deviation.

    Args:
        about: the equations.
        r: variance of the sensors' noise, shape (n_y,).
        kept: share of the forcing that is left at the end of each way, shape (rows,).
        variance: of the forcing.
        offset: shape (rows, n_x, columns).
        seen: shape (rows, n_y, columns).

    Returns:
        Shape (rows, n_y, columns), 0 where nothing is known; and the sum of the logarithms of the deviations.
    """
    found, logs = _whitened(about, r, kept, variance, offset, seen)
    return np.asarray(found), float(logs)


def smoothed(about: Linear, r: Array, kept: Array, variance: float, offset: Array, seen: Array) -> tuple[Array, Array]:
    """The likeliest d and m, shapes (rows, n_x) and (rows,).

    Args:
        about: the equations.
        r: as for `whitened`.
        kept: likewise.
        variance: likewise.
        offset: shape (rows, n_x).
        seen: shape (rows, n_y).
    """
    found = np.asarray(_smoothed(about, r, kept, variance, offset, seen))
    return found[:, :-1], found[:, -1]


@jit
def _whitened(about: Linear, r: Array, kept: Array, variance: float, offset: Array, seen: Array) -> tuple[Array, float]:
    F, G, H, D, q, known, began, start, start_covariance = about
    rows, n, n_y, columns = F.shape[0], F.shape[1], H.shape[1], offset.shape[2]
    found, logs = np.zeros((rows, n_y, columns)), 0.0
    x, before = np.zeros((n + 1, columns)), np.zeros((n, columns))
    P, A, c, Pc = np.zeros((n + 1, n + 1)), np.zeros((n + 1, n + 1)), np.zeros(n + 1), np.zeros(n + 1)
    AP, off = np.zeros((n + 1, n + 1)), np.zeros(columns)  # loops over columns are the inner ones: one after the other
    for k in range(rows):
        if began[k]:
            x[:] = 0.0
            P[:] = 0.0
            x[:n, 0] = start[k]
            P[:n, :n] = start_covariance[k]
            P[n, n] = variance
            continue
        for i in range(n):
            for j in range(columns):
                before[i, j] = offset[k, i, j] + G[k, i] * x[n, j]
            for place in range(n):
                by = F[k, i, place]
                for j in range(columns):
                    before[i, j] += by * x[place, j]
        for i in range(n):
            for j in range(columns):
                x[i, j] = before[i, j]
        for j in range(columns):
            x[n, j] *= kept[k]
        _walk(F[k], G[k], q[k], kept[k], variance, A, AP, P)
        for i in range(n_y):
            if not known[k, i]:
                continue
            for j in range(n):
                c[j] = H[k, i, j]
            c[n] = D[k, i]
            s = _gained(P, c, Pc) + r[i]
            sd = np.sqrt(s)
            logs += np.log(sd)
            for j in range(columns):
                off[j] = seen[k, i, j]
            for place in range(n + 1):
                by = c[place]
                for j in range(columns):
                    off[j] -= by * x[place, j]
            for j in range(columns):
                found[k, i, j] = off[j] / sd
            for place in range(n + 1):
                by = Pc[place] / s
                for j in range(columns):
                    x[place, j] += by * off[j]
            _correct(P, Pc, s)
    return found, logs


@jit
def _walk(F: Array, G: Array, q: Array, kept: float, variance: float, A: Array, AP: Array, P: Array) -> None:
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
            for place in range(n + 1):
                value += A[i, place] * P[place, j]
            AP[i, j] = value
    for i in range(n + 1):
        for j in range(i + 1):
            value = 0.0
            for place in range(n + 1):
                value += AP[i, place] * A[j, place]
            P[i, j] = value
            P[j, i] = value
    for i in range(n):
        P[i, i] += q[i]
    P[n, n] += variance * (1.0 - kept * kept)


@jit
def _gained(P: Array, c: Array, Pc: Array) -> float:
    """P c into Pc; returns c' P c."""
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
def _smoothed(about: Linear, r: Array, kept: Array, variance: float, offset: Array, seen: Array) -> Array:
    F, G, H, D, q, known, began, start, start_covariance = about
    rows, n, n_y = F.shape[0], F.shape[1], H.shape[1]
    x_all, P_all = np.zeros((rows, n + 1)), np.zeros((rows, n + 1, n + 1))  # before a row is seen
    gains, offs, sizes = np.zeros((rows, n_y, n + 1)), np.zeros((rows, n_y)), np.ones((rows, n_y))
    x, moved = np.zeros(n + 1), np.zeros(n + 1)
    P, A, AP = np.zeros((n + 1, n + 1)), np.zeros((n + 1, n + 1)), np.zeros((n + 1, n + 1))
    c, Pc = np.zeros(n + 1), np.zeros(n + 1)
    for k in range(rows):
        if began[k]:
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
        _walk(F[k], G[k], q[k], kept[k], variance, A, AP, P)
        x_all[k], P_all[k] = x, P
        for i in range(n_y):
            if not known[k, i]:
                continue
            c[:n], c[n] = H[k, i], D[k, i]
            s = _gained(P, c, Pc) + r[i]
            off = seen[k, i]
            for j in range(n + 1):
                off -= c[j] * x[j]
            offs[k, i], sizes[k, i] = off, s
            for j in range(n + 1):
                gains[k, i, j] = Pc[j] / s
                x[j] += Pc[j] * off / s
            _correct(P, Pc, s)
    found, to_come, back = np.zeros((rows, n + 1)), np.zeros(n + 1), np.zeros(n + 1)
    for k in range(rows - 1, -1, -1):
        if not began[k]:
            for i in range(n_y - 1, -1, -1):
                if known[k, i]:
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
            found[k, i] = value
        if began[k]:
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
    return found
