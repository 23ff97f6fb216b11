"""ARMAX and Box-Jenkins models from a record: a plant and a model of its disturbance, fitted by one-step prediction.

The models are those of `linear_predictor`: Box-Jenkins, and ARMAX,

    y[k] = a1 y[k-1] + ... + b1 u[k-d] + ... + offset + e[k] + c1 e[k-1] + ...

The parameters minimise the sum of the squared prediction errors e; for normal e this is maximum likelihood (Ljung,
System Identification, 2nd ed., section 7.4). The descent is that of `descent`, with all poles and the zeros of the
disturbance inside the unit circle. To keep the zeros there loses nothing: the mirror image of a zero gives the same
spectrum.

The sum has local minima, so there are several starts: least squares, the output-error model, the disturbance by two
regressions as of Hannan and Rissanen (Biometrika 69 (1982) 81), and a model of one order less.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.identification.batch import unscale
from reactorwatch.identification.descent import ITERATIONS, best_descent, solution_at
from reactorwatch.identification.instrumental_variable import mirror_poles, stabilize, stable_arx
from reactorwatch.identification.linear_model import LinearModel
from reactorwatch.identification.linear_predictor import Kind, LinearPredictor, PredictionErrors
from reactorwatch.identification.output_error import minimise_simulation_error, pad_order
from reactorwatch.identification.regressor import rows_of
from reactorwatch.identification.scaled_record import ScaledRecord
from reactorwatch.identification.structure import Structure

LONG_ORDERS = 3
"""Order of the regression from which the innovations are estimated first, in orders of the model."""

ROUGH_ITERATIONS = 20
"""Largest number of iterations of a descent that only leads to a start."""


def fit_armax(
    structure: Structure,
    inputs: ArrayLike,
    outputs: ArrayLike,
    time: ArrayLike | None = None,
) -> LinearModel:
    """Fit an ARMAX model of one output; without inputs it is an ARMA model.

    Args:
        structure: lags of output and inputs; one output, with an offset. The disturbance has as many lags as the
            output.
        inputs: shape (rows,) or (rows, inputs), NaN where nothing was measured.
        outputs: shape (rows,) or (rows, 1), NaN where nothing was measured.
        time: shape (rows,), increasing, in any unit; None: gaps are not detected.

    Raises:
        InputError: too few rows, an output that is constant, or rows that don't determine the parameters.
    """
    return _fit("armax", ScaledRecord.of(structure, inputs, outputs, time))


def fit_box_jenkins(
    structure: Structure,
    inputs: ArrayLike,
    outputs: ArrayLike,
    time: ArrayLike | None = None,
) -> LinearModel:
    """Fit a Box-Jenkins model of one output; arguments and errors as for `fit_armax`, and at least one input."""
    if structure.inputs == 0:
        raise InputError("a Box-Jenkins model needs an input, got none; without inputs it is an ARMAX model: use armax")
    return _fit("bj", ScaledRecord.of(structure, inputs, outputs, time))


def _fit(kind: Kind, record: ScaledRecord) -> LinearModel:
    record.enough_rows()
    theta, objective = _minimise(kind, record)
    return unscale(kind, record.structure, record.scaling, solution_at(objective, theta))


def _objective(kind: Kind, record: ScaledRecord) -> PredictionErrors:
    return PredictionErrors(LinearPredictor(kind, record.structure), record.u, record.y, record.plan)


def _minimise(kind: Kind, record: ScaledRecord) -> tuple[Array, PredictionErrors]:
    """Best parameters, shape (parameters,), and the errors as a function of them."""
    structure, lags, objective = record.structure, record.structure.output_lags, _objective(kind, record)
    needed, usable = LinearPredictor(kind, structure).size, int(objective.compared.sum())
    if usable < needed:
        raise UnfitRecordError(
            f"{needed} parameters need at least {needed} rows of a prediction, got {usable} of {len(record.y)}"
        )
    starts = _armax_starts(record)
    if structure.inputs:
        rough = ITERATIONS if kind == "bj" else ROUGH_ITERATIONS
        plant, simulation = minimise_simulation_error(record, iterations=rough)
        starts.append(np.concatenate([plant, -plant[:lags]]))
    if kind == "bj":
        best = best_descent(_objective("armax", record), starts, ROUGH_ITERATIONS)
        v = np.full(record.y.shape, np.nan)
        v[simulation.compared, 0] = simulation(plant)[0]
        alone = replace(record, structure=Structure(lags, lags, inputs=0), u=np.empty((len(v), 0)), y=v)
        noise, _ = _minimise("armax", alone)
        starts = [
            np.concatenate([plant, np.zeros(2 * lags)]),
            np.concatenate([plant, noise[:lags], noise[-lags:]]),
            np.concatenate([best[: structure.parameters], best[:lags], best[-lags:]]),
        ]
    return best_descent(objective, starts), objective


def _armax_starts(record: ScaledRecord) -> list[Array]:
    """Least squares, the regressions of Hannan and Rissanen, and the best of them with one order less."""
    structure, lags, rows = record.structure, record.structure.output_lags, record.rows()
    starts = [np.concatenate([stable_arx(record), np.zeros(lags)])]
    past = rows_of(Structure(lags, lags), _innovations(record), record.y, record.time)
    both, of_plant, of_noise = np.intersect1d(rows.position, past.position, return_indices=True)
    if both.size > structure.parameters + lags:
        wide = np.concatenate([rows.regressors[of_plant], past.regressors[of_noise][:, lags : 2 * lags]], axis=1)
        theta = np.linalg.lstsq(wide, rows.outputs[of_plant, 0])[0]
        plant = stabilize(structure, theta[: structure.parameters])
        starts.append(np.concatenate([plant, -mirror_poles(-theta[structure.parameters :])]))
    if lags > 1:
        lower = Structure.of_order(lags - 1, structure.delay, structure.inputs)
        smaller = replace(record, structure=lower)
        best = best_descent(_objective("armax", smaller), _armax_starts(smaller), ROUGH_ITERATIONS)
        noise = best[lower.parameters :]
        starts.append(np.concatenate([pad_order(lower, best[: lower.parameters]), noise, [0.0]]))
    return starts


def _innovations(record: ScaledRecord) -> Array:
    """Residuals of an ARX model of a high order, shape (rows, 1); NaN where it has none."""
    structure = record.structure
    order = min(LONG_ORDERS * structure.output_lags + 4, len(record.y) // (4 * (structure.inputs + 1)))
    long = Structure(max(order, 1), max(order, 1), structure.delay, structure.inputs)
    rows = replace(record, structure=long).rows()
    e = np.full(record.y.shape, np.nan)
    theta = np.linalg.lstsq(rows.regressors, rows.outputs)[0]
    e[rows.position] = rows.outputs - rows.regressors @ theta
    return e
