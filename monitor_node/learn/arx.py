"""Identified models of a plant: a recursive ARX model of each output, updated row by row.

The adaptive model is updated with every row by recursive least squares; the prediction is that before the update. The
model as fitted to the whole training at its end (`arx_fit`) is then frozen: the adaptive model's distance from it is
charted.

The models are the reference of a plant whose other references predict no better, and otherwise adapt beside another
one. They serve any plant, but only within the inputs of their training; other rows are not evaluated.

Where the adaptive model judges, it starts from the fitted one, and learns while nothing is wrong: not from a row whose
residual is beyond `GATE` standard deviations, and not while an alarm is active. It forgets a row after `MEMORY` others,
and the training counts as at least so many: a model that learned faster would learn a fault before the charts see it.
What it learned shortly before an alarm is taken back: its state becomes that of a copy that is `COPY_ROWS` to twice as
many rows old. The variance of a residual grows with the leverage of its row, by which the parameters are uncertain, and
more where the errors of held-out rows of the training do; and with the distance of the inputs from those of the
training, by which errors last (`spc.extrapolation`).

Where the rows of many signals need predictions for the signal checks only, the models judge as fitted, and one product
of matrices predicts all outputs: a call for each output would cost more than all else.

Signals are scaled by mean and spread of the first rows, so that the estimator works with numbers of the order of one.
Snapshots are in the signals' own units.
"""

from collections.abc import Iterator, Sequence
from math import inf, isfinite, nan, sqrt
from typing import Self

import msgspec
import numpy as np
from msgspec.structs import replace

from monitor_node.config import MonitorConfig
from monitor_node.ingest.alignment import MeasuredRow
from monitor_node.learn.references import COPY_ROWS, Reference, RowPrediction
from reactorwatch.arrays import Array
from reactorwatch.identification.data import Rows
from reactorwatch.identification.rls import RecursiveLeastSquares, RlsMemory
from reactorwatch.identification.structure import Scaling, Structure
from reactorwatch.kalman.batch import GATE
from reactorwatch.process.model import ProcessModel
from reactorwatch.spc.charts.base import Judgement
from reactorwatch.spc.charts.parameters import ParameterT2
from reactorwatch.spc.extrapolation import WEIGHT, Extrapolation
from reactorwatch.stored_state import Memory, copy_of

MEMORY = 2_000
"""Rows after which an adaptive model that judges has forgotten a row. With 400, a leak of a tenth of the coolant is
learned before the charts see it; with 10,000, nonlinear plants raise alarms at each new set point for days."""

JUDGING_FORGETTING = 1.0 - 1.0 / MEMORY
"""Least forgetting factor of an adaptive model that judges."""


ORDERS = (20, 8)
"""Orders among which a training chooses beside the usual one: noise of measurement makes the equation of an output
long, and so do dead times, and the largest order of the settings is as long as the usual training determines."""


def arx_structure(config: MonitorConfig) -> Structure:
    """Structure of the identified models that the settings ask for, or the usual one."""
    delay = tuple(config.delay[name] for name in config.inputs) if isinstance(config.delay, dict) else config.delay
    return Structure.of_order(config.order or 3, delay or 1, inputs=len(config.inputs))


def judging_structures(config: MonitorConfig) -> list[Structure]:
    """Structures among which the training chooses where the models judge, the largest first."""
    usual = arx_structure(config)
    if config.order is not None or config.has_values_only:
        return [usual]
    others = [Structure.of_order(order, usual.delay, usual.inputs) for order in ORDERS]
    return sorted([usual, *others], key=lambda item: -item.parameters)


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


class LaggedRows(Memory, dict=True):
    """The complete rows before the next one, from which its regressor is made. The object is its own state.

    >>> rows = LaggedRows(Structure.of_order(1))
    >>> rows.update([10.0], 1.0) is None  # no row before the first
    True
    >>> rows.update([20.0], 2.0)  # y[k-1], u[k-1], 1
    array([ 1., 10.,  1.])

    Attributes:
        structure: structure of the model.
        outputs: outputs that the next regressor needs, newest first; fewer while there are too few rows.
        inputs: inputs of the same rows, one row after the other.
    """

    structure: Structure
    # Flat lists: a regressor is a dozen numbers, and slicing a list of a dozen takes a fraction of the overhead of a
    # NumPy call.
    outputs: list[float] = msgspec.field(default_factory=list)
    inputs: list[float] = msgspec.field(default_factory=list)

    def __post_init__(self) -> None:
        structure, self._history = self.structure, self.structure.history
        if len(self.inputs) != len(self.outputs) * structure.inputs or len(self.outputs) > self._history:
            raise ValueError(f"there must be at most {self._history} equal rows, got {len(self.outputs)}")
        self._lags = [
            (delay - 1 + lag) * structure.inputs + i
            for lag in range(structure.input_lags)
            for i, delay in enumerate(structure.delays)
        ]

    def restart(self) -> None:
        """Forget the rows, as after a gap."""
        self.outputs, self.inputs = [], []

    def update(self, inputs: list[float], output: float) -> Array | None:
        """Add a row; returns its regressor, shape (parameters,).

        None if it cannot be predicted, as there are too few complete rows just before it, or misses a value.
        """
        if not (isfinite(output) and all(map(isfinite, inputs))):
            self.restart()
            return None
        regressor, before = None, self._history - 1
        if len(self.outputs) > before:
            values = self.outputs[: self.structure.output_lags] + [self.inputs[i] for i in self._lags]
            regressor = np.array([*values, 1.0] if self.structure.offset else values)
        self.outputs = [output, *self.outputs[:before]]
        self.inputs = inputs + self.inputs[: before * self.structure.inputs]
        return regressor


class ArxPredictor(Memory, dict=True):
    """Predicts one output. The object is its own state.

    Attributes:
        structure: structure of the models.
        rls: the adaptive model.
        lagged: rows before the next one.
        first_rows: rows from which the scaling will be made, the inputs and the output of each.
        scaling: scaling of the signals; None before it is known.
        reference: parameters of the fitted model; None before the fit.
        reference_model: snapshot of the fitted model, a serialized `ModelSnapshot`; empty where none is published.
        drift_chart: chart of the models' difference; None without one.
        newest_drift: newest point of that chart.
        ranges: smallest, then largest value of each input of the fitted model's regressor in the training, scaled,
            shape (2, inputs); None before the fit and without inputs.
        copies: the older and the newer copy of an adaptive model that judges; empty where it does not.
        copied_rows: rows since the newer one.
        learning: False while an adaptive model that judges does not learn.
        leverage_gain: variance of a residual per unit of its row's leverage, in units of that without leverage: 1 for
            a plant that the model describes, more for others.
        largest_sd: largest standard deviation by leverage that is believed. A sensor that is off takes its own past
            where the training never was, and would else excuse itself.
        weight: rows for which a row of the training counts in an adaptive model that judges.
    """

    structure: Structure
    rls: RecursiveLeastSquares
    lagged: LaggedRows
    first_rows: list[tuple[float, ...]] = msgspec.field(default_factory=list)
    scaling: Scaling | None = None
    reference: Array | None = None
    reference_model: bytes = b""
    drift_chart: ParameterT2 | None = None
    newest_drift: Judgement | None = None
    ranges: Array | None = None
    copies: list[RlsMemory] = msgspec.field(default_factory=list)
    copied_rows: int = 0
    learning: bool = True
    leverage_gain: float = 0.0
    largest_sd: float = inf
    weight: float = 1.0

    def __post_init__(self) -> None:
        self.fitted_rows: Rows | None = None
        """Scaled rows to which the fitted model was fitted, until there is a drift chart."""
        self.extrapolation_sd = 1.0
        """Standard deviation of the newest residual with what inputs beyond their range in the training add to the
        prediction: it counts as uncertain as it is large."""
        self.sd = 1.0
        """Standard deviation of the newest residual, in units of that of rows without leverage."""
        if self.scaling is not None:
            self._scale(self.scaling)

    @classmethod
    def of(cls, structure: Structure, forgetting: float) -> Self:
        """Predictor that knows nothing."""
        return cls(structure, RecursiveLeastSquares(structure.parameters, forgetting), LaggedRows(structure))

    @property
    def input_columns(self) -> slice:
        """Columns of the inputs in a regressor."""
        first = self.structure.output_lags
        return slice(first, first + self.structure.input_lags * self.structure.inputs)

    def update(self, inputs: Sequence[float], value: float, *, follows: bool, extrapolation_sd: float = 1.0) -> float:
        """Update with a row; returns the prediction made before it, NaN if there is none.

        Args:
            inputs: one value an input; NaN where missing.
            value: the output; NaN if missing.
            follows: True if the row follows the one before.
            extrapolation_sd: standard deviation of the residual by the distance of the inputs from the training.
        """
        if self.scaling is None:
            self._learn_scaling(inputs, value)
            return nan
        centre, spread = self._output_scale
        if not follows:
            self.lagged.restart()
        scaled = (value - centre) / spread
        scales = zip(inputs, self._input_scales, strict=False)  # all inputs, or none of a simpler structure
        regressor = self.lagged.update([(u - middle) / size for u, (middle, size) in scales], scaled)
        if regressor is None:
            self.sd = self.extrapolation_sd = 1.0
            return nan
        if self.copies:
            prediction = self._learn_carefully(regressor, scaled, extrapolation_sd)
            self.extrapolation_sd = self._extrapolation_sd(regressor)
        else:
            prediction = self.rls.update(regressor, scaled).prediction
        if self.drift_chart is not None and self.reference is not None:
            self.newest_drift = self.drift_chart.update(self.rls.parameters - self.reference, regressor)
        return centre + spread * prediction

    def _learn_scaling(self, inputs: Sequence[float], value: float) -> None:
        row = (*inputs[: self.structure.inputs], value)
        if not all(map(isfinite, row)):
            return
        self.first_rows.append(row)
        if len(self.first_rows) == 50:
            rows = np.array(self.first_rows)
            self._scale(Scaling.of(rows[:, :-1], rows[:, -1]))
            self.first_rows.clear()

    def _scale(self, scaling: Scaling) -> None:
        self.scaling = scaling
        self._input_scales = list(zip(scaling.input_centres, scaling.input_spreads, strict=True))
        self._output_scale = scaling.output_centres[0], scaling.output_spreads[0]

    # --- judging ---------------------------------------------------------------------------------------------

    def start_judging(self) -> None:
        """Judge rows from now on; the adaptive model starts from the fitted one."""
        if self.reference is not None:
            rows = min(self.rls.rows, 1.0 / max(1.0 - self.rls.forgetting, 1e-12))
            self.rls.set_parameters(self.reference)
            self.weight = max(MEMORY / max(rows, 1.0), 1.0)
            self.rls.raise_information(self.weight)
            self.rls.raise_forgetting(max(JUDGING_FORGETTING, self.rls.forgetting))
            self.copies, self.copied_rows, self.learning = [copy_of(self.rls.memory)] * 2, 0, True

    def set_learning(self, learning: bool) -> None:
        """Learn from the rows to come or not; the end of learning takes back what was learned last."""
        if learning == self.learning or not self.copies:
            return
        self.learning = learning
        if not learning:
            self.rls = RecursiveLeastSquares.resume(copy_of(self.copies[0]))
        self.copies, self.copied_rows = [copy_of(self.rls.memory)] * 2, 0

    def _learn_carefully(self, regressor: Array, scaled: float, extrapolation_sd: float) -> float:
        """Learn from a row where nothing is wrong; returns the prediction before."""
        prediction = self.rls.predict(regressor)
        by_leverage = min(sqrt(1.0 + self.leverage_gain * self.rls.leverage(regressor)), self.largest_sd)
        self.sd = by_leverage * extrapolation_sd
        if self.learning and (scaled - prediction) ** 2 <= (GATE * self.sd) ** 2 * self.rls.noise_variance:
            self.rls.update(regressor, scaled)
            self.copied_rows += 1
            if self.copied_rows == COPY_ROWS:
                self.copies, self.copied_rows = [self.copies[1], copy_of(self.rls.memory)], 0
        return prediction

    def _extrapolation_sd(self, regressor: Array) -> float:
        if self.ranges is None or self.reference is None:
            return self.sd
        given = regressor[self.input_columns]
        beyond = given - np.clip(given, *self.ranges)
        if not beyond.any():
            return self.sd
        added = float(self.reference[self.input_columns] @ beyond)
        return sqrt(self.sd**2 + added * added / max(self.rls.noise_variance, 1e-30))

    # --- what is published -----------------------------------------------------------------------------------

    @property
    def judges(self) -> bool:
        """True if rows are judged by the adaptive model."""
        return bool(self.copies)

    def drift(self) -> tuple[Judgement, dict[str, float]] | None:
        """Newest point of the drift chart, and each parameter's contribution; None without a chart."""
        if self.drift_chart is None or self.newest_drift is None or self.reference is None:
            return None
        parts = self.drift_chart.contributions(self.rls.parameters - self.reference)
        return self.newest_drift, dict(zip(self.drift_chart.names, parts.tolist(), strict=True))


class ArxMemory(Memory, tag="arx"):
    """Memory of the identified models as reference, beside the models.

    Attributes:
        low: lower end of the range in which the models hold, one an input.
        high: upper end of it.
        past: where the models stay as fitted, signals of the rows before the next one, the inputs first and the newest
            row first, shape (rows, signals), NaN where missing; None elsewhere.
        extrapolation: variance of residuals by the distance of the inputs from the training; None: it does not grow.
        averages: averaged inputs, shape (inputs,).
    """

    low: list[float] = msgspec.field(default_factory=list)
    high: list[float] = msgspec.field(default_factory=list)
    past: Array | None = None
    extrapolation: Extrapolation | None = None
    averages: Array | None = None

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

    Attributes:
        config: settings of the monitor.
        points: True to publish predictions.
        structure: structure of the models that the settings ask for.
        predictors: the models, one an output; always the same list.
    """

    kind = "arx"
    is_identified = True

    def __init__(self, config: MonitorConfig, *, points: bool) -> None:
        self.config, self.points, self.structure = config, points, arx_structure(config)
        self.predictors: list[ArxPredictor] = []
        self.forget()

    def forget(self) -> None:
        """Start models that know nothing."""
        self.predictors[:] = [ArxPredictor.of(self.structure, self.config.forgetting) for _ in self.config.outputs]
        self.judge_by(ArxMemory())

    def resume(self, predictors: Sequence[ArxPredictor], *, follows: bool) -> None:
        """Resume from models of the same settings.

        Raises:
            ValueError: the models are of other settings.
        """
        known = (*judging_structures(self.config), *simpler_structures(self.structure))
        for predictor in predictors:
            found = predictor.structure
            as_set = found if self.config.delay is not None else replace(found, delay=self.structure.delay)
            if as_set not in known:
                raise ValueError(f"the state must be of {self.structure}, got {predictor.structure}")
        self.predictors[:] = map(copy_of, predictors)
        self.judge_by(ArxMemory())
        if not follows:
            self.restart()

    def judge_by(self, memory: ArxMemory) -> None:
        """Take over the ranges in which the models hold, and the rows before the next one.

        Raises:
            ValueError: the memory is of other settings.
        """
        shape = self.history, len(self.config.signals)
        if memory.past is not None and memory.past.shape != shape:
            raise ValueError(f"rows before must have shape {shape}, got {memory.past.shape}")
        self._memory, self.obstacles, self._lasting_sds = memory, {}, (1.0, 1.0)
        self._uses_inputs = np.array([predictor.structure.inputs > 0 for predictor in self.predictors])
        self._ranges = list(enumerate(zip(memory.low, memory.high, strict=True))) if self._uses_inputs.any() else []
        if memory.past is not None:
            self._set_matrices(*shape)

    @property
    def history(self) -> int:
        """Number of rows before a row that the models need."""
        return max(predictor.structure.history for predictor in self.predictors)

    def copy(self) -> "ArxReference":
        """Models that stand where these do, and judge nothing."""
        copy = ArxReference(self.config, points=self.points)
        copy.resume(self.predictors, follows=True)
        return copy

    @property
    def memory(self) -> ArxMemory:
        """See `Reference`; the models are stored beside it."""
        return self._memory

    @property
    def typical_sd(self) -> list[float]:
        """See `Reference`."""
        return [1.0] * len(self.predictors)

    # --- rows ------------------------------------------------------------------------------------------------

    def adapt(self, row: MeasuredRow) -> list[float]:
        """Update with a row that the adaptive models do not judge; returns their predictions if they are published."""
        found = self._update_adaptive(row)
        return found if self.points else []

    def _update_adaptive(self, row: MeasuredRow) -> list[float]:
        pairs, (sd, _) = zip(self.predictors, row.values, strict=True), self._lasting_sds
        return [
            predictor.update(row.inputs, value, follows=row.follows, extrapolation_sd=sd) for predictor, value in pairs
        ]

    def _average_inputs(self, inputs: tuple[float, ...]) -> None:
        """Average the inputs of a row into those before."""
        extrapolation, averages = self._memory.extrapolation, self._memory.averages
        if extrapolation is None or averages is None:
            return
        new = np.array(inputs)
        self._memory.averages = averages = averages + WEIGHT * np.where(np.isfinite(new), new - averages, 0.0)
        self._lasting_sds = extrapolation.sds(averages)

    def update(self, row: MeasuredRow, accept: tuple[bool, ...]) -> RowPrediction:
        """See `Reference`. Predictions with an input beyond the training are extrapolations."""
        self._average_inputs(row.inputs)
        predictions = self._predict_by_matrix(row) if self.stays_as_fitted else self._update_adaptive(row)
        extrapolation = predictions, [predictor.extrapolation_sd for predictor in self.predictors]
        outside = (i for i, (low, high) in self._ranges if row.inputs[i] < low or row.inputs[i] > high)
        beyond = [self.config.inputs[i] for i in outside]
        text = "is beyond its range in the training: the identified model does not hold there"
        self.obstacles = {name: f"rows are not judged while {name} {text}" for name in beyond}
        judged = np.where(self._uses_inputs, nan, predictions).tolist() if beyond else predictions
        share = self._lasting_sds[0] / self._lasting_sds[1]
        return RowPrediction(judged, [predictor.sd for predictor in self.predictors], extrapolation, share)

    def restart(self) -> None:
        """See `Reference`; what the models have learned stays."""
        for predictor in self.predictors:
            predictor.lagged.restart()
        if self._memory.past is not None:
            self._memory.past = np.full(self._memory.past.shape, nan)

    def set_learning(self, learning: bool) -> None:
        """See `Reference`."""
        for predictor in self.predictors:
            predictor.set_learning(learning)

    def step_responses(self, rows: int) -> Array:
        """See `Reference`; those of the fitted models."""
        responses = np.ones((len(self.predictors), rows))
        for response, predictor in zip(responses, self.predictors, strict=True):
            if predictor.reference is None:
                response[:] = nan
                continue
            lagged = predictor.reference[: predictor.structure.output_lags]
            for lag, coefficient in enumerate(lagged.tolist(), start=1):
                response[lag:] -= coefficient
        return responses

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
                for lag, coefficients in enumerate(parameters[lags:-1].reshape(structure.input_lags, inputs)):
                    theta[i, np.array(structure.delays) - 1 + lag, np.arange(inputs)] = coefficients
                needed[i, : structure.history, :inputs] = 1.0
        self._theta, self._needed = theta.reshape(outputs, -1), needed.reshape(outputs, -1)

    def _predict_by_matrix(self, row: MeasuredRow) -> list[float]:
        """Predict all outputs of a row from the rows before; NaN where there is no prediction."""
        past, signals, inputs = self._memory.past, np.array([*row.inputs, *row.values]), len(row.inputs)
        assert past is not None
        before = past.ravel() if row.follows else np.full(past.size, nan)
        known, present = np.isfinite(before), np.isfinite(signals)
        complete = present[inputs:] & (present[:inputs].all() | ~self._uses_inputs)
        complete &= self._needed @ ~known == 0.0
        self._memory.past = np.concatenate([signals, before[: -signals.size]]).reshape(past.shape)
        predicted = self._theta @ np.where(known, before, 0.0) + self._offsets
        predictions: list[float] = np.where(complete, predicted, nan).tolist()
        return predictions
