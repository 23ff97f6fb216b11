"""The information matrix of the rows seen, kept as factors, and the kernel that brings a row into them.

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

# The state for n parameters: n each of theta, z (the rotated outputs), d (the diagonal), q (the columns' sums of
# squares) and what z rounds away; then SQUARES to ROWS; then R's n(n-1)/2 entries above the diagonal, by rows, and what
# they round away; then n of x, the row being rotated in, which no update needs from the one before.
SQUARES, WEIGHT, WEIGHT2, TURN, ROWS = range(5)
SUMS = 5


def state_size(n: int) -> int:
    """Size of the state with n parameters, without the row being rotated in."""
    return 5 * n + SUMS + n * (n - 1)


@jit
def _rotate(
    state: NDArray[np.float64], n: int, first: int, left: float, output: float, exact: bool, rank_share: float
) -> float:
    """Bring the row x of a weight and an output into R, D and z; returns the weight that remains.

    Args:
        state: shape (state_size(n) + n,).
        n: number of parameters.
        first: x holds zeros before this index.
        left: weight of the row.
        output: output of the row.
        exact: whether sums are compensated.
        rank_share: a pivot that would stay below this share of its column's sum of squares is passed over.
    """
    fine = n * (n - 1) // 2
    x = state[state.size - n :]
    entry = 5 * n + SUMS + first * (n - 1) - first * (first - 1) // 2
    for i in range(first, n):
        value, old = x[i], state[2 * n + i]
        weighted = left * value
        new = old + weighted * value
        target, small = state[n + i], state[4 * n + i]
        rest, gain = output - value * target - value * small, 0.0
        if new > rank_share * state[3 * n + i] + _LEAST_PIVOT:
            gain = weighted / new
            left *= old / new
            state[2 * n + i] = new
            output = rest
        step = gain * rest + small
        total = target + step
        added = total - target
        state[n + i] = total
        state[4 * n + i] = (target - (total - added)) + (step - added)
        for j in range(i + 1, n):
            above = state[entry]
            if exact:
                small = state[entry + fine]
                x[j] = x[j] - value * above - value * small
                step = gain * x[j] + small
                total = above + step
                added = total - above
                state[entry] = total
                state[entry + fine] = (above - (total - added)) + (step - added)
            else:
                x[j] = x[j] - value * above
                state[entry] = above + gain * x[j]
            entry += 1
    return left


@jit
def _solve(state: NDArray[np.float64], n: int) -> None:
    """Set theta to the solution of R theta = z."""
    entry = 5 * n + SUMS + n * (n - 1) // 2
    for i in range(n - 1, -1, -1):
        state[i] = state[n + i] + state[4 * n + i]
        entry -= n - 1 - i
        for j in range(i + 1, n):
            state[i] -= state[entry + j - i - 1] * state[j]


@jit
def learn(
    state: NDArray[np.float64],
    regressor: NDArray[np.float64],
    output: float,
    forgetting: float,
    renewal: float,
    rank_share: float,
) -> tuple[float, float, float, float]:
    """Take a row: predict, then forget, rotate, solve, and renew the floor of one coordinate.

    Args:
        state: shape (state_size(n) + n,); a row with a value that is not a number below LARGEST_VALUE in size leaves
            it as it is.
        regressor: shape (n,).
        output: the measured output.
        forgetting: weight of a row relative to its successor.
        renewal: weight of the floor row that one coordinate a row gets, in turn; 0 without forgetting.
        rank_share: RANK_SHARE where nothing was known at the start, else 0.

    Returns:
        Prediction and residual before the update, the standard deviation of such a residual and the leverage of the
        row; four NaN if the row is not acceptable.
    """
    n, sums = regressor.size, 5 * regressor.size
    is_acceptable = abs(output) < LARGEST_VALUE
    for i in range(n):
        is_acceptable = is_acceptable and abs(regressor[i]) < LARGEST_VALUE
    if not is_acceptable:
        return np.nan, np.nan, np.nan, np.nan
    x = state[state.size - n :]
    prediction = 0.0
    for i in range(n):
        x[i] = regressor[i]
        prediction += x[i] * state[i]
        state[2 * n + i] *= forgetting
        state[3 * n + i] += x[i] * x[i]
    residual = output - prediction
    # With forgetting, rounding is forgotten too.
    left = _rotate(state, n, 0, 1.0, output, forgetting == 1.0, rank_share)
    _solve(state, n)
    squares, weight, weight2 = state[sums + SQUARES], state[sums + WEIGHT], state[sums + WEIGHT2]
    share = weight2 / weight if weight > 0.0 else 1.0
    free = weight - n * share
    variance = squares / free if free > 0.0 else np.inf
    spread = np.sqrt(variance * (1.0 + share * (1.0 - left) / left)) if left > 0.0 else np.inf
    state[sums + SQUARES] = forgetting * squares + residual * residual * left
    state[sums + WEIGHT] = forgetting * weight + 1.0
    state[sums + WEIGHT2] = forgetting * forgetting * weight2 + 1.0
    state[sums + ROWS] += 1.0
    if renewal > 0.0:
        turn = int(state[sums + TURN])
        x[:] = 0.0
        x[turn] = 1.0
        _rotate(state, n, turn, renewal, state[turn], False, 0.0)
        state[sums + TURN] = turn + 1.0 if turn + 1 < n else 0.0
    return prediction, residual, spread, 1.0 - left
