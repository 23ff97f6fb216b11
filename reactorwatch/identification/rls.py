"""Recursive least squares that can run for years.

The covariance form of the textbooks fails in service: without excitation its forgetting divides the covariance by
`forgetting` at every row until it overflows, and rounding makes it indefinite. Here the information matrix A is kept
as factors R' D R (`rls_update`). Three things follow.

*Nothing need be assumed.* D = 0 is a valid start: no prior, no "large P(0)". Without forgetting the result is the QR
solution of the batch problem, and as accurate. A column that is dependent on those before it keeps the parameter 0
and an infinite standard deviation until rows resolve it.

*Forgetting costs n multiplications*, D <- forgetting D, and leaves the parameters exactly as they are.

*Forgetting has a floor.* Salgado, Goodwin and Middleton (Int. J. Control 47 (1988) 477) forget only what exceeds a
floor: A <- forgetting A + (1 - forgetting) floor I. The floor is information about the parameters as they now are,
so it pulls them nowhere. It is renewed one coordinate a row, in turn (the idea is Gunnarsson's, Proc. 35th IEEE
Conference on Decision and Control, 1996), by a row e_i with the output theta_i. With f for forgetting, the weight
floor (1 - f^n) / f^(n-1), and a start at A = floor / f^(n-1) I, a coordinate holds floor / f^(n-1) just after its
turn and still the floor when its turn comes again. Hence, with P = A^-1 and `covariance_limit` = 1 / floor, whatever
the data are and for ever,

    0 < every eigenvalue of P <= covariance_limit,
    every eigenvalue of A <= (largest phi' phi) / (1 - f) + 1 / (covariance_limit f^(n-1)),

to rounding for regressors scaled to the order of 1. (Sizes that differ by many powers of ten within a row cost digits
of the bound, as they do of any matrix, but never finiteness.)

Forgetting so acts only along directions that the data excite. Along the others the covariance rises to its limit and
remains there, the parameters stay constant, and the first exciting rows identify them again.

*Innovation variance and standard deviations* allow for the weights. With W = sum of f^age and W2 = sum of f^(2 age),
white noise of variance s2 gives cov(theta) = s2 P W2/W, and the weighted sum of squares, which grows by
residual^2 (1 - leverage) a row, has the expectation s2 (W - n W2/W). Without forgetting these are the familiar
s2 P and N - n.
"""

import math
from typing import Self

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.identification import rls_update
from reactorwatch.identification.rls_update import LARGEST_VALUE
from reactorwatch.stored_state import Memory

DEFAULT_COVARIANCE_LIMIT = 1e6


class RlsMemory(Memory):
    """Memory of a recursive estimator.

    Attributes:
        parameters: number of parameters.
        forgetting: weight of a row relative to its successor.
        covariance_limit: bound on the eigenvalues of P.
        numbers: shape (state_size(parameters),), laid out as in `rls_update`.
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

    Regressors should be of the order of 1 (`regressor.Scaling`): `covariance_limit` counts in their units.

    >>> rls = RecursiveLeastSquares(2)
    >>> for k in range(5):
    ...     innovation = rls.update([k, 1.0], 3.0 * k - 1.0)
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
    """

    memory_type = RlsMemory

    def __init__(self, parameters: int, forgetting: float = 1.0, covariance_limit: float | None = None) -> None:
        if parameters < 1:
            raise InputError(f"parameters must be at least 1, got {parameters}")
        if covariance_limit is None:
            covariance_limit = math.inf if forgetting == 1.0 else DEFAULT_COVARIANCE_LIMIT
        if not covariance_limit > 1.0 / LARGEST_VALUE:
            raise InputError(f"covariance_limit must be above {1.0 / LARGEST_VALUE}, got {covariance_limit}")
        numbers = np.zeros(rls_update.state_size(parameters))
        self._use(RlsMemory(parameters, float(forgetting), float(covariance_limit), numbers))
        start = 1.0 / (covariance_limit * forgetting ** (parameters - 1))
        self._numbers[2 * parameters : 3 * parameters] = start

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
        size = rls_update.state_size(memory.parameters)
        if memory.numbers.shape != (size,):
            raise ValueError(f"{memory.parameters} parameters must have {size} numbers, got {memory.numbers.size}")
        self.memory, self._parameters = memory, memory.parameters
        self._covariance_limit = memory.covariance_limit
        self._rank_share = rls_update.RANK_SHARE if math.isinf(self._covariance_limit) else 0.0
        self._set_forgetting(memory.forgetting)
        self._numbers, self._work = memory.numbers, np.zeros(memory.parameters)

    @property
    def forgetting(self) -> float:
        """Weight of a row relative to its successor."""
        return self._forgetting

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
        result = rls_update.update(
            self._numbers, self._work, row, float(output), self._forgetting, self._renewal, self._rank_share
        )
        if result[0] != result[0]:
            raise ValueError(_describe_invalid(row, output))
        return RlsUpdate(*result)

    def predict(self, regressor: ArrayLike) -> float:
        """Predict an output with the present parameters."""
        return float(np.dot(np.asarray(regressor, dtype=np.float64), self._numbers[: self._parameters]))

    def set_parameters(self, parameters: ArrayLike) -> None:
        """Set the parameters and keep their uncertainty.

        Args:
            parameters: shape (n,).

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
        """Count the rows so far as more, so that rows to come change the parameters less.

        Args:
            factor: number of rows for one, at least 1.

        Raises:
            ValueError: the factor is below 1.
        """
        if not 1.0 <= factor < math.inf:
            raise ValueError(f"factor must be a number from 1 on, got {factor}")
        n = self._parameters
        self._numbers[2 * n : 3 * n] *= factor

    def raise_forgetting(self, forgetting: float) -> None:
        """Raise the forgetting factor from here on, for a recursion that starts with poor parameters.

        Raises:
            ValueError: a value below the present one, for which the covariance's bound would not hold, or above 1.
        """
        if forgetting < self._forgetting:
            raise ValueError(f"forgetting can only rise, from {self._forgetting}, got {forgetting}")
        self._set_forgetting(forgetting)

    @property
    def parameters(self) -> NDArray[np.float64]:
        """Parameters, shape (n,); 0 for one that no row has resolved yet."""
        return self._numbers[: self._parameters].copy()

    @property
    def rows(self) -> int:
        """Number of rows learned from."""
        return int(self._sums()[rls_update.ROWS])

    @property
    def covariance(self) -> NDArray[np.float64]:
        """P, shape (n, n): the inverse of the information matrix, in units of the noise variance."""
        inverse = np.linalg.inv(self._factor())
        with np.errstate(divide="ignore", invalid="ignore"):
            spread = np.where(inverse != 0.0, inverse / np.sqrt(self._diagonal()), 0.0)
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
        sums = self._sums()
        free = sums[rls_update.WEIGHT] - self._parameters * self._weight_share()
        return float(sums[rls_update.SQUARES] / free) if free > 0.0 else math.inf

    @property
    def parameter_covariance(self) -> NDArray[np.float64]:
        """Covariance of the parameters, shape (n, n); NaN where unknown, or without more rows than parameters."""
        variance, covariance = self.noise_variance, self.unit_covariance
        known = np.isfinite(covariance) & math.isfinite(variance)
        return np.where(known, covariance, math.nan) * (variance if math.isfinite(variance) else 1.0)

    @property
    def standard_deviations(self) -> NDArray[np.float64]:
        """Standard deviations of the parameters, shape (n,); inf where unknown or with too few rows."""
        variances = np.diag(self.parameter_covariance)
        return np.sqrt(np.where(np.isnan(variances), math.inf, variances))

    @property
    def condition(self) -> float:
        """Condition number of the regressors in memory; inf if they don't determine the parameters."""
        values = np.linalg.svd(np.sqrt(self._diagonal())[:, None] * self._factor(), compute_uv=False)
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
        factor[np.triu_indices(n, 1)] = self._numbers[5 * n + 5 : 5 * n + 5 + n * (n - 1) // 2]
        return factor

    def _diagonal(self) -> NDArray[np.float64]:
        return np.asarray(self._numbers[2 * self._parameters : 3 * self._parameters])

    def _sums(self) -> NDArray[np.float64]:
        return np.asarray(self._numbers[5 * self._parameters : 5 * self._parameters + 5])

    def _weight_share(self) -> float:
        sums = self._sums()
        return float(sums[rls_update.WEIGHT2] / sums[rls_update.WEIGHT]) if sums[rls_update.WEIGHT] > 0.0 else 1.0


def _describe_invalid(regressor: NDArray[np.float64], output: float) -> str:
    """Message for an invalid row."""
    for i, value in enumerate(regressor):
        if not abs(value) < LARGEST_VALUE:
            return f"regressor[{i}] must be a finite number below {LARGEST_VALUE:g} in size, got {value}"
    return f"output must be a finite number below {LARGEST_VALUE:g} in size, got {output}"
