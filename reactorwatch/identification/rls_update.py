"""The recursive least squares update of a row: the kernel that brings it into the factored information matrix.

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

# The numbers of an estimator of n parameters: n each of theta, z (the rotated outputs), d (the diagonal), q (the
# columns' sums of squares) and what z rounds away; then SQUARES to ROWS; then R's n(n-1)/2 entries above the diagonal,
# by rows, and what they round away.
SQUARES, WEIGHT, WEIGHT2, TURN, ROWS = range(5)
SUMS = 5


def state_size(n: int) -> int:
    """Number of numbers of an estimator with n parameters."""
    return 5 * n + SUMS + n * (n - 1)


@jit
def rotate(
    numbers: NDArray[np.float64],
    row: NDArray[np.float64],
    weight: float,
    output: float,
    first: int,
    exact: bool,
    rank_share: float,
) -> float:
    """Bring a row into R, D and z; returns the weight that remains.

    Args:
        numbers: numbers of the estimator, shape (state_size(n),).
        row: regressor, shape (n,), which is rotated in place.
        weight: weight of the row.
        output: output of the row.
        first: the regressor is zero before this index.
        exact: True to compensate the rounding of the sums.
        rank_share: a pivot that would stay below this share of its column's sum of squares is passed over.
    """
    n = row.size
    fine = n * (n - 1) // 2
    entry = 5 * n + SUMS + first * (n - 1) - first * (first - 1) // 2
    for i in range(first, n):
        value, old = row[i], numbers[2 * n + i]
        weighted = weight * value
        new = old + weighted * value
        informs = new > rank_share * numbers[3 * n + i] + _LEAST_PIVOT
        gain = weighted / new if informs else 0.0
        target, small = numbers[n + i], numbers[4 * n + i]
        rest = output - value * target - value * small
        if informs:
            weight *= old / new
            numbers[2 * n + i] = new
            output = rest
        step = gain * rest + small
        total = target + step
        added = total - target
        numbers[n + i] = total
        numbers[4 * n + i] = (target - (total - added)) + (step - added)
        for j in range(i + 1, n):
            above = numbers[entry]
            if exact:
                small = numbers[entry + fine]
                row[j] = row[j] - value * above - value * small
                step = gain * row[j] + small
                total = above + step
                added = total - above
                numbers[entry] = total
                numbers[entry + fine] = (above - (total - added)) + (step - added)
            else:
                row[j] -= value * above
                numbers[entry] = above + gain * row[j]
            entry += 1
    return weight


@jit
def solve(numbers: NDArray[np.float64], n: int) -> None:
    """Set theta to the solution of R theta = z."""
    entry = 5 * n + SUMS + n * (n - 1) // 2
    for i in range(n - 1, -1, -1):
        numbers[i] = numbers[n + i] + numbers[4 * n + i]
        entry -= n - 1 - i
        for j in range(i + 1, n):
            numbers[i] -= numbers[entry + j - i - 1] * numbers[j]


@jit
def is_acceptable(regressor: NDArray[np.float64], output: float) -> bool:
    """True if every value is a number smaller in magnitude than LARGEST_VALUE."""
    fine = abs(output) < LARGEST_VALUE
    for i in range(regressor.size):
        fine = fine and abs(regressor[i]) < LARGEST_VALUE
    return fine


@jit
def update(
    numbers: NDArray[np.float64],
    work: NDArray[np.float64],
    regressor: NDArray[np.float64],
    output: float,
    forgetting: float,
    renewal: float,
    rank_share: float,
) -> tuple[float, float, float, float]:
    """Predict a row, then forget, rotate, solve, and renew the floor of one coordinate.

    Args:
        numbers: numbers of the estimator, shape (state_size(n),).
        work: work space, shape (n,).
        regressor: shape (n,).
        output: the measured output.
        forgetting: weight of a row relative to its successor.
        renewal: weight of the floor row that one coordinate a row gets, in turn; 0 without forgetting.
        rank_share: RANK_SHARE where nothing was known at the start, else 0.

    Returns:
        Prediction and residual before the update, the standard deviation of such a residual and the leverage; four NaN
        if the row is not acceptable: then nothing changes.
    """
    if not is_acceptable(regressor, output):
        return np.nan, np.nan, np.nan, np.nan
    n = regressor.size
    sums = numbers[5 * n : 5 * n + SUMS]
    prediction = 0.0
    for i in range(n):
        value = regressor[i]
        work[i] = value
        prediction += value * numbers[i]
        numbers[2 * n + i] *= forgetting
        numbers[3 * n + i] += value * value
    residual = output - prediction
    # With forgetting, rounding is forgotten too.
    left = rotate(numbers, work, 1.0, output, 0, forgetting == 1.0, rank_share)
    solve(numbers, n)
    squares, weight, weight2 = sums[SQUARES], sums[WEIGHT], sums[WEIGHT2]
    share = weight2 / weight if weight > 0.0 else 1.0
    free = weight - n * share
    variance = squares / free if free > 0.0 else np.inf
    residual_sd = np.sqrt(variance * (1.0 + share * (1.0 - left) / left)) if left > 0.0 else np.inf
    sums[SQUARES] = forgetting * squares + residual * residual * left
    sums[WEIGHT] = forgetting * weight + 1.0
    sums[WEIGHT2] = forgetting * forgetting * weight2 + 1.0
    sums[ROWS] += 1.0
    if renewal > 0.0:
        turn = int(sums[TURN])
        work[:] = 0.0
        work[turn] = 1.0
        rotate(numbers, work, renewal, numbers[turn], turn, False, 0.0)
        sums[TURN] = float(turn + 1 if turn + 1 < n else 0)
    return prediction, residual, residual_sd, 1.0 - left
