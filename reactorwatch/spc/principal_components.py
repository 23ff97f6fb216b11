"""Principal components of weighted rows, and T2 and SPE of a row (see `charts.pca`)."""

from typing import NamedTuple

import numpy as np

from reactorwatch.spc.charts.base import Array

EXPLAINED = 0.9
"""Share of the variance that the components have."""


class Components(NamedTuple):
    """Components of centred signals.

    Attributes:
        loadings: orthonormal directions, shape (signals, components).
        variances: variance of each component.
        rest: variance that they leave, of all signals together.
    """

    loadings: Array
    variances: Array
    rest: float


def components_of(covariance: Array) -> Components:
    """The fewest components that explain `EXPLAINED` of the variance; at least one direction is left."""
    values, vectors = np.linalg.eigh(covariance)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    shares = np.cumsum(values) / values.sum()
    count = min(int(np.searchsorted(shares, EXPLAINED) + 1), len(values) - 1)
    rest = max(float(values[count:].sum()), 1e-12 * float(values.sum()))
    return Components(np.ascontiguousarray(vectors[:, :count]), values[:count], rest)


def parts_of(off: Array, loadings: Array, variances: Array, rest: float) -> Array:
    """Each signal's part of T2 and of SPE, shape (2, signals); in sound rows both have the mean 1.

    Args:
        off: deviations of the signals of a row, shape (signals,).
        loadings: see `Components`; directions without variance add nothing.
        variances: see `Components`.
        rest: see `Components`.
    """
    scores = off @ loadings
    used = variances > 0.0
    weighted = np.where(used, scores / np.where(used, variances, 1.0), 0.0) / max(int(used.sum()), 1)
    return np.array([off * (loadings @ weighted), (off - loadings @ scores) ** 2 / rest])
