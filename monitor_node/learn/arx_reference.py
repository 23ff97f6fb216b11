"""Identified models of a plant: a recursive ARX model for each output, fitted to the training.

They are the reference of a plant whose other references predict no better, and otherwise adapt beside another one. They
serve any plant, but only within the inputs of their training; other rows are not evaluated.

Where they judge, they learn while nothing is wrong (`arx`). Where the rows of many signals need predictions for the
signal checks only, they stay as fitted, and one product of matrices predicts all outputs: a call for each output would
cost more than all else.
"""

from collections.abc import Iterator, Sequence
from math import nan

import msgspec
import numpy as np

from monitor_node.config import MonitorConfig
from monitor_node.ingest.rows import MeasuredRow, regular_intervals
from monitor_node.learn.arx import ROWS_A_PARAMETER, ArxPredictor, arx_structure, simpler_structures
from monitor_node.learn.references import Reference, RowPrediction
from monitor_node.learn.training_rows import RowArrays
from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import Check
from reactorwatch.errors import InputError
from reactorwatch.identification.excitation import check_record
from reactorwatch.identification.identify import WORST_MINUS_LOG10_P
from reactorwatch.identification.regressor import Rows, rows_of
from reactorwatch.identification.residual_tests import ResidualTest, independence, whiteness
from reactorwatch.identification.structure import Structure
from reactorwatch.process.model import ProcessModel
from reactorwatch.stored_state import Memory, copy_of

MARGIN = 0.1
"""Share of an input's range in training by which it may be beyond it."""

MOST_LEVERAGE = 0.2
"""Largest variance of a prediction due to an input's coefficient, in variances of the residual. Several inputs are
often those of controllers, which leave their range with a fault: rows are judged as far as models are determined."""

MOSTLY = 0.5
"""Least share of the output's values that a simpler structure must predict; it is no cure for irregular rows."""


class ArxMemory(Memory, tag="arx"):
    """Memory of the identified models as reference, beside the models.

    Attributes:
        low: lower end of the range in which the models hold, one an input.
        high: upper end of it.
        past: where the models stay as fitted, signals of the rows before the next one, the inputs first and the newest
            row first, shape (rows, signals), NaN where missing; None elsewhere.
    """

    low: list[float] = msgspec.field(default_factory=list)
    high: list[float] = msgspec.field(default_factory=list)
    past: Array | None = None

    def reference(
        self, equations: ProcessModel | None, outputs: tuple[str, ...], models: "ArxReference"
    ) -> "ArxReference":
        """The identified models, which judge from now on as this memory has it.

        Raises:
            ValueError: the memory is of other settings.
        """
        models.judge_by(copy_of(self))
        return models


class ArxReference(Reference):
    """Identified models of one plant, one an output.

    Args:
        config: settings of the monitor.
        points: True to publish predictions.

    Attributes:
        points: see above.
        predictors: the models, one an output; always the same list.
    """

    kind = "arx"
    is_identified = True

    def __init__(self, config: MonitorConfig, *, points: bool) -> None:
        self._config, self.points = config, points
        self._sds = [1.0] * len(config.outputs)
        self.predictors: list[ArxPredictor] = []
        self.forget()

    def forget(self) -> None:
        """Start models that know nothing."""
        structure, forgetting = arx_structure(self._config), self._config.forgetting
        self.predictors[:] = [ArxPredictor.of(structure, forgetting) for _ in self._config.outputs]
        self.judge_by(ArxMemory())

    def resume(self, predictors: Sequence[ArxPredictor], *, follows: bool) -> None:
        """Resume from models of the same settings.

        Args:
            predictors: the models, which are copied.
            follows: True if the next row follows the ones before.

        Raises:
            ValueError: the models are of other settings.
        """
        wanted = arx_structure(self._config)
        for predictor in predictors:
            if predictor.wanted != wanted or predictor.structure not in (wanted, *simpler_structures(wanted)):
                raise ValueError(f"the state must be of {wanted}, got {predictor.wanted}")
        self.predictors[:] = map(copy_of, predictors)
        self.judge_by(ArxMemory())
        if not follows:
            self.restart()

    def judge_by(self, memory: ArxMemory) -> None:
        """Take over the ranges in which the models hold, and the rows before the next one.

        Raises:
            ValueError: the memory is of other settings.
        """
        shape = arx_structure(self._config).history, len(self._config.signals)
        if memory.past is not None and memory.past.shape != shape:
            raise ValueError(f"rows before must have shape {shape}, got {memory.past.shape}")
        self._memory, self._beyond = memory, list[int]()
        self._uses_inputs = np.array([predictor.structure.inputs > 0 for predictor in self.predictors])
        ranges = zip(memory.low, memory.high, strict=True)
        self._ranges = list(enumerate(ranges)) if self._uses_inputs.any() else []
        if memory.past is not None:
            self._set_matrices(*shape)

    def copy(self) -> "ArxReference":
        """Models that stand where these do, and judge nothing."""
        copy = ArxReference(self._config, points=self.points)
        copy.resume(self.predictors, follows=True)
        return copy

    @property
    def memory(self) -> ArxMemory:
        """See `Reference`; the models are stored beside it."""
        return self._memory

    @property
    def typical_sd(self) -> list[float]:
        """See `Reference`."""
        return self._sds

    # --- rows ------------------------------------------------------------------------------------------------

    def adapt(self, row: MeasuredRow) -> list[float]:
        """Update with a row that the adaptive models do not judge; returns their predictions if they are published."""
        pairs = zip(self.predictors, row.values, strict=True)
        found = [predictor.update(row.time_ns, row.inputs, value, follows=row.follows) for predictor, value in pairs]
        return found if self.points else []

    def update(
        self,
        time_ns: int,
        inputs: Sequence[float],
        values: list[float],
        accept: tuple[bool, ...],
        missing: int = 0,
        *,
        follows: bool = True,
    ) -> RowPrediction:
        """See `Reference`. Predictions with an input beyond the training are extrapolations."""
        if self.stays_as_fitted:
            predictions = self._predict_by_matrix(inputs, values, follows=follows)
        else:
            pairs = zip(self.predictors, values, strict=True)
            predictions = [predictor.update(time_ns, inputs, value, follows=follows) for predictor, value in pairs]
        extrapolation = predictions, [predictor.extrapolation_sd for predictor in self.predictors]
        self._beyond = [i for i, (low, high) in self._ranges if inputs[i] < low or inputs[i] > high]
        judged = np.where(self._uses_inputs, nan, predictions).tolist() if self._beyond else predictions
        return RowPrediction(judged, self._sds, extrapolation)

    def restart(self) -> None:
        """See `Reference`; what the models have learned stays."""
        for predictor in self.predictors:
            predictor.restart()
        if self._memory.past is not None:
            self._memory.past = np.full(self._memory.past.shape, nan)

    def set_learning(self, learning: bool) -> None:
        """See `Reference`."""
        for predictor in self.predictors:
            predictor.set_learning(learning)

    def obstacles(self, inputs: Sequence[str]) -> Iterator[tuple[str, str]]:
        """See `Reference`."""
        for name in (inputs[i] for i in self._beyond):
            text = "is beyond its range in the training: the identified model does not hold there"
            yield name, f"rows are not judged while {name} {text}"

    def step_responses(self, rows: int) -> Array:
        """See `Reference`."""
        return np.array([predictor.step_response(rows) for predictor in self.predictors])

    # --- models as fitted ------------------------------------------------------------------------------------

    @property
    def stays_as_fitted(self) -> bool:
        """True if the models judge as fitted; the adaptive ones are then updated by `adapt`."""
        return self._memory.past is not None

    def _set_matrices(self, rows: int, signals: int) -> None:
        """Make the matrix of the fitted models, and that of the signals before a row that each of them needs."""
        outputs, inputs = len(self.predictors), signals - len(self.predictors)
        theta, needed = np.zeros((outputs, rows, signals)), np.zeros((outputs, rows, signals))
        self._offsets = np.full(outputs, nan)
        for i, predictor in enumerate(self.predictors):
            if predictor.reference is None or predictor.scaling is None:
                continue
            structure, (matrix, shift) = predictor.structure, predictor.scaling.unscaling(predictor.structure)
            parameters, lags = matrix @ predictor.reference + shift, structure.output_lags
            theta[i, :lags, inputs + i], self._offsets[i] = parameters[:lags], parameters[-1]
            needed[i, : structure.history, inputs + i] = 1.0
            if structure.inputs:
                moved = slice(structure.delay - 1, structure.delay - 1 + structure.input_lags)
                theta[i, moved, :inputs] = parameters[lags:-1].reshape(structure.input_lags, inputs)
                needed[i, : structure.history, :inputs] = 1.0
        self._theta, self._needed = theta.reshape(outputs, -1), needed.reshape(outputs, -1)

    def _predict_by_matrix(self, inputs: Sequence[float], values: Sequence[float], *, follows: bool) -> list[float]:
        """Predict all outputs of a row from the rows before; NaN where there is no prediction."""
        past, row = self._memory.past, np.array([*inputs, *values])
        assert past is not None
        before = past.ravel() if follows else np.full(past.size, nan)
        known, present = np.isfinite(before), np.isfinite(row)
        complete = present[len(inputs) :] & (present[: len(inputs)].all() | ~self._uses_inputs)
        complete &= self._needed @ ~known == 0.0
        self._memory.past = np.concatenate([row, before[: -row.size]]).reshape(past.shape)
        predictions: list[float] = np.where(
            complete, self._theta @ np.where(known, before, 0.0) + self._offsets, nan
        ).tolist()
        return predictions

    # --- training --------------------------------------------------------------------------------------------

    def learn_again(self, rows: RowArrays) -> None:
        """Update new adaptive models with the rows of a training."""
        for predictor, column in zip(self.predictors, rows.outputs.T, strict=True):
            predictor.learn_again(predictor.structure, rows.time_min, rows.inputs, column)

    def fit(self, rows: RowArrays) -> Array:
        """Fit the reference of each model to a training; returns residuals, shape (n, outputs), see `fit_model`."""
        pairs = zip(self.predictors, rows.outputs.T, strict=True)
        return np.column_stack(
            [fit_model(item, rows.time_min, rows.inputs, column, with_snapshot=self.points) for item, column in pairs]
        )

    def start_judging(self, rows: RowArrays) -> None:
        """Judge the rows after a training; each input must have values."""
        time_min, inputs, outputs = rows
        low, high = np.nanmin(inputs, axis=0), np.nanmax(inputs, axis=0)
        margin = MARGIN * (high - low)
        if inputs.shape[1] > 1:  # an input that did not move has no coefficient
            values = np.count_nonzero(np.isfinite(inputs), axis=0)
            reach = np.where(high > low, np.nanstd(inputs, axis=0) * np.sqrt(MOST_LEVERAGE * values), np.inf)
            margin = np.maximum(margin, reach - 0.5 * (high - low))
        memory = ArxMemory((low - margin).tolist(), (high + margin).tolist())
        if self._config.has_values_only:
            history, late = arx_structure(self._config).history, np.flatnonzero(~regular_intervals(time_min))
            newest = np.column_stack([inputs, outputs])[(late[-1] + 1 if late.size else 0) :][: -history - 1 : -1]
            memory.past = np.full((history, newest.shape[1]), nan)
            memory.past[: len(newest)] = newest
        else:
            for predictor in self.predictors:
                predictor.start_judging()
        self.judge_by(memory)


def fit_model(
    model: ArxPredictor, time_min: Array, inputs: Array, outputs: Array, *, with_snapshot: bool = False
) -> Array:
    """Fit the reference of a model to a training by least squares, with the largest structure that its rows allow.

    Args:
        model: the model; with another structure it learns from the rows again.
        time_min: times in minutes, shape (n,).
        inputs: input values, shape (n, inputs); NaN if missing.
        outputs: output values, shape (n,); NaN if missing or left out.
        with_snapshot: True to make a snapshot of the reference.

    Returns:
        Residuals, shape (n,), scaled to the size of out-of-sample residuals; NaN if missing. With too few rows for any
        structure there is no reference, and all are NaN.
    """
    residual = np.full(time_min.size, nan)
    structure = _fitting_structure(model.structure, time_min, inputs, outputs)
    if structure is not None and structure != model.structure:
        model.learn_again(structure, time_min, inputs, outputs)
    scaling = model.scaling
    if structure is None or scaling is None:
        return residual
    inputs = inputs[:, : structure.inputs]
    rows = _consecutive_rows(structure, time_min, scaling.inputs(inputs), scaling.outputs(outputs[:, None]))
    regressors, y = rows.regressors, rows.outputs[:, 0]
    theta: Array = np.asarray(np.linalg.lstsq(regressors, y, rcond=1e-10)[0], dtype=np.float64)
    model.set_reference(theta, rows)
    # With n parameters fitted to N rows, in-sample residuals are sqrt((N - n) / (N + n)) of out-of-sample ones.
    in_sample = np.sqrt((len(y) - theta.size) / (len(y) + theta.size))
    residual[rows.position] = scaling.output_spreads[0] * (y - regressors @ theta) / in_sample
    if with_snapshot:
        snapshot = model.snapshot(theta, _covariance(rows, theta), float(np.linalg.cond(regressors)), len(y), 1.0)
        snapshot.checks.extend(_check_fit(structure, time_min, inputs, outputs, residual))
        model.reference_model = snapshot.SerializeToString()
    return residual


def _fitting_structure(structure: Structure, time_min: Array, inputs: Array, outputs: Array) -> Structure | None:
    """Largest structure for which the rows of a training suffice; None: there are too few for any."""
    least = 0.0
    for item in (structure, *simpler_structures(structure)):
        rows = len(_consecutive_rows(item, time_min, inputs[:, : item.inputs], outputs).outputs)
        if rows >= max(least, ROWS_A_PARAMETER * item.parameters):
            return item
        least = MOSTLY * np.count_nonzero(np.isfinite(outputs))
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


def _check_fit(structure: Structure, time_min: Array, inputs: Array, outputs: Array, residual: Array) -> list[Check]:
    """Checks of the rows of a training and the model fitted to them."""
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
