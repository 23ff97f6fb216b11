"""Size of residuals after moves of the inputs, relative to their size in the training.

The residuals of a model that is wrong are larger after moves than at rest: they are errors of the model, not chance,
and limits for chance do not hold there. The screening may even take them for outliers. A residual that is white does
not depend on moves before it, also in closed loop, where a controller moves the input because of earlier residuals.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from reactorwatch.arrays import Array

ROWS_AFTER = 5
"""Rows after a move in which the residual is compared."""

MOST_MOVED = 0.1
"""Share of the rows that are compared with the others: those after the largest moves; more if moves are equal."""

UNLIKELY = 0.003
"""Probability of so different residuals by chance below which they depend on the moves."""

FEWEST = 5
LARGEST = 10.0
_QUANTILE, _NORMAL_QUANTILE = 0.97, 2.17


class AfterMoves(NamedTuple):
    """Residuals after the largest moves of the inputs.

    Attributes:
        size: their size in standard deviations, of the output where it is largest; 1 if it does not depend on moves.
        share: share of the rows that are after these moves.
    """

    size: float = 1.0
    share: float = 0.0

    def excess_rate(self, arl0: float) -> float:
        """Times as many false alarms as promised.

        Residuals that are larger by a factor s make an in-control run length A one of A^(1 / s^2).

        >>> AfterMoves().excess_rate(1e5), AfterMoves(2.0, 0.1).excess_rate(1e4)
        (1.0, 100.9)
        """
        return 1.0 - self.share + self.share * float(arl0 ** (1.0 - 1.0 / self.size**2))


def compare_after_moves(e: Array, inputs: Array) -> AfterMoves:
    """Compare residuals after moves of the inputs with the others.

    >>> rng = np.random.default_rng(0)
    >>> u = np.repeat(rng.normal(size=(100, 1)), 20, axis=0)
    >>> e = rng.normal(size=(2000, 1))
    >>> compare_after_moves(e, u).size
    1.0
    >>> for rows in (2, 3, 4):
    ...     e[rows:] += 2.0 * np.diff(u, axis=0)[: 1 - rows]
    >>> compare_after_moves(e, u).size > 1.2
    True

    Args:
        e: prewhitened residuals of all rows, shape (rows, outputs); NaN if missing, infinite for outliers.
        inputs: shape (rows, inputs).
    """
    moved = after_largest_moves(inputs)
    found, share = AfterMoves(), float(np.mean(moved))
    for column in np.abs(e.T):
        known = ~np.isnan(column)
        after, others = column[known & moved], column[known & ~moved]
        if min(len(after), len(others)) < FEWEST:
            continue
        size = float(np.quantile(np.minimum(after, LARGEST), _QUANTILE)) / _NORMAL_QUANTILE
        if size > found.size and probability_of_larger(after, others) < UNLIKELY / e.shape[1]:
            found = AfterMoves(size, share)
    return found


def after_largest_moves(inputs: Array) -> NDArray[np.bool_]:
    """Flags of the rows after the largest moves of an input, about `MOST_MOVED` of them, shape (rows,)."""
    known = [column[np.isfinite(column)] for column in inputs.T]
    spreads = np.array([np.std(column) if column.size else 0.0 for column in known])
    used = inputs[:, spreads > 0.0] / spreads[spreads > 0.0]
    if not used.size:
        return np.zeros(len(inputs), dtype=np.bool_)
    moves = np.nan_to_num(np.abs(np.diff(used, axis=0))).max(axis=1)
    before = np.concatenate([np.zeros(ROWS_AFTER + 1), moves])[: len(inputs) + ROWS_AFTER - 1]
    recent = np.lib.stride_tricks.sliding_window_view(before, ROWS_AFTER).max(axis=1)
    limit = np.quantile(recent, 1.0 - MOST_MOVED)
    moved = recent > limit
    return np.asarray(moved if moved.any() else (recent == limit) & (recent > 0.0))


def probability_of_larger(values: Array, others: Array) -> float:
    """Probability by chance that values rank so high among others (Mann & Whitney 1947, normal approximation).

    >>> round(probability_of_larger(np.arange(5.0, 15.0), np.arange(10.0)), 4)  # scipy.stats.mannwhitneyu
    0.0025
    """
    first, second, both = len(values), len(others), np.concatenate([values, others])
    _, index, counts = np.unique(both, return_inverse=True, return_counts=True)
    ranks = (np.cumsum(counts) - 0.5 * (counts - 1))[index]
    total = first + second
    above = float(ranks[:first].sum()) - 0.5 * first * (first + 1) - 0.5 * first * second
    ties = float(np.sum(counts**3.0 - counts)) / (total * (total - 1.0))
    sd = np.sqrt(first * second / 12.0 * (total + 1.0 - ties))
    return float(ndtr(-(above - 0.5) / sd)) if sd > 0.0 else 1.0
