"""Adaptation of the parameters of a linear regression, row by row, by other gains than that of least squares.

With phi the regressor and e = y - phi' p the innovation, the parameters change by

    gradient (LMS)                p <- p + gain phi e
    normalized-gradient (NLMS)    p <- p + gain phi e / (bias + phi' phi)
    kalman                        p <- p + K e,   K = P phi / (1 + phi' P phi),   P <- P - K phi' P + gain I

The Kalman filter takes the parameters for a random walk with the covariance `gain` times the noise variance a row: it
forgets along all directions alike, where exponential forgetting forgets along those that the rows excite (Ljung, System
Identification, 2nd ed., chapter 11; Haykin, Adaptive Filter Theory, 4th ed., chapters 5 and 6). The gradient methods
keep no covariance: standard deviations are infinite. LMS is stable for a gain below 2 / phi' phi, NLMS below 2.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.identification.information import LARGEST_VALUE

GAINS = {"kalman": 1e-4, "gradient": 0.05, "normalized-gradient": 0.5}
"""Default gain by kind of adaptation."""

BIAS = 1e-3
"""Keeps the step of NLMS finite where the regressor is near zero."""

START_COVARIANCE = 1e4


class AdaptiveRegression:
    """y = regressor . parameters + noise, learned row by row.

    Args:
        parameters: number of parameters, n.
        kind: `kalman`, `gradient` or `normalized-gradient`.
        gain: see the module; None: the default of the kind.

    Attributes:
        parameters: shape (n,); zero at the start.
        rows: number of rows learned from.

    Raises:
        InputError: an unknown kind, or a gain that is not positive (of `kalman`: negative) and finite.
    """

    def __init__(self, parameters: int, kind: str, gain: float | None = None) -> None:
        if kind not in GAINS:
            raise InputError(describe_unknown("adaptation", kind, GAINS))
        self._kind, self._gain = kind, GAINS[kind] if gain is None else gain
        if not (0.0 < self._gain < math.inf or (kind == "kalman" and self._gain == 0.0)):
            raise InputError(f"gain of {kind} must be positive and finite, got {gain}")
        self.parameters = np.zeros(parameters)
        self.rows = 0
        self._covariance = START_COVARIANCE * np.eye(parameters)
        self._squares = 0.0

    def update(self, regressor: ArrayLike, output: float) -> float:
        """Predict the output, then learn from it; returns the innovation.

        Raises:
            InputError: the parameters diverge, which a smaller gain prevents.
        """
        phi = np.asarray(regressor, dtype=np.float64)
        innovation = output - float(phi @ self.parameters)
        if self._kind == "kalman":
            seen = self._covariance @ phi
            power = 1.0 + float(phi @ seen)
            step = seen / power
            self._covariance += self._gain * np.eye(phi.size) - np.outer(seen, seen) / power
            self._squares += innovation * innovation / power
        else:
            norm = BIAS + float(phi @ phi) if self._kind == "normalized-gradient" else 1.0
            step = self._gain / norm * phi
            self._squares += innovation * innovation
        self.rows += 1
        self.parameters = self.parameters + step * innovation
        if not np.all(np.abs(self.parameters) < LARGEST_VALUE):
            raise InputError(f"{self._kind} adaptation diverges with a gain of {self._gain:g}: choose a smaller one")
        return innovation

    @property
    def unit_covariance(self) -> Array:
        """Covariance of the parameters for noise of variance 1, shape (n, n); inf for gradient methods."""
        return self._covariance if self._kind == "kalman" else np.full_like(self._covariance, math.inf)

    @property
    def condition(self) -> float:
        """NaN: the regressors are not kept."""
        return math.nan

    @property
    def noise_variance(self) -> float:
        """Variance of the noise, from all innovations."""
        return self._squares / self.rows if self.rows else math.inf
