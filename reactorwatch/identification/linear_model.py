"""A fitted linear model of one output: one-step-ahead prediction and simulation.

An ARX and an output-error model are the recursion of `structure.Structure`, ARMAX and Box-Jenkins models have a model
of the disturbance too (`linear_predictor`). An output-error model is fitted by its simulation, the others by their
one-step-ahead prediction, and these are the residuals that should be white.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.arrays import Array
from reactorwatch.identification.linear_predictor import Kind, LinearPredictor, PredictionErrors
from reactorwatch.identification.regressor import rows_of
from reactorwatch.identification.simulation import plan_run, simulate
from reactorwatch.identification.structure import Structure, as_columns


def standard_deviations(
    covariance: NDArray[np.float64], matrix: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Standard deviations of linear combinations of parameters; never NaN.

    Args:
        covariance: covariance of the parameters, shape (n, n); inf and NaN where the data do not determine them.
        matrix: the combinations, shape (m, n); None: the parameters themselves.

    Returns: Shape (m,); inf where the data do not determine a combination. Where rounding makes a variance negative,
        the size of that rounding.

    >>> standard_deviations(np.array([[4.0, np.nan], [np.nan, np.inf]]), np.array([[0.5, 0.0], [1.0, 1.0]])).tolist()
    [1.0, inf]
    """
    deviations = np.full(len(covariance) if matrix is None else len(matrix), np.inf)
    for i in range(len(deviations)):
        row = np.eye(1, len(covariance), i)[0] if matrix is None else matrix[i]
        used = np.flatnonzero(row)  # zero times infinity is not zero
        part = covariance[np.ix_(used, used)]
        if np.all(np.isfinite(part)):
            deviations[i] = np.sqrt(abs(row[used] @ part @ row[used]))
    return deviations


@dataclass(frozen=True)
class LinearModel:
    """A fitted linear model of one output, in the signals' own units.

    Attributes:
        kind: kind of the model.
        structure: terms of the plant.
        parameters: those of the plant in the order of `structure.parameter_names`, then d of a Box-Jenkins model, then
            c of it or of an ARMAX model; shape (parameters,).
        covariance: shape (parameters, parameters); inf where the data do not determine it.
        noise_sd: standard deviation of the residuals of the fit.
        condition: condition number of the scaled regressors (or gradients).
        rows: number of rows of the fit.
    """

    kind: Kind
    structure: Structure
    parameters: Array
    covariance: Array
    noise_sd: float
    condition: float
    rows: int

    @property
    def parameter_count(self) -> int:
        """Number of parameters."""
        return self.parameters.size

    @property
    def dynamics(self) -> Array:
        """Parameters of the plant, shape (parameters of the structure,)."""
        return self.parameters[: self.structure.parameters]

    @property
    def standard_deviations(self) -> Array:
        """Standard deviations of the parameters, shape (parameters,)."""
        return standard_deviations(self.covariance)

    def predict(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        """Predict each row one step ahead from the measured rows before it.

        Args:
            inputs: shape (rows,) or (rows, inputs).
            outputs: shape (rows,) or (rows, 1).
            time: shape (rows,); None: gaps are not detected.

        Returns:
            Shape (rows, 1); NaN where the rows before are incomplete.
        """
        u, y = as_columns(inputs, "inputs", self.structure.inputs), as_columns(outputs, "outputs", 1)
        predictor = LinearPredictor(self.kind, self.structure)
        if predictor.noise_lags:
            errors = PredictionErrors(predictor, u, y, plan_run(self.structure, u, y, time))
            return errors.predict(self.parameters)[0][:, None]
        rows = rows_of(self.structure, u, y, time)
        predicted = np.full(y.shape, np.nan)
        predicted[rows.position, 0] = rows.regressors @ self.parameters
        return predicted

    def simulate(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        """Simulate the plant, without its disturbance: run its recursion on its own outputs.

        It starts from the first complete consecutive rows, as many as its history has, and continues over missing
        outputs. At a missing input or a gap in time it stops and restarts. Arguments are those of `predict`.

        Returns:
            Shape (rows, 1); NaN in the rows it starts from and where it cannot run; inf after it has diverged.
        """
        u, y = as_columns(inputs, "inputs", self.structure.inputs), as_columns(outputs, "outputs", 1)
        return simulate(self.structure, self.dynamics, u, y, plan_run(self.structure, u, y, time))

    def residuals(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        """Measured minus predicted or simulated, as in the fit; shape (rows, 1)."""
        predict = self.simulate if self.kind == "oe" else self.predict
        return as_columns(outputs, "outputs", 1) - predict(inputs, outputs, time)


def fit_percent(measured: ArrayLike, predicted: ArrayLike) -> float:
    """100 (1 - |y - yhat| / |y - mean y|) over the rows that are measured and predicted.

    100 is perfect, 0 as good as the mean, and -inf a diverged simulation.

    Args:
        measured: shape (rows,), NaN where nothing was measured.
        predicted: shape (rows,), NaN where nothing was predicted.

    Returns:
        The fit; NaN if no row can be compared or the measured values are all equal.
    """
    y, yhat = np.asarray(measured, dtype=np.float64), np.asarray(predicted, dtype=np.float64)
    compared = np.isfinite(y) & ~np.isnan(yhat)
    y, yhat = y[compared], yhat[compared]
    if y.size == 0 or np.ptp(y) == 0.0:
        return float("nan")
    if not np.all(np.isfinite(yhat)):
        return float("-inf")
    return float(100.0 * (1.0 - np.linalg.norm(y - yhat) / np.linalg.norm(y - np.mean(y))))
