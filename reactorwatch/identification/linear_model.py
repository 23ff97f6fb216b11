"""A fitted linear model: one-step-ahead prediction and simulation.

Both an ARX and an output-error model are the recursion of `structure.Structure`. An ARX model is fitted by its
one-step-ahead prediction, an output-error model by its simulation, and these are the residuals that should be white:
`simulates` tells them apart.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.identification.regressor import consecutive_rows, rows_of
from reactorwatch.identification.structure import Structure, as_columns

_DIVERGED = 1e100  # a simulation beyond this has diverged


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
    """A fitted linear model, in the signals' own units.

    Attributes:
        structure: terms of the model.
        parameters: shape (outputs, parameters), in the order of `structure.parameter_names`.
        covariance: shape (outputs, parameters, parameters); inf where the data do not determine it.
        noise_sd: standard deviation of the residuals of the fit, shape (outputs,).
        condition: condition number of the scaled regressors (or gradients).
        rows: number of rows of the fit.
        simulates: True if it was fitted by simulation (output error), False if by one-step-ahead prediction (ARX).
    """

    structure: Structure
    parameters: NDArray[np.float64]
    covariance: NDArray[np.float64]
    noise_sd: NDArray[np.float64]
    condition: float
    rows: int
    simulates: bool

    @property
    def parameter_count(self) -> int:
        """Number of parameters of all outputs."""
        return int(self.parameters.size)

    @property
    def dynamics(self) -> NDArray[np.float64]:
        """Parameters of the recursion, shape (outputs, parameters)."""
        return self.parameters

    @property
    def standard_deviations(self) -> NDArray[np.float64]:
        """Standard deviations of the parameters, shape (outputs, parameters)."""
        return np.array([standard_deviations(covariance) for covariance in self.covariance])

    def predict(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> NDArray[np.float64]:
        """Predict each row one step ahead from the measured rows before it.

        Args:
            inputs: shape (rows,) or (rows, inputs).
            outputs: shape (rows,) or (rows, outputs).
            time: shape (rows,); None: gaps are not detected.

        Returns:
            Shape (rows, outputs); NaN where the rows before are incomplete.
        """
        rows = rows_of(self.structure, inputs, outputs, time)
        predicted = np.full(as_columns(outputs, "outputs").shape, np.nan)
        predicted[rows.position] = rows.regressors @ self.parameters.T
        return predicted

    def simulate(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> NDArray[np.float64]:
        """Simulate: run the recursion on its own outputs, driven by the measured inputs.

        It starts from the first complete consecutive rows, as many as its history has, and continues over missing
        outputs. At a missing input or a gap in time it stops and restarts.

        Args:
            inputs: see `predict`.
            outputs: see `predict`.
            time: see `predict`.

        Returns:
            Shape (rows, outputs); NaN in the rows it starts from and where it cannot run; inf after it has diverged.
        """
        structure = self.structure
        u = as_columns(inputs, "inputs", structure.inputs)
        y = as_columns(outputs, "outputs", structure.outputs)
        return simulate(structure, self.parameters, u, y, plan_run(structure, u, y, time))

    def residuals(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> NDArray[np.float64]:
        """Measured minus predicted or simulated, as in the fit; shape (rows, outputs)."""
        predict = self.simulate if self.simulates else self.predict
        return as_columns(outputs, "outputs") - predict(inputs, outputs, time)


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


class RunPlan(NamedTuple):
    """Rows of a record that a simulation covers.

    Attributes:
        starts: rows at which the simulation restarts from the measured rows before, shape (rows,).
        running: rows that it covers, shape (rows,).
    """

    starts: NDArray[np.bool_]
    running: NDArray[np.bool_]


def plan_run(
    structure: Structure,
    inputs: NDArray[np.float64],
    outputs: NDArray[np.float64],
    time: ArrayLike | None = None,
) -> RunPlan:
    """Plan the simulation of a record.

    Args:
        structure: structure of the model.
        inputs: shape (rows, inputs), NaN where nothing was measured.
        outputs: shape (rows, outputs), NaN where nothing was measured.
        time: shape (rows,); None: gaps are not detected.
    """
    return RunPlan(
        *_plan(
            structure.history,
            consecutive_rows(inputs, time),
            consecutive_rows(np.concatenate([inputs, outputs], axis=1), time),
            consecutive_rows(np.zeros((len(inputs), 1)), time) == 1,
        )
    )


def simulate(
    structure: Structure,
    parameters: NDArray[np.float64],
    inputs: NDArray[np.float64],
    outputs: NDArray[np.float64],
    plan: RunPlan,
) -> NDArray[np.float64]:
    """`LinearModel.simulate` for parameters and signals of any scale.

    Args:
        structure: structure of the model.
        parameters: shape (outputs, parameters).
        inputs: shape (rows, inputs).
        outputs: shape (rows, outputs).
        plan: plan for this record and structure.
    """
    theta, u, y = (np.ascontiguousarray(item) for item in (parameters, inputs, outputs))
    return _run(theta, structure.orders, structure.offset, u, y, plan)


@jit
def _plan(
    reach: int, driven: NDArray[np.int64], complete: NDArray[np.int64], after_gap: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Plan from the counts of consecutive rows with inputs (`driven`) and with all values (`complete`)."""
    rows = driven.size
    starts, running = np.zeros(rows, np.bool_), np.zeros(rows, np.bool_)
    for k in range(1, rows):
        # Row k needs the inputs of the rows before it, not its own.
        if after_gap[k] or driven[k - 1] < reach:
            continue
        starts[k] = not running[k - 1] and complete[k - 1] >= reach
        running[k] = running[k - 1] or starts[k]
    return starts, running


@jit
def _run(
    parameters: NDArray[np.float64],
    orders: tuple[int, int, int],
    offset: bool,
    u: NDArray[np.float64],
    y: NDArray[np.float64],
    plan: RunPlan,
) -> NDArray[np.float64]:
    output_lags, input_lags, delay = orders
    rows, outputs = y.shape
    inputs = u.shape[1]
    run = np.full((rows, outputs), np.nan)
    own = np.empty((rows, outputs))
    for k in range(rows):
        if not plan.running[k]:
            continue
        if plan.starts[k]:
            for back in range(1, output_lags + 1):
                for o in range(outputs):  # a slice would take two seconds to compile
                    own[k - back, o] = y[k - back, o]
        for o in range(outputs):
            total = parameters[o, parameters.shape[1] - 1] if offset else 0.0
            for lag in range(output_lags):
                for i in range(outputs):
                    total += parameters[o, lag * outputs + i] * own[k - 1 - lag, i]
            for lag in range(input_lags):
                for i in range(inputs):
                    total += parameters[o, output_lags * outputs + lag * inputs + i] * u[k - delay - lag, i]
            # A diverged simulation stays so: NaN would look like a row without a prediction.
            own[k, o] = min(max(total, -_DIVERGED), _DIVERGED) if total == total else _DIVERGED
            run[k, o] = own[k, o] if abs(own[k, o]) < _DIVERGED else np.inf
    return run
