"""Fit of the identified models of a plant to its training, by least squares, and snapshots of them.

If the training has too few rows for the parameters, the models get a simpler structure (`arx.simpler_structures`), and
the adaptive model is updated with the rows of the training again.
"""

from collections.abc import Sequence
from math import nan

import numpy as np
from msgspec.structs import replace

from monitor_node.ingest.alignment import regular_intervals
from monitor_node.learn.arx import ArxMemory, ArxPredictor, ArxReference, judging_structures, simpler_structures
from monitor_node.learn.training_rows import RowArrays
from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import Check, ModelSnapshot, Parameter
from reactorwatch.errors import InputError
from reactorwatch.identification.checks import ResidualTest, check_record, independence, whiteness
from reactorwatch.identification.data import Dataset, Rows, rows_of
from reactorwatch.identification.dead_time import better_structure
from reactorwatch.identification.identify import WORST_MINUS_LOG10_P
from reactorwatch.identification.linear import fit_linear
from reactorwatch.identification.linear_model import standard_deviations
from reactorwatch.identification.structure import Structure
from reactorwatch.spc.charts.parameters import learn
from reactorwatch.spc.extrapolation import BLOCKS, FittedExtrapolation

ROWS_A_PARAMETER = 10
"""Least number of rows per parameter of a fitted model."""


def fewest_rows(structure: Structure) -> int:
    """Least number of consecutive rows for a fitted model of a structure."""
    return structure.history + ROWS_A_PARAMETER * structure.parameters


def learn_again(models: ArxReference, rows: RowArrays) -> None:
    """Replace the models by new adaptive ones, updated with the rows of a training."""
    for index in range(len(models.predictors)):
        _learn_again(models, index, models.predictors[index].structure, rows)


def _learn_again(models: ArxReference, index: int, structure: Structure, rows: RowArrays) -> ArxPredictor:
    """Replace the model of an output by a new adaptive one, updated with the rows of a training; returns it."""
    model = models.predictors[index] = ArxPredictor.of(structure, models.config.forgetting)
    follows = [False, *regular_intervals(rows.time_min).tolist()]
    for inputs, value, is_next in zip(rows.inputs.tolist(), rows.outputs[:, index].tolist(), follows, strict=True):
        model.update(inputs, value, follows=is_next)
    return model


def fit_models(models: ArxReference, rows: RowArrays, *, to_judge: bool = False) -> Array:
    """Fit each model to a training, with the largest structure that its rows allow.

    Args:
        models: the models.
        rows: rows of the training.
        to_judge: True to choose the orders, for models that judge.

    Returns:
        Residuals, shape (n, outputs), scaled to the size of out-of-sample residuals; of models that judge each is that
        of a fit to the other blocks of the training. NaN if missing. With too few rows for any structure there is no
        fitted model of the output, and all are NaN.
    """
    return np.column_stack([_fit_model(models, index, rows, to_judge) for index in range(len(models.predictors))])


def _fit_model(models: ArxReference, index: int, rows: RowArrays, to_judge: bool) -> Array:
    """Fit the model of an output; returns its residuals, shape (n,)."""
    model, outputs, residual = models.predictors[index], rows.outputs[:, index], np.full(rows.time_min.size, nan)
    if to_judge:  # the dead times were found before
        delay = model.structure.delay if model.structure.inputs else models.structure.delay
        structures = [replace(item, delay=delay) for item in judging_structures(models.config)]
        structure = _best_structure(structures, rows, outputs)
        structure = structure or _fitting_structure(replace(models.structure, delay=delay), rows, outputs)
    else:
        structure = _fitting_structure(_with_dead_times(models, model.structure, rows, outputs), rows, outputs)
    if structure is not None and structure != model.structure:
        model = _learn_again(models, index, structure, rows)
    scaling = model.scaling
    if structure is None or scaling is None:
        return residual
    inputs = rows.inputs[:, : structure.inputs]
    scaled = _consecutive_rows(structure, rows.time_min, scaling.inputs(inputs), scaling.outputs(outputs[:, None]))
    regressors, y = scaled.regressors, scaled.outputs[:, 0]
    theta: Array = np.asarray(np.linalg.lstsq(regressors, y, rcond=1e-10)[0], dtype=np.float64)
    model.reference, model.fitted_rows = theta, scaled
    given = regressors[:, model.input_columns]
    model.ranges = np.array([given.min(axis=0), given.max(axis=0)]) if given.shape[1] else None
    if to_judge:
        held_out, leverage = held_out_residuals(regressors, y)
        model.leverage_gain = fit_leverage_gain(held_out, leverage)
        sd = np.sqrt(1.0 + model.leverage_gain * leverage)
        model.largest_sd = 1.3 * float(sd.max())  # as of a black box
        residual[scaled.position] = scaling.output_spreads[0] * held_out / sd
    else:
        # With n parameters fitted to N rows, in-sample residuals are sqrt((N - n) / (N + n)) of out-of-sample ones.
        in_sample = np.sqrt((len(y) - theta.size) / (len(y) + theta.size))
        residual[scaled.position] = scaling.output_spreads[0] * (y - regressors @ theta) / in_sample
    if models.points:
        covariance = _covariance(scaled, theta)
        snapshot = _snapshot(model, theta, covariance, float(np.linalg.cond(regressors)), len(y), 1.0)
        snapshot.checks.extend(_check_fit(structure, rows._replace(inputs=inputs, outputs=outputs), residual))
        model.reference_model = snapshot.SerializeToString()
    return residual


def _with_dead_times(models: ArxReference, structure: Structure, rows: RowArrays, outputs: Array) -> Structure:
    """A structure with the dead times that its residuals show, where the settings state none and residuals count."""
    if models.config.delay is not None or models.config.has_values_only or not structure.inputs:
        return structure
    data = Dataset(rows.time_min, rows.inputs, outputs[:, None], models.config.inputs, "output")
    try:
        residuals = fit_linear("arx", structure, *data.arrays).residuals(*data.arrays)[:, 0]
        shown = independence(residuals, data.inputs, structure.delay, time=data.time).minus_log10_p
    except InputError:  # too few rows, or they do not determine the model
        return structure
    return (better_structure(structure, data) if shown >= WORST_MINUS_LOG10_P else None) or structure


def _best_structure(structures: Sequence[Structure], rows: RowArrays, outputs: Array) -> Structure | None:
    """Structure with the least error on held-out blocks, of those for which the rows suffice; None: of none."""
    if len(structures) == 1:
        return None
    fitting, errors = [], []
    for structure in structures:
        found = _consecutive_rows(structure, rows.time_min, rows.inputs, outputs[:, None])
        if len(found.outputs) < ROWS_A_PARAMETER * structure.parameters:
            continue
        sizes = np.maximum(found.regressors.std(axis=0), 1e-12)
        scaled = (found.regressors - found.regressors.mean(axis=0)) / sizes
        scaled[:, -1] = 1.0
        error = np.full(rows.time_min.size, nan)
        error[found.position] = held_out_residuals(scaled, found.outputs[:, 0] - found.outputs.mean())[0]
        fitting.append(structure)
        errors.append(error**2)
    if not fitting:
        return None
    columns = np.column_stack(errors)
    return fitting[int(np.argmin(columns[np.isfinite(columns).all(axis=1)].mean(axis=0)))]


def held_out_residuals(regressors: Array, y: Array) -> tuple[Array, Array]:
    """Residuals of each of `BLOCKS` blocks by the least-squares fit to the others, and the leverages of its rows.

    With the hat matrix H of the fit to all, the residuals of a block are (I - H_bb)^-1 times those of that fit, and
    their variances by the error of the other fit, in units of the noise's, the diagonal of (I - H_bb)^-1 - I (Cook &
    Weisberg 1982, Residuals and Influence in Regression, ch. 3). A ridge of rounding's size keeps a direction that one
    block alone excites solvable: the others know nothing of it.

    Args:
        regressors: shape (n, parameters).
        y: shape (n,).
    """
    u, sizes, _ = np.linalg.svd(regressors, full_matrices=False)
    basis = u * (sizes / np.hypot(sizes, 1e-5 * sizes[0]))
    residual, leverage = y - basis @ (basis.T @ y), np.empty(len(y))
    for block in np.array_split(np.arange(len(y)), BLOCKS):
        part = basis[block]
        passed = np.linalg.solve(np.eye(len(sizes)) - part.T @ part, part.T)
        leverage[block] = np.einsum("ij,ji->i", part, passed)
        residual[block] += part @ (passed @ residual[block])
    return residual, leverage


def fit_leverage_gain(residual: Array, leverage: Array) -> float:
    """Growth of the variance of residuals with their leverage, by the likelihood of normal ones, from 1 to 64.

    It is 1 for a linear plant; where the plant is not, errors of the model grow with the distance from its rows, too.
    """
    gains = 2.0 ** np.arange(7)
    variances = 1.0 + gains[:, None] * leverage
    squares = np.mean(residual**2 / variances, axis=1)
    badness = np.log(variances).mean(axis=1) + np.log(np.maximum(squares, 1e-300))  # 0 for a constant output
    return float(gains[np.argmin(badness)])


def _fitting_structure(structure: Structure, rows: RowArrays, outputs: Array) -> Structure | None:
    """Largest structure for which the rows of a training suffice; None: there are too few for any."""
    least = 0.0
    for item in (structure, *simpler_structures(structure)):
        count = len(_consecutive_rows(item, rows.time_min, rows.inputs[:, : item.inputs], outputs).outputs)
        if count >= max(least, ROWS_A_PARAMETER * item.parameters):
            return item
        # a simpler structure is no cure for irregular rows
        least = 0.5 * np.count_nonzero(np.isfinite(outputs))
    return None


def _consecutive_rows(structure: Structure, time_min: Array, inputs: Array, outputs: Array) -> Rows:
    """Rows whose whole history is evenly spaced by one period, as `ArxPredictor.update` requires it."""
    rows, number = rows_of(structure, inputs, outputs), np.arange(time_min.size)
    last_late = np.maximum.accumulate(np.where(np.append(False, regular_intervals(time_min)), 0, number))
    kept = (number - last_late)[rows.position] >= structure.history
    return Rows(rows.regressors[kept], rows.outputs[kept], rows.position[kept])


def _covariance(rows: Rows, theta: Array) -> Array:
    """Least-squares covariance of the parameters; NaN if the rows do not determine them."""
    residual = rows.outputs[:, 0] - rows.regressors @ theta
    variance = float(residual @ residual) / max(len(residual) - theta.size, 1)
    gram = rows.regressors.T @ rows.regressors
    try:
        return np.asarray(variance * np.linalg.inv(gram))
    except np.linalg.LinAlgError:
        return np.full(gram.shape, nan)


def _check_fit(structure: Structure, rows: RowArrays, residual: Array) -> list[Check]:
    """Checks of the rows of a training, with one output, and of the model fitted to them."""
    time_min, inputs, outputs = rows
    try:
        found = check_record(structure, inputs, outputs, time_min)
        checks = [Check(name=item.name, result=item.result) for item in found]
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


def start_judging(models: ArxReference, rows: RowArrays, fitted: FittedExtrapolation | None = None) -> None:
    """Judge the rows after a training by the models; each input must have values.

    Args:
        models: the models.
        rows: rows of the training.
        fitted: variance of the residuals by the distance of the inputs; None: it does not grow.
    """
    time_min, inputs, outputs = rows
    low, high = np.nanmin(inputs, axis=0), np.nanmax(inputs, axis=0)
    margin = 0.1 * (high - low)
    if inputs.shape[1] > 1:  # an input that did not move has no coefficient
        values = np.count_nonzero(np.isfinite(inputs), axis=0)
        # Several inputs are often those of controllers, which leave their range with a fault. So rows are judged as far
        # as models are determined: to a variance of 0.2 of the residual's due to the coefficient of an input.
        reach = np.where(high > low, np.nanstd(inputs, axis=0) * np.sqrt(0.2 * values), np.inf)
        margin = np.maximum(margin, reach - 0.5 * (high - low))
    memory = ArxMemory((low - margin).tolist(), (high + margin).tolist())
    if models.config.has_values_only:
        history, late = models.history, np.flatnonzero(~regular_intervals(time_min))
        newest = np.column_stack([inputs, outputs])[(late[-1] + 1 if late.size else 0) :][: -history - 1 : -1]
        memory.past = np.full((history, newest.shape[1]), nan)
        memory.past[: len(newest)] = newest
    else:
        for predictor in models.predictors:
            predictor.start_judging()
        if fitted is not None:
            memory.extrapolation, memory.averages = fitted.extrapolation, fitted.averages
    models.judge_by(memory)


def start_drift_chart(model: ArxPredictor, arl0: float) -> None:
    """Start the chart of the difference between the parameters of the adaptive model and the fitted one.

    Raises:
        InputError: the training was too short for that, or the model does not forget.
    """
    rows, model.fitted_rows = model.fitted_rows, None
    if rows is None or model.reference is None:
        raise InputError("there is no reference to compare with")
    names, lags = model.structure.parameter_names(), model.structure.output_lags
    residual = rows.outputs[:, 0] - rows.regressors @ model.reference
    model.drift_chart = learn(rows.regressors, residual, model.rls.forgetting, len(residual), arl0, names, lags)


def adaptive_snapshot(model: ArxPredictor) -> ModelSnapshot | None:
    """Snapshot of the adaptive model, without a time; None before its first update."""
    rls = model.rls
    if not rls.rows:
        return None
    covariance = model.weight * rls.parameter_covariance
    return _snapshot(model, rls.parameters, covariance, rls.condition, rls.rows, rls.forgetting)


def _snapshot(
    model: ArxPredictor, parameters: Array, covariance: Array, condition: float, rows: int, forgetting: float
) -> ModelSnapshot:
    """Snapshot in the signals' units, without a time."""
    assert model.scaling is not None
    structure, (matrix, shift) = model.structure, model.scaling.unscaling(model.structure)
    values, sds = matrix @ parameters + shift, standard_deviations(covariance, matrix)
    named = zip(structure.parameter_names(), values, sds, strict=True)
    return ModelSnapshot(
        structure=ArxReference.kind,
        order=structure.output_lags,
        delay=min(structure.delays, default=1),
        parameters=[Parameter(name=name, value=value, sd=sd) for name, value, sd in named],
        rows=rows,
        forgetting=forgetting,
        excitation=1.0 / condition,
        condition=condition,
    )
