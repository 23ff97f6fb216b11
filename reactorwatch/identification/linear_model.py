"""A linear model with numbers in it: what it predicts one row ahead, and where it goes when left to run.

Both an ARX and an output-error model are the recursion of `structure.Structure`. They differ in what they were
fitted for, the next row or the whole run, and so in which residuals ought to be white: `simulates` says which.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.identification.regressor import rows_of, unbroken
from reactorwatch.identification.structure import Structure, as_columns

_AWAY = 1e100  # a free run beyond this has left for good


def standard_deviations(
    covariance: NDArray[np.float64], matrix: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Standard deviations of linear combinations of parameters; never NaN.

    Args:
        covariance: of the parameters, shape (n, n); inf and NaN where the data tell nothing.
        matrix: of the combinations, shape (m, n); None: the parameters themselves.

    Returns:
        Shape (m,); inf where a combination depends on what the data do not tell. Where rounding has left a negative
        variance, the size of that rounding.

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
        structure: its terms.
        parameters: shape (outputs, parameters), ordered as `structure.parameter_names` says.
        covariance: shape (outputs, parameters, parameters); inf where the data leave no doubt's size to estimate.
        noise_sd: shape (outputs,), standard deviation of the residuals that it was fitted by.
        condition: condition number of the scaled regressors (or gradients).
        rows: how many rows it was fitted to.
        simulates: True if it was fitted by its free run (output error), False if by the next row (ARX).
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
        """Number of parameters, of all outputs."""
        return int(self.parameters.size)

    @property
    def standard_deviations(self) -> NDArray[np.float64]:
        """Of the parameters, shape (outputs, parameters)."""
        return np.array([standard_deviations(covariance) for covariance in self.covariance])

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Of the recursion, in the z plane; outside the unit circle it runs away."""
        structure = self.structure
        outputs, size = structure.outputs, structure.output_lags * structure.outputs
        companion = np.zeros((size, size))
        companion[:outputs] = self.parameters[:, :size]
        companion[outputs:, :-outputs] = np.eye(size - outputs)
        return np.asarray(np.linalg.eigvals(companion), dtype=np.complex128)

    def one_step(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> NDArray[np.float64]:
        """Each row from the measured rows before it.

        Args:
            inputs: shape (rows,) or (rows, inputs).
            outputs: shape (rows,) or (rows, outputs).
            time: shape (rows,); without it no gap is looked for.

        Returns:
            Shape (rows, outputs); NaN where the rows before are not complete.
        """
        rows = rows_of(self.structure, inputs, outputs, time)
        predicted = np.full(as_columns(outputs, "outputs").shape, np.nan)
        predicted[rows.position] = rows.regressors @ self.parameters.T
        return predicted

    def free_run(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> NDArray[np.float64]:
        """The recursion on its own outputs, driven by the measured inputs.

        It starts from the first rows that are complete and follow each other, as many as it reaches back, and goes
        on over missing outputs. Where an input is missing, or time has a gap, it stops and starts anew.

        Args:
            inputs: as in `one_step`.
            outputs: as in `one_step`.
            time: as in `one_step`.

        Returns:
            Shape (rows, outputs); NaN in the rows it starts from and where it cannot run; inf once it has run away.
        """
        structure = self.structure
        u = as_columns(inputs, "inputs", structure.inputs)
        y = as_columns(outputs, "outputs", structure.outputs)
        return free_run(structure, self.parameters, u, y, plan_run(structure, u, y, time))

    def residuals(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> NDArray[np.float64]:
        """Measured minus predicted, by the prediction that the model was fitted for; shape (rows, outputs)."""
        predict = self.free_run if self.simulates else self.one_step
        return as_columns(outputs, "outputs") - predict(inputs, outputs, time)


def fit_percent(measured: ArrayLike, predicted: ArrayLike) -> float:
    """100 (1 - |y - yhat| / |y - mean y|) over the rows that are measured and predicted.

    100 is perfect, 0 as good as the mean, and -inf a run that has left for good.

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


@dataclass(frozen=True)
class RunPlan:
    """Which rows of a record a free run covers.

    Attributes:
        starts: shape (rows,), whether the run starts anew at a row, from the measured rows before it.
        running: shape (rows,), whether it covers the row.
    """

    starts: NDArray[np.bool_]
    running: NDArray[np.bool_]


def plan_run(
    structure: Structure,
    inputs: NDArray[np.float64],
    outputs: NDArray[np.float64],
    time: ArrayLike | None = None,
) -> RunPlan:
    """Where a free run of a record can start and how far it goes.

    Args:
        structure: of the model.
        inputs: shape (rows, inputs), NaN where nothing was measured.
        outputs: shape (rows, outputs), likewise.
        time: shape (rows,); without it no gap is looked for.
    """
    starts, running = _plan(
        structure.history,
        unbroken(inputs, time),
        unbroken(np.concatenate([inputs, outputs], axis=1), time),
        unbroken(np.zeros((len(inputs), 1)), time) == 1,
    )
    return RunPlan(starts, running)


def free_run(
    structure: Structure,
    parameters: NDArray[np.float64],
    inputs: NDArray[np.float64],
    outputs: NDArray[np.float64],
    plan: RunPlan,
) -> NDArray[np.float64]:
    """`LinearModel.free_run` for parameters and signals of any scale.

    Args:
        structure: of the model.
        parameters: shape (outputs, parameters).
        inputs: shape (rows, inputs).
        outputs: shape (rows, outputs).
        plan: of this record and structure.
    """
    return _run(
        np.ascontiguousarray(parameters),
        structure.output_lags,
        structure.input_lags,
        structure.delay,
        structure.offset,
        np.ascontiguousarray(inputs),
        np.ascontiguousarray(outputs),
        plan.starts,
        plan.running,
    )


@jit
def _plan(
    reach: int, driven: NDArray[np.int64], complete: NDArray[np.int64], after_gap: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """`driven` and `complete` count the rows without a break up to each row, with inputs and with all values."""
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
    output_lags: int,
    input_lags: int,
    delay: int,
    offset: bool,
    u: NDArray[np.float64],
    y: NDArray[np.float64],
    starts: NDArray[np.bool_],
    running: NDArray[np.bool_],
) -> NDArray[np.float64]:
    rows, outputs = y.shape
    inputs = u.shape[1]
    run = np.full((rows, outputs), np.nan)
    own = np.empty((rows, outputs))
    for k in range(rows):
        if not running[k]:
            continue
        if starts[k]:
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
            # Once away it stays away: NaN would look like a row without a prediction.
            own[k, o] = min(max(total, -_AWAY), _AWAY) if total == total else _AWAY
            run[k, o] = own[k, o] if abs(own[k, o]) < _AWAY else np.inf
    return run
