"""The information matrix of the rows seen, kept as factors, and the one kernel that brings a row into them.

    A = sum of forgetting^age * phi phi' = R' D R,     R unit upper triangular, D diagonal.

A row enters by square-root-free Givens rotations (Gentleman, J. Inst. Maths Applics 12 (1973) 329; in the
form of Miller's algorithm AS 274, Applied Statistics 41 (1992) 458). For each pivot i, with the row x of weight w:

    d' = d_i + w x_i^2     gain = w x_i / d'     w <- w d_i / d'     d_i <- d'
    x_j <- x_j - x_i r_ij    then    r_ij <- r_ij + gain x_j         (j > i, and in the same way the output and z_i)

The remaining weight at the end is 1 - phi' A^-1 phi, and the parameters solve R theta = z.

Without forgetting, r_ij and z_i are sums of ever more, ever smaller terms, and rounding them is what costs accuracy:
at condition 1e8 the parameters lose a digit or two against LAPACK. A second number therefore holds what the first one
rounds away, found by Knuth's exact sum (The Art of Computer Programming, vol. 2, section 4.2.2, theorem B). With
forgetting, rounding is forgotten too.

The memory of an estimator is a tile, an array (quantity, plant), of one plant.
"""

import numpy as np
from numpy.typing import NDArray

from reactorwatch.codegen.numba_kernel import jit

LARGEST_VALUE = 1e30
"""Regressors and outputs at or beyond this are refused."""

# Where nothing is known beforehand, a pivot below this share of its column's sum of squares is rounding, not
# information: a condition beyond 1e13. Where something is, every pivot carries on what is known of those before it.
RANK_SHARE = 1e-26
# Nor is one below this, whatever its column; with LARGEST_VALUE it keeps every product finite.
_LEAST_PIVOT = 1e-60

# The rows of a tile for n parameters: n each of theta, z (the rotated outputs), d (the diagonal), q (the columns'
# sums of squares) and what z rounds away; then SQUARES to ROWS; then R's n(n-1)/2 entries above the diagonal, by
# rows, and what they round away.
SQUARES, WEIGHT, WEIGHT2, TURN, ROWS = range(5)
_SUMS = 5

# The rows of the work space, which no update needs from the one before: n of x, the row being rotated in; then these.
LEFT, GAIN, OUTPUT, PREDICTION, RESIDUAL, SPREAD, LEVERAGE, USED = range(8)
_WORK = 8


def state_size(n: int) -> int:
    """Size of the state of one plant with n parameters."""
    return 5 * n + _SUMS + n * (n - 1)


def work_size(n: int) -> int:
    """Size of the work space of one plant."""
    return n + _WORK


@jit
def rotate(
    tile: NDArray[np.float64], work: NDArray[np.float64], n: int, first: int, exact: bool, rank_share: float
) -> None:
    """Bring the row in the work space, of weight LEFT, into R, D and z.

    Args:
        tile: shape (state_size(n), plants).
        work: shape (work_size(n), plants).
        n: number of parameters.
        first: x holds zeros before this index.
        exact: whether sums are compensated.
        rank_share: a pivot that would stay below this share of its column's sum of squares is passed over.
    """
    plants = tile.shape[1]
    upper = 5 * n + _SUMS
    fine = n * (n - 1) // 2
    left, gain, output = n + LEFT, n + GAIN, n + OUTPUT
    entry = upper + first * (n - 1) - first * (first - 1) // 2
    for i in range(first, n):
        for p in range(plants):
            value = work[i, p]
            old = tile[2 * n + i, p]
            weighted = work[left, p] * value
            new = old + weighted * value
            informs = new > rank_share * tile[3 * n + i, p] + _LEAST_PIVOT
            share = weighted / new if informs else 0.0
            target, small = tile[n + i, p], tile[4 * n + i, p]
            rest = work[output, p] - value * target - value * small
            work[gain, p] = share
            work[left, p] *= old / new if informs else 1.0
            tile[2 * n + i, p] = new if informs else old
            work[output, p] = rest if informs else work[output, p]
            step = share * rest + small
            total = target + step
            added = total - target
            tile[n + i, p] = total
            tile[4 * n + i, p] = (target - (total - added)) + (step - added)
        for j in range(i + 1, n):
            if exact:
                for p in range(plants):
                    above, small = tile[entry, p], tile[entry + fine, p]
                    value = work[j, p] - work[i, p] * above - work[i, p] * small
                    work[j, p] = value
                    step = work[gain, p] * value + small
                    total = above + step
                    added = total - above
                    tile[entry, p] = total
                    tile[entry + fine, p] = (above - (total - added)) + (step - added)
            else:
                for p in range(plants):
                    above = tile[entry, p]
                    value = work[j, p] - work[i, p] * above
                    work[j, p] = value
                    tile[entry, p] = above + work[gain, p] * value
            entry += 1


@jit
def solve(tile: NDArray[np.float64], work: NDArray[np.float64], n: int) -> None:
    """Set theta to the solution of R theta = z, for the plants whose row counts."""
    plants = tile.shape[1]
    fine = n * (n - 1) // 2
    entry = 5 * n + _SUMS + fine
    used = n + USED
    for i in range(n - 1, -1, -1):
        for p in range(plants):
            tile[i, p] = tile[n + i, p] + tile[4 * n + i, p] if work[used, p] > 0.0 else tile[i, p]
        entry -= n - 1 - i
        for j in range(i + 1, n):
            for p in range(plants):
                tile[i, p] -= tile[entry + j - i - 1, p] * tile[j, p] if work[used, p] > 0.0 else 0.0


@jit
def learn(
    tile: NDArray[np.float64],
    work: NDArray[np.float64],
    n: int,
    forgetting: float,
    renewal: float,
    rank_share: float,
) -> None:
    """Take one row a plant: predict, then forget, rotate, solve, and renew the floor of one coordinate.

    On entry x holds the regressor, OUTPUT the output and USED 1 for a plant whose row counts, 0 for one that has no
    row (its x and OUTPUT must be finite; its state stays as it is). On return PREDICTION and RESIDUAL are those
    before the update, SPREAD is the standard deviation of such a residual and LEVERAGE the row's.

    Args:
        tile: shape (state_size(n), plants).
        work: shape (work_size(n), plants).
        n: number of parameters.
        forgetting: weight of a row relative to its successor.
        renewal: weight of the floor row that one coordinate a row gets, in turn; 0 without forgetting.
        rank_share: RANK_SHARE where nothing was known at the start, else 0.
    """
    plants = tile.shape[1]
    sums = 5 * n
    for p in range(plants):
        work[n + PREDICTION, p] = 0.0
        work[n + LEFT, p] = work[n + USED, p]
    for i in range(n):
        for p in range(plants):
            used = work[n + USED, p] > 0.0
            value = work[i, p]
            work[n + PREDICTION, p] += value * tile[i, p]
            tile[2 * n + i, p] *= forgetting if used else 1.0
            tile[3 * n + i, p] += value * value if used else 0.0
    for p in range(plants):
        work[n + RESIDUAL, p] = work[n + OUTPUT, p] - work[n + PREDICTION, p]
    # With forgetting, rounding is forgotten too.
    rotate(tile, work, n, 0, forgetting == 1.0, rank_share)
    solve(tile, work, n)
    for p in range(plants):
        used = work[n + USED, p] > 0.0
        residual = work[n + RESIDUAL, p]
        left = work[n + LEFT, p]
        squares, weight, weight2 = tile[sums + SQUARES, p], tile[sums + WEIGHT, p], tile[sums + WEIGHT2, p]
        share = weight2 / weight if weight > 0.0 else 1.0
        free = weight - n * share
        variance = squares / free if free > 0.0 else np.inf
        work[n + SPREAD, p] = np.sqrt(variance * (1.0 + share * (1.0 - left) / left)) if left > 0.0 else np.inf
        work[n + LEVERAGE, p] = 1.0 - left
        tile[sums + SQUARES, p] = forgetting * squares + residual * residual * left if used else squares
        tile[sums + WEIGHT, p] = forgetting * weight + 1.0 if used else weight
        tile[sums + WEIGHT2, p] = forgetting * forgetting * weight2 + 1.0 if used else weight2
        tile[sums + ROWS, p] += work[n + USED, p]
    if renewal == 0.0:
        return
    first = n
    for p in range(plants):
        first = min(first, int(tile[sums + TURN, p]))
        work[n + LEFT, p] = renewal * work[n + USED, p]
        work[n + OUTPUT, p] = 0.0
    for i in range(n):
        for p in range(plants):
            turn = 1.0 if tile[sums + TURN, p] == i else 0.0
            work[i, p] = turn
            work[n + OUTPUT, p] += turn * tile[i, p]
    rotate(tile, work, n, first, False, 0.0)
    for p in range(plants):
        turn = tile[sums + TURN, p] + work[n + USED, p]
        tile[sums + TURN, p] = turn if turn < n else 0.0


@jit
def is_acceptable(regressor: NDArray[np.float64], output: float) -> bool:
    """True if every value is a number smaller in magnitude than LARGEST_VALUE."""
    fine = abs(output) < LARGEST_VALUE
    for i in range(regressor.size):
        fine = fine and abs(regressor[i]) < LARGEST_VALUE
    return fine


@jit
def learn_one(
    tile: NDArray[np.float64],
    regressor: NDArray[np.float64],
    output: float,
    forgetting: float,
    renewal: float,
    rank_share: float,
) -> tuple[float, float, float, float]:
    """`learn` for a tile of one plant that ends with its work space; an unacceptable row changes nothing.

    Returns:
        Prediction, residual, its standard deviation and the leverage; four NaN if the row is not acceptable.
    """
    if not is_acceptable(regressor, output):
        return np.nan, np.nan, np.nan, np.nan
    n = regressor.size
    work = tile[tile.shape[0] - n - _WORK :]
    for i in range(n):
        work[i, 0] = regressor[i]
    work[n + OUTPUT, 0] = output
    work[n + USED, 0] = 1.0
    learn(tile, work, n, forgetting, renewal, rank_share)
    return work[n + PREDICTION, 0], work[n + RESIDUAL, 0], work[n + SPREAD, 0], work[n + LEVERAGE, 0]
