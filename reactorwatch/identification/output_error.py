"""Output-error models from a record: the recursion with the smallest simulation error.

With measurement noise on the output, an ARX model is biased: it treats the noise as a disturbance of the plant. The
output-error model minimises its simulation error,

    yhat[k] = a1 yhat[k-1] + ... + b1 u[k-d] + ... + c,      sum (y[k] - yhat[k])^2 -> min,

which is unbiased for any noise that is independent of the input (Ljung, System Identification, 2nd ed., sections 4.2
and 8.4). The run and its gradient are those of `linear_predictor`, the search is that of `descent`, with
all poles inside the unit circle.

The sum has local minima (Ljung, section 10.5: none for white inputs, but these inputs are steps). So there are
several starts: the ARX model, the instrumental variable estimate, the Steiglitz-McBride iterate (IEEE Trans. AC 10
(1965) 461), and the best model of one order less with a pole at zero, so that a higher order never fits worse.

A run starts from measured rows; what their noise does dies out as the model's own poles do. The parameters' covariance
is s2 (G'G)^-1, which supposes white residuals: where the whiteness test fails it is too small.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.identification.batch import least_squares, unscale
from reactorwatch.identification.descent import ITERATIONS, best_descent, solution_at
from reactorwatch.identification.instrumental_variable import instrumental_variable, stabilize, stable_arx
from reactorwatch.identification.linear_model import LinearModel
from reactorwatch.identification.linear_predictor import LinearPredictor, PredictionErrors
from reactorwatch.identification.regressor import rows_of
from reactorwatch.identification.scaled_record import ScaledRecord
from reactorwatch.identification.structure import ALL_ROWS, RowChoice, Structure

_FILTERINGS = 10


def fit_oe(
    structure: Structure,
    inputs: ArrayLike,
    outputs: ArrayLike,
    time: ArrayLike | None = None,
    choice: RowChoice = ALL_ROWS,
) -> LinearModel:
    """Fit an output-error model of one output.

    Args:
        structure: terms of the model.
        inputs: shape (rows,) or (rows, inputs), NaN where nothing was measured.
        outputs: shape (rows,) or (rows, 1), NaN where nothing was measured.
        time: shape (rows,), increasing, in any unit; None: gaps are not detected.
        choice: rows that the simulation is compared with.

    Raises:
        InputError: too few rows, an output that is constant, or rows that don't determine the parameters.
    """
    record = ScaledRecord.of(structure, inputs, outputs, time)
    theta, objective = minimise_simulation_error(record, choice)
    return unscale("oe", structure, record.scaling, solution_at(objective, theta))


def minimise_simulation_error(
    record: ScaledRecord, choice: RowChoice = ALL_ROWS, iterations: int = ITERATIONS
) -> tuple[Array, PredictionErrors]:
    """Find the parameters with the smallest simulation error of a record of one output, shape (parameters,).

    Returns:
        The parameters, and the errors as a function of them.
    """
    structure, count = record.structure, len(record.y)
    record.enough_rows(choice)
    number = np.arange(count)
    chosen = (number >= choice.skip) & ((number - choice.skip) % choice.every == 0)
    objective = PredictionErrors(LinearPredictor("oe", structure), record.u, record.y, record.plan, chosen)
    if objective.compared.sum() < structure.parameters:
        raise UnfitRecordError(
            f"{structure.parameters} parameters need at least {structure.parameters} rows of a simulation, "
            f"got {int(objective.compared.sum())} of {count}"
        )
    arx = stable_arx(record)
    starts = [arx, instrumental_variable(record), _steiglitz_mcbride(record, arx)]
    if structure.output_lags > 1 and structure.input_lags > 1:
        lags = structure.output_lags - 1, structure.input_lags - 1
        lower = Structure(*lags, structure.delay, structure.inputs, offset=structure.offset)
        smaller, _ = minimise_simulation_error(replace(record, structure=lower), choice, iterations)
        starts.append(pad_order(lower, smaller))
    return best_descent(objective, starts, iterations), objective


def pad_order(structure: Structure, parameters: Array) -> Array:
    """Parameters of the same model with one lag more of output and inputs, which adds a pole at zero.

    Args:
        structure: structure of the model.
        parameters: shape (parameters,).
    """
    lags = structure.output_lags
    middle = lags + structure.input_lags * structure.inputs
    zeros = np.zeros(structure.inputs)
    return np.concatenate([parameters[:lags], [0.0], parameters[lags:middle], zeros, parameters[middle:]])


def _steiglitz_mcbride(record: ScaledRecord, theta: Array) -> Array:
    """Steiglitz-McBride iteration: ARX of signals filtered by 1 / (1 - a1 q^-1 - ...) of the model before."""
    structure, lags = record.structure, record.structure.output_lags
    for _ in range(_FILTERINGS):
        signals = np.concatenate([record.u, record.y, np.ones_like(record.y)], axis=1)
        filtered = _filter(np.ascontiguousarray(theta[:lags]), signals)
        rows = rows_of(structure, filtered[:, :-2], filtered[:, -2], record.time)
        regressors = rows.regressors.copy()
        if structure.offset:
            regressors[:, -1] = filtered[rows.position, -1]
        try:
            solution = least_squares(regressors, rows.outputs)
        except InputError:  # the filtered signals do not determine the parameters: take the last iterate
            break
        theta = stabilize(structure, solution.parameters)
    return theta


@jit
def _filter(a: NDArray[np.float64], signals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Filter each column by 1 / (1 - a1 q^-1 - ...), from rest after a missing value."""
    filtered = np.empty_like(signals)
    for i in range(signals.shape[1]):
        for k in range(signals.shape[0]):
            total = signals[k, i]
            for lag in range(min(a.size, k)):
                before = filtered[k - 1 - lag, i]
                if before != before:
                    break
                total += a[lag] * before
            filtered[k, i] = total
    return filtered
