"""One-step-ahead predictions of an output by a recursive ARX model, and the same model as the training left it.

The adaptive model is updated with every row by recursive least squares; the prediction is that before the update. The
reference is fitted to the whole training at its end and then frozen: the adaptive model's distance from it is charted.

Where the adaptive model judges, it starts from the reference, and learns while nothing is wrong: not from a row whose
residual is beyond `GATE` standard deviations, and not while an alarm is active. It forgets a row after `MEMORY` others,
and the training counts as so many: a model that learned faster would learn a fault before the charts see it. What it
learned shortly before an alarm is taken back: its state becomes that of a copy that is `COPY_ROWS` to twice as many
rows old.

If the training has too few rows for the parameters, the models get a simpler structure (`arx_fit`), and the adaptive
model is updated with the rows of the training again.

Where these models are not the monitor's reference, rows are buffered, and the adaptive model is updated with all of
them when it is read.

Signals are scaled by mean and spread of the first rows, so that the estimator works with numbers of the order of one.
Snapshots are in the signals' own units.
"""

from collections.abc import Sequence
from math import isfinite, nan, sqrt
from typing import NamedTuple

import msgspec
import numpy as np

from monitor_node.baseline.arx_fit import (
    arx_snapshot,
    fit_arx,
    fit_snapshot,
    fitting_structure,
    input_columns,
    simpler_structures,
)
from monitor_node.baseline.training_record import check_training
from monitor_node.ingest.sampling import regular_intervals
from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import ModelSnapshot
from reactorwatch.errors import InputError
from reactorwatch.identification.recursion import RlsState
from reactorwatch.identification.regressor import BufferState, RegressorBuffer, Rows
from reactorwatch.identification.rls import RecursiveLeastSquares
from reactorwatch.identification.structure import Scaling, Structure
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.spc.charts.base import Judgement
from reactorwatch.spc.charts.parameters import ParameterState, ParameterT2
from reactorwatch.spc.parameter_drift import learn
from reactorwatch.stored_state import StoredState, pack_numbers, unpack_numbers

SCALING_ROWS = 50
"""Rows from which the scaling is made; there is no prediction before."""

MOST_BUFFERED = 1000
"""Buffered rows; memory stays bounded."""

GATE = 6.0
"""Standard deviations of a residual beyond which a row teaches an adaptive model that judges nothing."""

MEMORY = 10_000
"""Rows after which an adaptive model that judges has forgotten a row."""

JUDGING_FORGETTING = 1.0 - 1.0 / MEMORY
"""Least forgetting factor of an adaptive model that judges."""

COPY_ROWS = 250
"""Rows between two copies of an adaptive model that judges."""

_BREAK: tuple[int, Sequence[float], float] = (-(2**63), (), nan)
"""Marks a gap between two buffered rows."""


class PredictorState(StoredState, frozen=True):
    """State of a predictor.

    Attributes:
        buffer: rows of the next regressor.
        rls: the adaptive model.
        first_rows: rows from which the scaling will be made: doubles, inputs and output of each.
        scaling: scaling of the signals; None before it is known.
        reference: parameters of the reference, doubles; None before the fit.
        told: snapshot of the reference, a serialized `ModelSnapshot`; None without snapshots.
        drift: chart of the models' difference; None without one.
        drifted: newest point of that chart.
        ranges: smallest and largest value of each input of the reference's regressor in the training, scaled; doubles.
            Empty before the fit, and in states of earlier versions.
        copies: the older and the newer copy of an adaptive model that judges; empty where it does not.
        copied_rows: rows since the newer one.
        learning: False while the adaptive model does not learn.
        weight: rows for which a row of the training counts in an adaptive model that judges.
    """

    buffer: BufferState
    rls: RlsState
    first_rows: bytes
    scaling: Scaling | None
    reference: bytes | None
    told: bytes | None
    drift: ParameterState | None
    drifted: Judgement | None
    ranges: bytes = b""
    copies: list[RlsState] = msgspec.field(default_factory=list)
    copied_rows: int = 0
    learning: bool = True
    weight: float = 1.0


class FittedModel(NamedTuple):
    """Reference of a predictor in the signals' units, and the newest rows.

    Attributes:
        structure: structure of the model.
        coefficients: coefficients of the output's lags, of the inputs' lags, and the offset.
        inputs: inputs of the newest complete rows, the newest first.
        outputs: output in the same rows.
    """

    structure: Structure
    coefficients: list[float]
    inputs: list[list[float]]
    outputs: list[float]


class ArxPredictor:
    """Predicts one output.

    Args:
        structure: structure of the models.
        forgetting: forgetting factor of the adaptive model.
        with_snapshots: True if a snapshot of the reference will be read.
    """

    def __init__(self, structure: Structure, forgetting: float, *, with_snapshots: bool = True) -> None:
        self._wanted, self._forgetting, self._with_snapshots = structure, forgetting, with_snapshots
        self._start(structure)
        self._reference: Array | None = None
        self._reference_model: ModelSnapshot | None = None
        self._fitted: Rows | None = None
        self._drift: ParameterT2 | None = None
        self._newest_drift: Judgement | None = None
        self._ranges: Array | None = None
        self._copies: list[RlsState] = []
        self._copied_rows = 0
        self._learning = True
        self._weight = 1.0
        self.extrapolation_sd = 1.0
        """Standard deviation of the newest residual as a multiple of the usual one: what inputs beyond their range in
        the training add to the prediction counts as uncertain as it is large."""

    def _start(self, structure: Structure) -> None:
        """Start the adaptive model, and the scaling, with the next row."""
        self._structure, self._inputs = structure, input_columns(structure)
        self._rls = RecursiveLeastSquares(structure.parameters, self._forgetting)
        self._buffer = RegressorBuffer(structure)
        self._first_rows: list[tuple[float, ...]] = []
        self._buffered: list[tuple[int, Sequence[float], float]] = []
        self._scaling: Scaling | None = None
        self._input_scales: list[tuple[float, float]] = []
        self._output_scale = 0.0, 1.0

    @property
    def uses_inputs(self) -> bool:
        """True if the models have inputs."""
        return self._structure.inputs > 0

    @property
    def simplification(self) -> str:
        """Terms that the models lack because the training had too few rows; empty: none."""
        has, wanted = self._structure, self._wanted
        parts = []
        if has.output_lags < wanted.output_lags:
            parts.append(f"{has.output_lags} instead of {wanted.output_lags} lags of the output")
        if has.inputs < wanted.inputs:
            parts.append("no input")
        elif has.inputs and has.input_lags < wanted.input_lags:
            parts.append(f"{has.input_lags} instead of {wanted.input_lags} lags of the inputs")
        return " and ".join(parts)

    @property
    def state(self) -> PredictorState:
        """A copy of the state, after the buffered rows."""
        self.replay_buffer()
        return PredictorState(
            self._buffer.state,
            self._rls.state,
            pack_numbers(self._first_rows),
            self._scaling,
            None if self._reference is None else pack_numbers(self._reference),
            None if self._reference_model is None else self._reference_model.SerializeToString(),
            None if self._drift is None else self._drift.state,
            self._newest_drift,
            b"" if self._ranges is None else pack_numbers(self._ranges),
            list(self._copies),
            self._copied_rows,
            self._learning,
            self._weight,
        )

    def restore(self, state: PredictorState) -> None:
        """Resume bit-identically from a state of the same settings.

        Raises:
            ValueError: the state is damaged.
        """
        if state.buffer.structure not in (self._wanted, *simpler_structures(self._wanted)):
            raise ValueError(f"the state must be of {self._wanted}, got {state.buffer.structure}")
        self._start(state.buffer.structure)
        self._buffer = RegressorBuffer.from_state(state.buffer)
        self._rls = RecursiveLeastSquares.from_state(state.rls)
        self._first_rows = [tuple(row) for row in unpack_numbers(state.first_rows, 1 + self._structure.inputs).tolist()]
        if state.scaling is not None:
            self._scale(state.scaling)
        if state.reference is not None:
            (self._reference,) = unpack_numbers(state.reference, self._structure.parameters)
        if state.told is not None:
            self._reference_model = ModelSnapshot.FromString(state.told)
        self._drift = None if state.drift is None else ParameterT2.from_state(state.drift)
        self._newest_drift = state.drifted
        if state.ranges:
            self._ranges = unpack_numbers(state.ranges, len(state.ranges) // 16)
        self._copies, self._copied_rows = list(state.copies), state.copied_rows
        self._learning, self._weight = state.learning, state.weight

    def update(self, time_ns: int, inputs: Sequence[float], value: float, *, follows: bool) -> float:
        """Update with a row; returns the prediction made before it, NaN if there is none.

        Args:
            time_ns: time of the row; later than the last row's if it follows.
            inputs: one value an input; NaN if missing.
            value: output; NaN if missing.
            follows: True if the row before was one period ago.
        """
        if self._scaling is None:
            self._learn_scaling(inputs, value)
            return nan
        if self._buffered:
            self.replay_buffer()
        centre, spread = self._output_scale
        if not follows:
            self._buffer.restart()
        scaled = (value - centre) / spread
        scales = zip(inputs, self._input_scales, strict=False)  # all inputs, or none of a simpler structure
        regressor = self._buffer.update(time_ns, [(u - middle) / size for u, (middle, size) in scales], [scaled])
        if regressor is None:
            return nan
        if self._reference is None:
            return centre + spread * self._rls.update(regressor, scaled).prediction
        if self._copies:
            prediction = self._learn_carefully(regressor, scaled)
        else:
            prediction = self._rls.update(regressor, scaled).prediction
        self._compare(regressor)
        self.extrapolation_sd = self._extrapolation_sd(regressor)
        return centre + spread * prediction

    def start_judging(self) -> None:
        """Judge rows from now on; the adaptive model starts from the reference."""
        self.replay_buffer()
        if self._reference is not None:
            rows = min(self._rls.rows, 1.0 / max(1.0 - self._forgetting, 1e-12))
            self._rls.set_parameters(self._reference)
            self._weight = max(MEMORY / max(rows, 1.0), 1.0)
            self._rls.raise_information(self._weight)
            self._rls.raise_forgetting(max(JUDGING_FORGETTING, self._rls.forgetting))
            self._copies, self._copied_rows, self._learning = [self._rls.state] * 2, 0, True

    @property
    def judges(self) -> bool:
        """True if rows are judged by the adaptive model."""
        return bool(self._copies)

    def set_learning(self, learning: bool) -> None:
        """Learn from the rows to come or not; the end of learning takes back what was learned last."""
        if learning == self._learning or not self._copies:
            return
        self._learning = learning
        if not learning:
            self._rls = RecursiveLeastSquares.from_state(self._copies[0])
        self._copies, self._copied_rows = [self._rls.state] * 2, 0

    def _learn_carefully(self, regressor: Array, scaled: float) -> float:
        """Learn from a row where nothing is wrong; returns the prediction before."""
        prediction = self._rls.predict(regressor)
        if self._learning and (scaled - prediction) ** 2 <= GATE**2 * self._rls.noise_variance:
            self._rls.update(regressor, scaled)
            self._copied_rows += 1
            if self._copied_rows == COPY_ROWS:
                self._copies, self._copied_rows = [self._copies[1], self._rls.state], 0
        return prediction

    def fit_reference(self, time_min: Array, inputs: Array, outputs: Array) -> Array:
        """Fit the reference to a training by least squares.

        Args:
            time_min: times in minutes, shape (rows,).
            inputs: input values, shape (rows, inputs); NaN if missing.
            outputs: output values, shape (rows,); NaN if missing or left out.

        Returns:
            Residuals, shape (rows,), scaled to the size of out-of-sample residuals; NaN if missing. With too few rows
            for any structure there is no reference, and all are NaN.
        """
        structure = fitting_structure(self._structure, time_min, inputs, outputs)
        if structure != self._structure:
            self._structure = structure
            self.learn_again(time_min, inputs, outputs)
        fit = None if self._scaling is None else fit_arx(structure, self._scaling, time_min, inputs, outputs)
        if fit is None or self._scaling is None:
            return np.full(time_min.size, nan)
        self._reference, self._fitted, self._ranges = fit.parameters, fit.rows, fit.ranges
        if self._with_snapshots:
            self._reference_model = fit_snapshot(structure, self._scaling, fit)
            given = inputs[:, : structure.inputs]
            self._reference_model.checks.extend(check_training(structure, time_min, given, outputs, fit.residual))
        return fit.residual

    def _extrapolation_sd(self, regressor: Array) -> float:
        if self._ranges is None or self._reference is None:
            return 1.0
        given = regressor[self._inputs]
        beyond = given - np.clip(given, *self._ranges)
        if not beyond.any():
            return 1.0
        added = float(self._reference[self._inputs] @ beyond)
        return sqrt(1.0 + added * added / max(self._rls.noise_variance, 1e-30))

    def step_response(self, rows: int) -> Array:
        """Response of the reference's residual to a lasting step of one unit of the output, shape (rows,).

        NaN without a reference.

        Args:
            rows: number of rows from the onset on.
        """
        if self._reference is None:
            return np.full(rows, nan)
        response, lags = np.ones(rows), self._structure.output_lags
        for lag, coefficient in enumerate(self._reference[:lags].tolist(), start=1):
            response[lag:] -= coefficient
        return response

    def learn_again(self, time_min: Array, inputs: Array, outputs: Array) -> None:
        """Update a new adaptive model with the rows of a training; arguments as for `fit_reference`."""
        self._start(self._structure)
        follows = [False, *regular_intervals(time_min).tolist()]
        times_ns = [round(minutes * MINUTE_NS) for minutes in time_min.tolist()]
        for row in zip(times_ns, inputs.tolist(), outputs.tolist(), follows, strict=True):
            self.buffer(*row[:3], follows=row[3])

    def restart(self) -> None:
        """Forget the rows of the next regressor; the models stay."""
        self.replay_buffer()
        self._buffer.restart()

    def start_drift_chart(self, arl0: float) -> None:
        """Start the chart of the difference between the parameters of the adaptive model and the reference.

        Args:
            arl0: in-control run length of the chart, in rows.

        Raises:
            InputError: the training was too short for that, or the model does not forget.
        """
        self.replay_buffer()
        rows, self._fitted = self._fitted, None
        if rows is None:
            raise InputError("there is no reference to compare with")
        assert self._reference is not None
        names, lags = self._structure.parameter_names(), self._structure.output_lags
        residual = rows.outputs[:, 0] - rows.regressors @ self._reference
        self._drift = learn(rows.regressors, residual, self._rls.forgetting, len(residual), arl0, names, lags)

    def drift(self) -> tuple[Judgement, dict[str, float]] | None:
        """Newest point of the drift chart, and each parameter's contribution; None without a chart."""
        self.replay_buffer()
        if self._drift is None or self._newest_drift is None or self._reference is None:
            return None
        parts = self._drift.contributions(self._rls.parameters - self._reference)
        return self._newest_drift, dict(zip(self._drift.names, parts.tolist(), strict=True))

    def _compare(self, regressor: Array) -> None:
        if self._drift is not None and self._reference is not None:
            self._newest_drift = self._drift.update(self._rls.parameters - self._reference, regressor)

    def buffer(self, time_ns: int, inputs: Sequence[float], value: float, *, follows: bool) -> None:
        """Buffer a row for a later update; arguments as for `update`."""
        if self._scaling is None:
            self._learn_scaling(inputs, value)
            return
        if not follows:
            self._buffered.append(_BREAK)
        self._buffered.append((time_ns, inputs, value))
        if len(self._buffered) >= MOST_BUFFERED:
            self.replay_buffer()

    def replay_buffer(self) -> None:
        """Update with the buffered rows."""
        rows, self._buffered = self._buffered, []
        centre, spread = self._output_scale
        buffer, learn_row = self._buffer, self._rls.update
        for time_ns, inputs, value in rows:
            if time_ns == _BREAK[0]:
                buffer.restart()
                continue
            scaled = (value - centre) / spread
            scales = zip(inputs, self._input_scales, strict=False)
            regressor = buffer.update(time_ns, [(u - middle) / size for u, (middle, size) in scales], [scaled])
            if regressor is not None:
                learn_row(regressor, scaled)
                self._compare(regressor)

    @property
    def linear_reference(self) -> FittedModel | None:
        """The reference and the rows before the next one; None before the fit."""
        self.replay_buffer()
        if self._reference is None or self._scaling is None:
            return None
        matrix, shift = self._scaling.unscaling(self._structure)
        rows, (centre, spread) = self._buffer.state, self._output_scale
        inputs = [
            [middle + size * u for u, (middle, size) in zip(row, self._input_scales, strict=False)]
            for row in rows.inputs
        ]
        outputs = [centre + spread * row[0] for row in rows.outputs]
        return FittedModel(self._structure, (matrix @ self._reference + shift).tolist(), inputs, outputs)

    def adaptive_snapshot(self) -> ModelSnapshot | None:
        """Snapshot of the adaptive model, without a time; None before its first update."""
        self.replay_buffer()
        rls = self._rls
        if not rls.rows:
            return None
        covariance = self._weight * rls.parameter_covariance
        assert self._scaling is not None
        return arx_snapshot(
            self._structure, self._scaling, rls.parameters, covariance, rls.condition, rls.rows, rls.forgetting
        )

    def reference_snapshot(self) -> ModelSnapshot | None:
        """Snapshot of the reference, without a time; None before the fit."""
        if self._reference_model is None:
            return None
        snapshot = ModelSnapshot()
        snapshot.CopyFrom(self._reference_model)
        return snapshot

    def _learn_scaling(self, inputs: Sequence[float], value: float) -> None:
        row = (*inputs[: self._structure.inputs], value)
        if not all(map(isfinite, row)):
            return
        self._first_rows.append(row)
        if len(self._first_rows) == SCALING_ROWS:
            rows = np.array(self._first_rows)
            self._scale(Scaling.of(rows[:, :-1], rows[:, -1]))
            self._first_rows.clear()

    def _scale(self, scaling: Scaling) -> None:
        self._scaling = scaling
        self._input_scales = list(zip(scaling.input_centres, scaling.input_spreads, strict=True))
        self._output_scale = scaling.output_centres[0], scaling.output_spreads[0]
