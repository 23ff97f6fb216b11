"""Recursive ARX model of an output: its update with a row, and the same model as the training left it.

The adaptive model is updated with every row by recursive least squares; the prediction is that before the update. The
reference is fitted to the whole training at its end (`arx_reference`) and then frozen: the adaptive model's distance
from it is charted.

Where the adaptive model judges, it starts from the reference, and learns while nothing is wrong: not from a row whose
residual is beyond `GATE` standard deviations, and not while an alarm is active. It forgets a row after `MEMORY` others,
and the training counts as so many: a model that learned faster would learn a fault before the charts see it. What it
learned shortly before an alarm is taken back: its state becomes that of a copy that is `COPY_ROWS` to twice as many
rows old.

If the training has too few rows for the parameters, the models get a simpler structure (`simpler_structures`), and the
adaptive model is updated with the rows of the training again.

Signals are scaled by mean and spread of the first rows, so that the estimator works with numbers of the order of one.
Snapshots are in the signals' own units.
"""

from collections.abc import Iterator, Sequence
from math import isfinite, nan, sqrt
from typing import Self

import msgspec
import numpy as np
from msgspec.structs import replace

from monitor_node.config import MonitorConfig
from monitor_node.ingest.rows import regular_intervals
from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import ModelSnapshot, Parameter
from reactorwatch.errors import InputError
from reactorwatch.identification.linear_model import standard_deviations
from reactorwatch.identification.regressor import RegressorBuffer, Rows
from reactorwatch.identification.rls import RecursiveLeastSquares, RlsMemory
from reactorwatch.identification.structure import Scaling, Structure
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.spc.charts.base import Judgement
from reactorwatch.spc.charts.parameters import ParameterT2
from reactorwatch.spc.parameter_drift import learn
from reactorwatch.stored_state import Memory, copy_of

ROWS_A_PARAMETER = 10
"""Least number of rows per parameter of the reference."""

SCALING_ROWS = 50
"""Rows from which the scaling is made; there is no prediction before."""

GATE = 6.0
"""Standard deviations of a residual beyond which a row teaches an adaptive model that judges nothing."""

MEMORY = 10_000
"""Rows after which an adaptive model that judges has forgotten a row."""

JUDGING_FORGETTING = 1.0 - 1.0 / MEMORY
"""Least forgetting factor of an adaptive model that judges."""

COPY_ROWS = 250
"""Rows between two copies of an adaptive model that judges."""


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


def input_columns(structure: Structure) -> slice:
    """Columns of the inputs in a regressor."""
    first = structure.output_lags
    return slice(first, first + structure.input_lags * structure.inputs)


class ArxPredictor(Memory, dict=True):
    """Predicts one output. The object is its own state.

    Attributes:
        wanted: structure of the models that the settings ask for.
        forgetting: forgetting factor of the adaptive model.
        structure: structure of the models.
        rls: the adaptive model.
        regressors: rows of the next regressor.
        first_rows: rows from which the scaling will be made, the inputs and the output of each.
        scaling: scaling of the signals; None before it is known.
        reference: parameters of the reference; None before the fit.
        reference_model: snapshot of the reference, a serialized `ModelSnapshot`; empty where none is published.
        drift_chart: chart of the models' difference; None without one.
        newest_drift: newest point of that chart.
        ranges: smallest, then largest value of each input of the reference's regressor in the training, scaled, shape
            (2, inputs); None before the fit and without inputs.
        copies: the older and the newer copy of an adaptive model that judges; empty where it does not.
        copied_rows: rows since the newer one.
        learning: False while an adaptive model that judges does not learn.
        weight: rows for which a row of the training counts in an adaptive model that judges.
    """

    wanted: Structure
    forgetting: float
    structure: Structure
    rls: RecursiveLeastSquares
    regressors: RegressorBuffer
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
    weight: float = 1.0

    def __post_init__(self) -> None:
        self._fitted: Rows | None = None
        self._input_scales: list[tuple[float, float]] = []
        self._output_scale = 0.0, 1.0
        self._inputs = input_columns(self.structure)
        self.extrapolation_sd = 1.0
        """Standard deviation of the newest residual as a multiple of the usual one: what inputs beyond their range in
        the training add to the prediction counts as uncertain as it is large."""
        if self.scaling is not None:
            self._scale(self.scaling)

    @classmethod
    def of(cls, structure: Structure, forgetting: float) -> Self:
        """Predictor that knows nothing; arguments as the attributes."""
        rls, regressors = RecursiveLeastSquares(structure.parameters, forgetting), RegressorBuffer(structure)
        return cls(structure, forgetting, structure, rls, regressors)

    @property
    def simplification(self) -> str:
        """Terms that the models lack because the training had too few rows; empty: none."""
        has, wanted = self.structure, self.wanted
        parts = []
        if has.output_lags < wanted.output_lags:
            parts.append(f"{has.output_lags} instead of {wanted.output_lags} lags of the output")
        if has.inputs < wanted.inputs:
            parts.append("no input")
        elif has.inputs and has.input_lags < wanted.input_lags:
            parts.append(f"{has.input_lags} instead of {wanted.input_lags} lags of the inputs")
        return " and ".join(parts)

    def update(self, time_ns: int, inputs: Sequence[float], value: float, *, follows: bool) -> float:
        """Update with a row; returns the prediction made before it, NaN if there is none.

        Args:
            time_ns: time of the row; later than the last row's if it follows.
            inputs: one value an input; NaN if missing.
            value: output; NaN if missing.
            follows: True if the row before was one period ago.
        """
        if self.scaling is None:
            self._learn_scaling(inputs, value)
            return nan
        centre, spread = self._output_scale
        if not follows:
            self.regressors.restart()
        scaled = (value - centre) / spread
        scales = zip(inputs, self._input_scales, strict=False)  # all inputs, or none of a simpler structure
        regressor = self.regressors.update(time_ns, [(u - middle) / size for u, (middle, size) in scales], [scaled])
        if regressor is None:
            return nan
        if self.copies:
            prediction = self._learn_carefully(regressor, scaled)
            self.extrapolation_sd = self._extrapolation_sd(regressor)
        else:
            prediction = self.rls.update(regressor, scaled).prediction
        if self.drift_chart is not None and self.reference is not None:
            self.newest_drift = self.drift_chart.update(self.rls.parameters - self.reference, regressor)
        return centre + spread * prediction

    def start_judging(self) -> None:
        """Judge rows from now on; the adaptive model starts from the reference."""
        if self.reference is not None:
            rows = min(self.rls.rows, 1.0 / max(1.0 - self.forgetting, 1e-12))
            self.rls.set_parameters(self.reference)
            self.weight = max(MEMORY / max(rows, 1.0), 1.0)
            self.rls.raise_information(self.weight)
            self.rls.raise_forgetting(max(JUDGING_FORGETTING, self.rls.forgetting))
            self.copies, self.copied_rows, self.learning = [copy_of(self.rls.memory)] * 2, 0, True

    @property
    def judges(self) -> bool:
        """True if rows are judged by the adaptive model."""
        return bool(self.copies)

    def set_learning(self, learning: bool) -> None:
        """Learn from the rows to come or not; the end of learning takes back what was learned last."""
        if learning == self.learning or not self.copies:
            return
        self.learning = learning
        if not learning:
            self.rls = RecursiveLeastSquares.resume(copy_of(self.copies[0]))
        self.copies, self.copied_rows = [copy_of(self.rls.memory)] * 2, 0

    def _learn_carefully(self, regressor: Array, scaled: float) -> float:
        """Learn from a row where nothing is wrong; returns the prediction before."""
        prediction = self.rls.predict(regressor)
        if self.learning and (scaled - prediction) ** 2 <= GATE**2 * self.rls.noise_variance:
            self.rls.update(regressor, scaled)
            self.copied_rows += 1
            if self.copied_rows == COPY_ROWS:
                self.copies, self.copied_rows = [self.copies[1], copy_of(self.rls.memory)], 0
        return prediction

    def set_reference(self, parameters: Array, rows: Rows) -> None:
        """Set the reference.

        Args:
            parameters: parameters of the model of scaled signals, shape (parameters,).
            rows: scaled rows of the training that they were fitted to.
        """
        self.reference, self._fitted = parameters, rows
        given = rows.regressors[:, self._inputs]
        self.ranges = np.array([given.min(axis=0), given.max(axis=0)]) if given.shape[1] else None

    def _extrapolation_sd(self, regressor: Array) -> float:
        if self.ranges is None or self.reference is None:
            return 1.0
        given = regressor[self._inputs]
        beyond = given - np.clip(given, *self.ranges)
        if not beyond.any():
            return 1.0
        added = float(self.reference[self._inputs] @ beyond)
        return sqrt(1.0 + added * added / max(self.rls.noise_variance, 1e-30))

    def step_response(self, rows: int) -> Array:
        """Response of the reference's residual to a lasting step of one unit of the output, shape (rows,).

        NaN without a reference.

        Args:
            rows: number of rows from the onset on.
        """
        if self.reference is None:
            return np.full(rows, nan)
        response, lags = np.ones(rows), self.structure.output_lags
        for lag, coefficient in enumerate(self.reference[:lags].tolist(), start=1):
            response[lag:] -= coefficient
        return response

    def learn_again(self, structure: Structure, time_min: Array, inputs: Array, outputs: Array) -> None:
        """Update a new adaptive model, of a structure, with the rows of a training.

        Args:
            structure: structure of the models from now on.
            time_min: times in minutes, shape (n,).
            inputs: input values, shape (n, inputs); NaN if missing.
            outputs: output values, shape (n,); NaN if missing.
        """
        self.structure, self._inputs = structure, input_columns(structure)
        self.rls = RecursiveLeastSquares(structure.parameters, self.forgetting)
        self.regressors, self.first_rows, self.scaling = RegressorBuffer(structure), [], None
        follows = [False, *regular_intervals(time_min).tolist()]
        times_ns = [round(minutes * MINUTE_NS) for minutes in time_min.tolist()]
        for row in zip(times_ns, inputs.tolist(), outputs.tolist(), follows, strict=True):
            self.update(*row[:3], follows=row[3])

    def restart(self) -> None:
        """Forget the rows of the next regressor; the models stay."""
        self.regressors.restart()

    def start_drift_chart(self, arl0: float) -> None:
        """Start the chart of the difference between the parameters of the adaptive model and the reference.

        Args:
            arl0: in-control run length of the chart, in rows.

        Raises:
            InputError: the training was too short for that, or the model does not forget.
        """
        rows, self._fitted = self._fitted, None
        if rows is None:
            raise InputError("there is no reference to compare with")
        assert self.reference is not None
        names, lags = self.structure.parameter_names(), self.structure.output_lags
        residual = rows.outputs[:, 0] - rows.regressors @ self.reference
        self.drift_chart = learn(rows.regressors, residual, self.rls.forgetting, len(residual), arl0, names, lags)

    def drift(self) -> tuple[Judgement, dict[str, float]] | None:
        """Newest point of the drift chart, and each parameter's contribution; None without a chart."""
        if self.drift_chart is None or self.newest_drift is None or self.reference is None:
            return None
        parts = self.drift_chart.contributions(self.rls.parameters - self.reference)
        return self.newest_drift, dict(zip(self.drift_chart.names, parts.tolist(), strict=True))

    def adaptive_snapshot(self) -> ModelSnapshot | None:
        """Snapshot of the adaptive model, without a time; None before its first update."""
        rls = self.rls
        if not rls.rows:
            return None
        covariance = self.weight * rls.parameter_covariance
        return self.snapshot(rls.parameters, covariance, rls.condition, rls.rows, rls.forgetting)

    def reference_snapshot(self) -> ModelSnapshot | None:
        """Snapshot of the reference, without a time; None before the fit."""
        return ModelSnapshot.FromString(self.reference_model) if self.reference_model else None

    def snapshot(
        self, parameters: Array, covariance: Array, condition: float, rows: int, forgetting: float
    ) -> ModelSnapshot:
        """Snapshot of a model in the signals' units, without a time.

        Args:
            parameters: parameters of the model of scaled signals, shape (parameters,).
            covariance: covariance of `parameters`, shape (parameters, parameters).
            condition: condition number of the regressors.
            rows: number of rows that the model has learned from.
            forgetting: forgetting factor.
        """
        assert self.scaling is not None
        structure, (matrix, shift) = self.structure, self.scaling.unscaling(self.structure)
        deviations = standard_deviations(covariance, matrix)
        return ModelSnapshot(
            structure="arx",
            order=structure.output_lags,
            delay=structure.delay,
            parameters=[
                Parameter(name=name, value=value, sd=sd)
                for name, value, sd in zip(
                    structure.parameter_names(), matrix @ parameters + shift, deviations, strict=True
                )
            ],
            rows=rows,
            forgetting=forgetting,
            excitation=1.0 / condition,
            condition=condition,
        )

    def _learn_scaling(self, inputs: Sequence[float], value: float) -> None:
        row = (*inputs[: self.structure.inputs], value)
        if not all(map(isfinite, row)):
            return
        self.first_rows.append(row)
        if len(self.first_rows) == SCALING_ROWS:
            rows = np.array(self.first_rows)
            self._scale(Scaling.of(rows[:, :-1], rows[:, -1]))
            self.first_rows.clear()

    def _scale(self, scaling: Scaling) -> None:
        self.scaling = scaling
        self._input_scales = list(zip(scaling.input_centres, scaling.input_spreads, strict=True))
        self._output_scale = scaling.output_centres[0], scaling.output_spreads[0]
