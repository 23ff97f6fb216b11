"""Run lengths of a Markov chain, shared by all charts.

A chart's statistic is a Markov chain that ends when the chart signals. With K the transitions among the states in
which it has not signalled, the mean number of samples to the signal from each state solves (1 - K) L = 1 (Brook & Evans
1972, Biometrika 59). For a statistic that takes a continuum of values, K is its kernel at the nodes of a quadrature,
times the weights: Nystroem's method for the integral equation, which converges exponentially for the smooth kernels of
normal data. For a discrete chain K is exact.

Zero state: the change is present from the first sample on. Steady state: the chart has long run without a signal when
the change occurs, so the state is distributed as the left eigenvector of the in-control K (the conditional steady
state: no false alarm has come yet).
"""

from functools import lru_cache
from math import ceil

import numpy as np
from scipy import linalg, special

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.spc.run_length.arguments import LONGEST


def run_lengths(transitions: Array) -> Array:
    """Mean number of samples to the signal from each state, shape (states,); all inf if beyond 1e12.

    Beyond that, 1 - K is rounding error.

    Args:
        transitions: K, shape (states, states), from row to column.
    """
    endless = np.full(len(transitions), np.inf)
    try:
        lengths = np.linalg.solve(np.eye(len(transitions)) - transitions, np.ones(len(transitions)))
    except np.linalg.LinAlgError:
        return endless
    if not np.all((lengths > 0.0) & (lengths < LONGEST)):
        return endless
    return np.asarray(lengths)


def stationary_distribution(transitions: Array) -> Array:
    """Conditional stationary distribution of the states, without a signal, shape (states,), sum 1.

    The left eigenvector of the largest eigenvalue, by inverse iteration at 1: that eigenvalue is just below.
    """
    factors = linalg.lu_factor(np.eye(len(transitions)) - transitions)
    share = np.full(len(transitions), 1.0 / len(transitions))
    for _ in range(500):
        update = linalg.lu_solve(factors, share, trans=1)
        update /= update.sum()
        if np.max(np.abs(update - share)) < 1e-13:
            return np.asarray(update)
        share = update
    raise InputError("the chart must signal more seldom to have a steady state; raise its limit")


def nodes(lower: float, upper: float, count: int) -> tuple[Array, Array]:
    """Nodes and weights of Gauss-Legendre quadrature, each of shape (at least count,)."""
    at, weight = _unit(16 * ceil(count / 16))
    half = 0.5 * (upper - lower)
    return lower + half * (at + 1.0), half * weight


@lru_cache(maxsize=64)
def _unit(count: int) -> tuple[Array, Array]:
    at, weight = special.roots_legendre(count)
    return at, weight
