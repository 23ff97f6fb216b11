"""Least-squares fit of an ARX model to a training, with the largest structure that its rows allow.

If the training has too few rows for the parameters, the model gets fewer lags of the inputs, then no inputs, then fewer
lags of the output (`simpler_structures`).
"""

from collections.abc import Iterator
from math import inf, nan
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from monitor_node.config import MonitorConfig
from monitor_node.ingest.sampling import regular_intervals
from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import Check, ModelSnapshot, Parameter
from reactorwatch.errors import InputError
from reactorwatch.identification.excitation import check_record
from reactorwatch.identification.identify import WORST_MINUS_LOG10_P
from reactorwatch.identification.linear_model import standard_deviations
from reactorwatch.identification.regressor import Rows, rows_of
from reactorwatch.identification.residual_tests import ResidualTest, independence, whiteness
from reactorwatch.identification.structure import Scaling, Structure

ROWS_A_PARAMETER = 10
"""Least number of rows per parameter of the reference."""

MOSTLY = 0.5
"""Least share of the output's values that a simpler structure must predict; it is no cure for irregular rows."""


class ArxFit(NamedTuple):
    """ARX model fitted to a training, with scaled signals.

    Attributes:
        parameters: parameters, shape (parameters,).
        rows: rows of the fit.
        ranges: smallest and largest value of each input of the regressor, shape (2, inputs); None without inputs.
        residual: residual of each row of the training in the output's unit, shape (n,), scaled to the size of
            out-of-sample residuals; NaN if missing.
    """

    parameters: Array
    rows: Rows
    ranges: Array | None
    residual: Array


def arx_structure(config: MonitorConfig) -> Structure:
    """Structure of the identified models that the settings ask for."""
    return Structure.of_order(config.order, config.delay, inputs=len(config.inputs))


def simpler_structures(structure: Structure) -> Iterator[Structure]:
    """Structures with fewer parameters, the largest first.

    They have fewer lags of the inputs, then no inputs, then fewer lags of the output.

    >>> [(item.output_lags, item.inputs and item.input_lags) for item in simpler_structures(Structure.of_order(2))]
    [(2, 1), (2, 0), (1, 0)]
    """
    if structure.inputs:
        for lags in range(structure.input_lags - 1, 0, -1):
            yield replace(structure, input_lags=lags)
        yield (structure := replace(structure, inputs=0))
    for lags in range(structure.output_lags - 1, 0, -1):
        yield replace(structure, output_lags=lags)


def fewest_rows(structure: Structure) -> int:
    """Least number of consecutive rows for a reference of a structure."""
    return structure.history + ROWS_A_PARAMETER * structure.parameters


def fitting_structure(structure: Structure, time_min: Array, inputs: Array, outputs: Array) -> Structure:
    """Largest structure for which the rows of a training suffice, or the given one; arguments as for `fit_arx`."""
    if _count_rows(structure, time_min, inputs, outputs) >= ROWS_A_PARAMETER * structure.parameters:
        return structure
    least = MOSTLY * np.count_nonzero(np.isfinite(outputs))
    for simpler in simpler_structures(structure):
        rows = _count_rows(simpler, time_min, inputs, outputs)
        if rows >= max(least, ROWS_A_PARAMETER * simpler.parameters):
            return simpler
    return structure


def fit_arx(structure: Structure, scaling: Scaling, time_min: Array, inputs: Array, outputs: Array) -> ArxFit | None:
    """Fit a model to a training by least squares; None: it has too few rows.

    Args:
        structure: structure of the model.
        scaling: scaling of the signals.
        time_min: times in minutes, shape (n,).
        inputs: input values, shape (n, inputs), those of the structure first; NaN if missing.
        outputs: output values, shape (n,); NaN if missing or left out.
    """
    inputs, parameters = inputs[:, : structure.inputs], structure.parameters
    rows = rows_of(structure, scaling.inputs(inputs), scaling.outputs(outputs[:, None]))
    rows = _consecutive_rows(rows, time_min, structure.history)
    if len(rows.outputs) < ROWS_A_PARAMETER * parameters:
        return None
    y, residual = rows.outputs[:, 0], np.full(time_min.size, nan)
    theta: Array = np.asarray(np.linalg.lstsq(rows.regressors, y, rcond=1e-10)[0], dtype=np.float64)
    # With n parameters fitted to N rows, in-sample residuals are sqrt((N - n) / (N + n)) of out-of-sample ones.
    in_sample = np.sqrt((len(y) - parameters) / (len(y) + parameters))
    residual[rows.position] = scaling.output_spreads[0] * (y - rows.regressors @ theta) / in_sample
    given = rows.regressors[:, input_columns(structure)]
    ranges = np.array([given.min(axis=0), given.max(axis=0)]) if given.shape[1] else None
    return ArxFit(theta, rows, ranges, residual)


def input_columns(structure: Structure) -> slice:
    """Columns of the inputs in a regressor."""
    first = structure.output_lags
    return slice(first, first + structure.input_lags * structure.inputs)


def fit_snapshot(structure: Structure, scaling: Scaling, fit: ArxFit) -> ModelSnapshot:
    """Snapshot of a fitted model in the signals' units, without a time."""
    regressors, y = fit.rows.regressors, fit.rows.outputs[:, 0]
    covariance = _covariance(regressors, y, fit.parameters)
    singular = np.linalg.svd(regressors, compute_uv=False)
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0 else inf
    return arx_snapshot(structure, scaling, fit.parameters, covariance, condition, len(y), 1.0)


def arx_snapshot(
    structure: Structure,
    scaling: Scaling,
    scaled: Array,
    scaled_covariance: Array,
    condition: float,
    rows: int,
    forgetting: float,
) -> ModelSnapshot:
    """Snapshot of a model in the signals' units, without a time.

    Args:
        structure: structure of the model.
        scaling: scaling of the signals.
        scaled: parameters of the model of scaled signals, shape (parameters,).
        scaled_covariance: covariance of `scaled`, shape (parameters, parameters).
        condition: condition number of the regressors.
        rows: number of rows that the model has learned from.
        forgetting: forgetting factor.
    """
    matrix, shift = scaling.unscaling(structure)
    values = matrix @ scaled + shift
    deviations = standard_deviations(scaled_covariance, matrix)
    return ModelSnapshot(
        structure="arx",
        order=structure.output_lags,
        delay=structure.delay,
        parameters=[
            Parameter(name=name, value=value, sd=sd)
            for name, value, sd in zip(structure.parameter_names(), values, deviations, strict=True)
        ],
        rows=rows,
        forgetting=forgetting,
        excitation=1.0 / condition,
        condition=condition,
    )


def check_training(
    structure: Structure, time_min: Array, inputs: Array, outputs: Array, residual: Array
) -> list[Check]:
    """Check the rows of a training and the model fitted to them.

    Args:
        structure: structure of the model.
        time_min: times in minutes, shape (rows,).
        inputs: input values, shape (rows, inputs).
        outputs: output values, shape (rows,).
        residual: one-step-ahead residuals, shape (rows,); NaN if missing.
    """
    try:
        checks = [
            Check(name=check.name, result=check.result) for check in check_record(structure, inputs, outputs, time_min)
        ]
        if checks[-1].name != "variation":
            checks.append(_residual_check(whiteness(residual, fitted=structure.output_lags)))
            if structure.inputs:
                checks.append(_residual_check(independence(residual, inputs, structure.delay, time=time_min)))
    except InputError as error:  # too few rows without a gap: no fault of the plant's, but worth reporting
        checks = [Check(name="record", result=str(error))]
    return checks


def _residual_check(test: ResidualTest) -> Check:
    left_out = f"the model leaves something out: -log10 p = {test.minus_log10_p:.1f}"
    return Check(name=test.name, result="ok" if test.minus_log10_p < WORST_MINUS_LOG10_P else left_out)


def _count_rows(structure: Structure, time_min: Array, inputs: Array, outputs: Array) -> int:
    """Number of rows of a training that a model can be fitted to."""
    rows = rows_of(structure, inputs[:, : structure.inputs], outputs)
    return len(_consecutive_rows(rows, time_min, structure.history).outputs)


def _consecutive_rows(rows: Rows, time_min: Array, history: int) -> Rows:
    """Select the rows whose whole history is evenly spaced by one period, as `ArxPredictor.update` requires it."""
    number = np.arange(time_min.size)
    last_late = np.maximum.accumulate(np.where(np.append(False, regular_intervals(time_min)), 0, number))
    kept = (number - last_late)[rows.position] >= history
    return Rows(rows.regressors[kept], rows.outputs[kept], rows.position[kept])


def _covariance(regressors: Array, outputs: Array, theta: Array) -> Array:
    """Least-squares covariance of the parameters; NaN if the rows do not determine them."""
    residual = outputs - regressors @ theta
    variance = float(residual @ residual) / max(len(outputs) - theta.size, 1)
    gram = regressors.T @ regressors
    try:
        return np.asarray(variance * np.linalg.inv(gram))
    except np.linalg.LinAlgError:
        return np.full(gram.shape, nan)
