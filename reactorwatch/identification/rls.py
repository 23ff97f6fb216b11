"""Recursive least squares that can run for years.

The covariance form of the textbooks fails in service: without excitation its forgetting divides the covariance by
`forgetting` at every row until it overflows, and rounding makes it indefinite. Here the information matrix A is kept
as factors R' D R (below). Two things follow.

*Nothing need be assumed.* D = 0 is a valid start: no prior, no "large P(0)". Without forgetting the result is the QR
solution of the batch problem, and as accurate. A column that is dependent on those before it keeps the parameter 0
and an infinite standard deviation until rows resolve it.

*Forgetting costs n multiplications*, D <- forgetting D, and leaves the parameters exactly as they are. It has a floor.
Salgado, Goodwin and Middleton (Int. J. Control 47 (1988) 477) forget only what exceeds a floor: A <- forgetting A +
(1 - forgetting) floor I. The floor is information about the parameters as they now are, so it pulls them nowhere. It is
renewed one coordinate a row, in turn (the idea is Gunnarsson's, Proc. 35th IEEE Conference on Decision and Control,
1996), by a row e_i with the output theta_i. With f for forgetting, the weight floor (1 - f^n) / f^(n-1), and a start at
A = floor / f^(n-1) I, a coordinate holds floor / f^(n-1) just after its turn and still the floor when its turn comes
again. Hence, with P = A^-1 and `covariance_limit` = 1 / floor, whatever the data are and for ever,

    0 < every eigenvalue of P <= covariance_limit,
    every eigenvalue of A <= (largest phi' phi) / (1 - f) + 1 / (covariance_limit f^(n-1)),

to rounding for regressors scaled to the order of 1.
Forgetting so acts only along directions that the data excite. Along the others the covariance rises to its limit, the
parameters stay constant, and the first exciting rows identify them again.

*Innovation variance and standard deviations* allow for the weights. With W = sum of f^age and W2 = sum of f^(2 age),
white noise of variance s2 gives cov(theta) = s2 P W2/W, and the weighted sum of squares, which grows by
residual^2 (1 - leverage) a row, has the expectation s2 (W - n W2/W). Without forgetting these are the familiar
s2 P and N - n.

*The update of a row* (`update_row`) brings it into the information matrix

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

import math
from typing import Self

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import InputError
from reactorwatch.stored_state import Memory

LARGEST_VALUE = 1e30  # regressors and outputs at or beyond this are refused: all products are then finite

# The numbers of an estimator of n parameters: n each of theta, z (the rotated outputs), d (the diagonal), q (the
# columns' sums of squares) and what z rounds away; then SQUARES to ROWS; then R's n(n-1)/2 entries above the diagonal,
# by rows, and what they round away.
SQUARES, WEIGHT, WEIGHT2, TURN, ROWS, SUMS = range(6)


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
    """Bring a row into R, D and z; returns the weight that remains. The row is zero before the index `first`."""
    n = row.size
    fine = n * (n - 1) // 2
    entry = 5 * n + SUMS + first * (n - 1) - first * (first - 1) // 2
    for i in range(first, n):
        value, old = row[i], numbers[2 * n + i]
        weighted = weight * value
        new = old + weighted * value
        informs = new > rank_share * numbers[3 * n + i] + 1e-60  # less is no information
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
def update_row(
    numbers: NDArray[np.float64],
    work: NDArray[np.float64],
    regressor: NDArray[np.float64],
    output: float,
    forgetting: float,
    renewal: float,
    rank_share: float,
) -> tuple[float, float, float, float]:
    """Predict a row, then forget, rotate, solve, and renew the floor of one coordinate, a row of the weight `renewal`.

    Returns:
        The numbers of `RlsUpdate`; four NaN if the row is not acceptable: then nothing changes.
    """
    n, is_acceptable = regressor.size, abs(output) < LARGEST_VALUE
    for i in range(n):
        is_acceptable = is_acceptable and abs(regressor[i]) < LARGEST_VALUE
    if not is_acceptable:
        return np.nan, np.nan, np.nan, np.nan
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
    entry = 5 * n + SUMS + n * (n - 1) // 2
    for i in range(n - 1, -1, -1):  # theta solves R theta = z
        numbers[i] = numbers[n + i] + numbers[4 * n + i]
        entry -= n - 1 - i
        for j in range(i + 1, n):
            numbers[i] -= numbers[entry + j - i - 1] * numbers[j]
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


@jit
def solve_leverage(numbers: NDArray[np.float64], work: NDArray[np.float64], regressor: NDArray[np.float64]) -> float:
    """Leverage of a row to come, phi' A^-1 phi: the squares of R'^-1 phi by D; 0 where no row has resolved anything."""
    n, total = regressor.size, 0.0
    entry = 5 * n + SUMS
    work[:] = regressor
    for i in range(n):
        if numbers[2 * n + i] > 0.0:
            total += work[i] * work[i] / numbers[2 * n + i]
        for j in range(i + 1, n):
            work[j] -= numbers[entry] * work[i]
            entry += 1
    return total


class RlsMemory(Memory):
    """Memory of a recursive estimator.

    Attributes:
        parameters: number of parameters.
        forgetting: weight of a row relative to its successor.
        covariance_limit: bound on the eigenvalues of P.
        numbers: laid out as above.
    """

    parameters: int
    forgetting: float
    covariance_limit: float
    numbers: Array


class RlsUpdate(msgspec.Struct, frozen=True, gc=False):
    """Result of a row's update.

    Attributes:
        prediction: prediction of the output before the update.
        residual: output - prediction.
        residual_sd: standard deviation of the residual by the rows before, from noise and uncertain parameters; inf
            until there are more rows than parameters.
        leverage: share of this row in the prediction of its own output after the update, 0 to 1.
    """

    prediction: float
    residual: float
    residual_sd: float
    leverage: float


class RecursiveLeastSquares:
    """y = regressor . parameters + noise, learned row by row.

    Regressors should be of the order of 1 (`structure.Scaling`): `covariance_limit` counts in their units.

    >>> rls = RecursiveLeastSquares(2)
    >>> innovations = [rls.update([k, 1.0], 3.0 * k - 1.0) for k in range(5)]
    >>> rls.parameters
    array([ 3., -1.])

    Args:
        parameters: number of parameters, n.
        forgetting: weight of a row relative to its successor, in (0, 1]; the memory is 1 / (1 - forgetting) rows.
        covariance_limit: bound on the eigenvalues of `covariance`, and their value at the start. The default is
            1e6; without forgetting it is inf: nothing is assumed at the start.

    Raises:
        InputError: a setting out of its range.

    Attributes:
        memory: the settings and what was learned: what runs, and what is stored.
        forgetting: weight of a row relative to its successor.
    """

    memory_type = RlsMemory

    def __init__(self, parameters: int, forgetting: float = 1.0, covariance_limit: float | None = None) -> None:
        if parameters < 1:
            raise InputError(f"parameters must be at least 1, got {parameters}")
        if covariance_limit is None:
            covariance_limit = math.inf if forgetting == 1.0 else 1e6
        if not covariance_limit > 1.0 / LARGEST_VALUE:
            raise InputError(f"covariance_limit must be above {1.0 / LARGEST_VALUE}, got {covariance_limit}")
        numbers = np.zeros(5 * parameters + SUMS + parameters * (parameters - 1))
        self._use(RlsMemory(parameters, float(forgetting), float(covariance_limit), numbers))
        self._diagonal[:] = 1.0 / (covariance_limit * forgetting ** (parameters - 1))

    @classmethod
    def resume(cls, memory: RlsMemory) -> Self:
        """Estimator that goes on from a memory, bit for bit, which it updates.

        Raises:
            ValueError: the memory is damaged.
        """
        estimator = cls.__new__(cls)
        estimator._use(memory)
        return estimator

    def _use(self, memory: RlsMemory) -> None:
        size = 5 * memory.parameters + SUMS + memory.parameters * (memory.parameters - 1)
        if memory.numbers.shape != (size,):
            raise ValueError(f"{memory.parameters} parameters must have {size} numbers, got {memory.numbers.size}")
        self.memory, self._parameters = memory, memory.parameters
        self._covariance_limit = memory.covariance_limit
        # Where nothing is known beforehand, a pivot below this share of its column's sum of squares is rounding, not
        # information: a condition beyond 1e13. Where something is, every pivot carries on what is known before it.
        self._rank_share = 1e-26 if math.isinf(self._covariance_limit) else 0.0
        self._set_forgetting(memory.forgetting)
        n, self._numbers, self._work = memory.parameters, memory.numbers, np.zeros(memory.parameters)
        self._diagonal, self._sums = self._numbers[2 * n : 3 * n], self._numbers[5 * n : 5 * n + SUMS]

    def update(self, regressor: ArrayLike, output: float) -> RlsUpdate:
        """Predict the output, then learn from it.

        Args:
            regressor: shape (n,).
            output: the measured output.

        Raises:
            ValueError: a value that is NaN, infinite or beyond 1e30, or a wrong shape; nothing is changed then.
        """
        row = np.ascontiguousarray(regressor, dtype=np.float64)
        if row.ndim != 1 or row.size != self._parameters:
            raise ValueError(f"regressor must have shape ({self._parameters},), got {row.shape}")
        result = update_row(
            self._numbers, self._work, row, float(output), self._forgetting, self._renewal, self._rank_share
        )
        if result[0] != result[0]:
            values = {**{f"regressor[{i}]": value for i, value in enumerate(row)}, "output": output}
            name, value = next(
                ((name, value) for name, value in values.items() if not abs(value) < LARGEST_VALUE),
                ("the prediction", result[0]),  # of a damaged memory
            )
            raise ValueError(f"{name} must be a finite number below {LARGEST_VALUE:g} in size, got {value}")
        return RlsUpdate(*result)

    def predict(self, regressor: ArrayLike) -> float:
        """Predict an output with the present parameters."""
        return float(np.dot(np.asarray(regressor, dtype=np.float64), self._numbers[: self._parameters]))

    def leverage(self, regressor: Array) -> float:
        """Variance of a prediction by the present parameters, phi' P phi, in units of the noise's."""
        return float(solve_leverage(self._numbers, self._work, regressor))

    def set_parameters(self, parameters: ArrayLike) -> None:
        """Set the parameters, shape (n,), and keep their uncertainty.

        Raises:
            ValueError: a wrong shape, or a value that is not finite.
        """
        theta = np.asarray(parameters, dtype=np.float64)
        if theta.shape != (self._parameters,) or not np.all(np.isfinite(theta)):
            raise ValueError(f"parameters must be {self._parameters} finite numbers, got {theta}")
        n = self._parameters
        self._numbers[:n] = theta
        self._numbers[n : 2 * n] = self._factor() @ theta
        self._numbers[4 * n : 5 * n] = 0.0

    def raise_information(self, factor: float) -> None:
        """Count each of the rows so far as `factor` rows, so that rows to come change the parameters less.

        Raises:
            ValueError: the factor is below 1.
        """
        if not 1.0 <= factor < math.inf:
            raise ValueError(f"factor must be a number from 1 on, got {factor}")
        self._diagonal *= factor

    def raise_forgetting(self, forgetting: float) -> None:
        """Raise the forgetting factor from here on, for a recursion that starts with poor parameters.

        Raises:
            ValueError: a value below the present one, for which the covariance's bound would not hold, or above 1.
        """
        if forgetting < self.forgetting:
            raise ValueError(f"forgetting can only rise, from {self.forgetting}, got {forgetting}")
        self._set_forgetting(forgetting)

    @property
    def parameters(self) -> NDArray[np.float64]:
        """Parameters, shape (n,); 0 for one that no row has resolved yet."""
        return self._numbers[: self._parameters].copy()

    @property
    def rows(self) -> int:
        """Number of rows learned from."""
        return int(self._sums[ROWS])

    @property
    def covariance(self) -> NDArray[np.float64]:
        """P, shape (n, n): the inverse of the information matrix, in units of the noise variance."""
        inverse = np.linalg.inv(self._factor())
        with np.errstate(divide="ignore", invalid="ignore"):
            spread = np.where(inverse != 0.0, inverse / np.sqrt(self._diagonal), 0.0)
        if np.all(np.isfinite(spread)):
            return np.asarray(spread @ spread.T)
        # Along a direction without information two infinities of opposite sign have no sum: only variances are defined.
        variances = np.sum(spread * spread, axis=1)
        covariance = np.where(np.isinf(variances)[:, None] | np.isinf(variances)[None, :], np.nan, 0.0)
        known = np.isfinite(variances)
        covariance[np.ix_(known, known)] = spread[known] @ spread[known].T
        np.fill_diagonal(covariance, variances)
        return covariance

    @property
    def unit_covariance(self) -> NDArray[np.float64]:
        """Covariance of the parameters for noise of variance 1, P W2/W, shape (n, n)."""
        return self.covariance * self._weight_share()

    @property
    def noise_variance(self) -> float:
        """Variance of the residuals; inf until there are more rows than parameters."""
        sums = self._sums
        free = sums[WEIGHT] - self._parameters * self._weight_share()
        return float(sums[SQUARES] / free) if free > 0.0 else math.inf

    @property
    def parameter_covariance(self) -> NDArray[np.float64]:
        """Covariance of the parameters, shape (n, n); NaN where unknown, or without more rows than parameters."""
        variance, covariance = self.noise_variance, self.unit_covariance
        known = np.isfinite(covariance) & math.isfinite(variance)
        return np.where(known, covariance, math.nan) * (variance if math.isfinite(variance) else 1.0)

    @property
    def forgetting(self) -> float:
        """Weight of a row relative to its successor."""
        return self._forgetting

    @property
    def condition(self) -> float:
        """Condition number of the regressors in memory; inf if they don't determine the parameters."""
        values = np.linalg.svd(np.sqrt(self._diagonal)[:, None] * self._factor(), compute_uv=False)
        return float(values[0] / values[-1]) if values[-1] > 0.0 else math.inf

    def _set_forgetting(self, forgetting: float) -> None:
        if not 0.0 < forgetting <= 1.0:
            raise InputError(f"forgetting must be in (0, 1], got {forgetting}")
        if forgetting < 1.0 and not self._covariance_limit < LARGEST_VALUE:
            raise InputError(
                f"covariance_limit must be below {LARGEST_VALUE} when forgetting < 1, got {self._covariance_limit}"
            )
        n, f = self._parameters, float(forgetting)
        self._forgetting = self.memory.forgetting = f
        self._renewal = (1.0 - f**n) / (self._covariance_limit * f ** (n - 1))

    def _factor(self) -> NDArray[np.float64]:
        n = self._parameters
        factor = np.eye(n)
        factor[np.triu_indices(n, 1)] = self._numbers[5 * n + SUMS : 5 * n + SUMS + n * (n - 1) // 2]
        return factor

    def _weight_share(self) -> float:
        sums = self._sums
        return float(sums[WEIGHT2] / sums[WEIGHT]) if sums[WEIGHT] > 0.0 else 1.0
