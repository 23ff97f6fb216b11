"""Black box as reference: a state map learned from the training, for plants without equations.

It goes on learning while nothing is wrong: `BlackBoxFilter` forgets a row after about `MEMORY` others. While alarms are
active it learns nothing, and what it learned shortly before is taken back: its parameters become those of a copy that
is `COPY_ROWS` to twice as many rows old, so a fault that was not noticed at once is not part of them.
"""

from collections.abc import Sequence
from math import inf, nan

import numpy as np
from numpy.typing import NDArray

from monitor_node.baseline.references import GATE, RowPrediction
from monitor_node.ingest.sampling import TOLERANCE, regular_intervals
from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import ModelSnapshot, Parameter
from reactorwatch.errors import InputError
from reactorwatch.identification.black_box.filter import MEMORY, BlackBoxFilter, BlackBoxState
from reactorwatch.identification.black_box.fit import fit_black_box
from reactorwatch.identification.black_box.model import BlackBoxModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.stored_state import StoredState, pack_numbers, unpack_numbers

SETTLING_ROWS = 50
"""Rows at the means before a step response."""

COPY_ROWS = 250
"""Rows between two copies of the parameters."""

UNCERTAIN = 0.2
"""Standard deviation of a coefficient of the dynamics above which the training did not determine them."""


class BlackBoxReferenceState(StoredState, frozen=True, tag="black-box"):
    """State of a `BlackBoxReference`.

    Attributes:
        model: the fitted state map.
        filter: state of its filter.
        outputs: index of each output of the model among the monitored ones.
        count: number of monitored outputs.
        period_min: sampling period of the training.
        limit_sd: see `BlackBoxFilter`.
        typical_sd: see `BlackBoxReference`.
        time_min: time of the newest row; None before the first.
        last_inputs: inputs of that row.
        rows: number of rows since the training.
        unjudged: number of these in which the model knew too little of the point of operation.
        copies: the older and the newer copy of the parameters and their covariance, as doubles.
    """

    model: BlackBoxModel
    filter: BlackBoxState
    outputs: list[int]
    count: int
    period_min: float
    limit_sd: list[float]
    typical_sd: list[float]
    time_min: float | None
    last_inputs: list[float]
    rows: int
    unjudged: int
    copies: list[bytes]


class BlackBoxReference:
    """Filter of a state map whose parameters are learned; see `references.Reference`.

    Args:
        model: the fitted state map.
        outputs: index of each of its outputs among the monitored ones.
        count: number of monitored outputs.
        period_min: sampling period.

    Attributes:
        typical_sd: median standard deviation of each residual in the training, in the outputs' units; 1 if unknown.
        last_inputs: inputs of the newest row.
        unjudged: number of rows in which the model knew too little of the point of operation.
    """

    kind = "black-box"

    def __init__(self, model: BlackBoxModel, outputs: list[int], count: int, period_min: float) -> None:
        self.model, self.period_min = model, period_min
        self._filter = BlackBoxFilter(model)
        self._outputs, self._count = outputs, count
        self._time_min: float | None = None
        self.last_inputs: tuple[float, ...] = (nan,) * model.inputs
        self.typical_sd = [1.0] * count
        self._rows = self.unjudged = 0
        self._copies = [self._filter.parameters] * 2

    @classmethod
    def learn(
        cls, time_min: Array, inputs: Array, measured: Array, evaluated: Array, smallest_sd: list[float], delay: int
    ) -> tuple["BlackBoxReference", Array]:
        """Learn a black box from a training.

        Args:
            time_min: times of the rows in minutes, shape (n,).
            inputs: shape (n, inputs).
            measured: outputs that are fitted, shape (n, outputs); NaN if missing, disturbed or left out.
            evaluated: outputs that are predicted; same shape as `measured`.
            smallest_sd: smallest standard deviation of each output.
            delay: delay of the inputs in rows.

        Returns:
            The reference, and the normalised residuals, scaled to the size of out-of-sample residuals; NaN if missing.

        Raises:
            InputError: there are too few rows or too many signals, or no output varies.
        """
        outputs = np.flatnonzero(np.isfinite(measured).any(axis=0)).tolist()
        if not outputs:
            raise InputError("outputs must vary in the training, none does")
        follows = np.concatenate([[False], regular_intervals(time_min)])
        smallest = np.array(smallest_sd)[outputs]
        model = fit_black_box(inputs, measured[:, outputs], follows, smallest, delay)
        reference = cls(model, outputs, measured.shape[1], float(np.median(np.diff(time_min))))
        residuals, sds = reference._filter.run(inputs, evaluated[:, outputs], follows)
        for output, column in zip(outputs, sds.T, strict=True):
            if np.isfinite(column).any():
                reference.typical_sd[output] = float(np.nanmedian(column))
        reference._time_min, reference.last_inputs = float(time_min[-1]), tuple(inputs[-1].tolist())
        z = np.full(measured.shape, nan)
        z[:, outputs] = residuals / sds * model.out_of_sample
        return reference, z

    @classmethod
    def from_state(cls, state: BlackBoxReferenceState) -> "BlackBoxReference":
        """Resume bit-identically from a state.

        Raises:
            ValueError: the state is damaged.
        """
        reference = cls(state.model, state.outputs, state.count, state.period_min)
        reference._filter.limit_sd = np.array(state.limit_sd)
        reference._filter.state = state.filter
        reference.typical_sd, reference._time_min = list(state.typical_sd), state.time_min
        reference.last_inputs = tuple(state.last_inputs)
        reference._rows, reference.unjudged = state.rows, state.unjudged
        size = state.model.shape.parameters
        copies = [unpack_numbers(item, size) for item in state.copies]
        reference._copies = [(item[0], item[1:]) for item in copies]
        return reference

    @property
    def state(self) -> BlackBoxReferenceState:
        """See `Reference`."""
        return BlackBoxReferenceState(
            self.model,
            self._filter.state,
            self._outputs,
            self._count,
            self.period_min,
            self._filter.limit_sd.tolist(),
            list(self.typical_sd),
            self._time_min,
            list(self.last_inputs),
            self._rows,
            self.unjudged,
            [pack_numbers(np.vstack([theta[None], covariance])) for theta, covariance in self._copies],
        )

    @property
    def parameters(self) -> tuple[Array, Array]:
        """Copies of the parameters and their covariance, of scaled signals."""
        return self._filter.parameters

    def snapshot(self, output: int, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> ModelSnapshot | None:
        """Snapshot of the model of an output, of scaled signals; None if the output is not predicted.

        Args:
            output: index of the output among the monitored ones.
            inputs: names of the inputs.
            outputs: names of the monitored outputs.
        """
        if output not in self._outputs:
            return None
        shape, (theta, covariance) = self.model.shape, self._filter.parameters
        names = [f"{outputs[i]}{lag}" for lag in range(1, shape.lags + 1) for i in self._outputs]
        names += [f"{name}{lag + shape.delay}" for lag in range(shape.lags) for name in inputs]
        first = self._outputs.index(output) * shape.terms
        terms = ["*".join(names[i] for i in product if i >= 0) or "1" for product in shape.products().tolist()]
        values = theta[first : first + shape.terms].tolist()
        sds = np.sqrt(np.diag(covariance)[first : first + shape.terms]).tolist()
        return ModelSnapshot(
            structure=self.kind,
            order=shape.lags,
            delay=shape.delay,
            parameters=[
                Parameter(name=name, value=value, sd=sd) for name, value, sd in zip(terms, values, sds, strict=True)
            ],
            rows=self.model.rows + self._rows,
            forgetting=1.0 - 1.0 / MEMORY,
            reference=True,
            held=not self._filter.learning,
        )

    def normalised_residuals(self, inputs: Array, outputs: Array, follows: NDArray[np.bool_]) -> Array:
        """Normalised residuals of other rows by the model as fitted, shape (rows, monitored outputs).

        Args:
            inputs: shape (rows, inputs).
            outputs: monitored outputs, shape (rows, monitored outputs).
            follows: True where a row is one period after the row before.
        """
        residuals, sds = BlackBoxFilter(self.model).run(inputs, outputs[:, self._outputs], follows)
        z = np.full(outputs.shape, nan)
        z[:, self._outputs] = residuals / sds * self.model.out_of_sample
        return z

    @property
    def weakness(self) -> str:
        """Reason why the promise may not hold at set points that the training has not seen; empty if it does."""
        if self.model.dynamics_sd <= UNCERTAIN:
            return ""
        return (
            "the training moved the plant too little to determine its dynamics: at new set points false alarms may be "
            "more than promised; train over more set points"
        )

    def set_learning(self, learning: bool) -> None:
        """Learn from the rows to come or not; the end of learning takes back what was learned last."""
        if learning == self._filter.learning:
            return
        self._filter.learning = learning
        if not learning:
            self._filter.reset_parameters(self._copies[0])
        self._copies = [self._filter.parameters] * 2

    def update(
        self, time_ns: int, inputs: Sequence[float], values: list[float], accept: tuple[bool, ...], missing: int = 0
    ) -> RowPrediction:
        """See `Reference`. There is no prediction just after a missing row."""
        time_min, before = time_ns / MINUTE_NS, self._time_min
        if before is None or abs(time_min - before - self.period_min) > TOLERANCE * self.period_min:
            self._filter.restart()
        measured = [values[i] for i in self._outputs]
        limits = [inf if accept[i] else GATE for i in self._outputs]
        predicted = self._filter.update(inputs, measured, limits)
        self.accept_row(time_min, tuple(inputs))
        prediction, sd = [nan] * self._count, [1.0] * self._count
        if predicted is None:
            return RowPrediction(prediction, sd)
        for i, output in enumerate(self._outputs):
            prediction[output], sd[output] = predicted.prediction[i], predicted.sd[i]
        if predicted.judged:
            return RowPrediction(prediction, sd)
        self.unjudged += 1
        return RowPrediction([nan] * self._count, sd, (prediction, sd))

    def step_responses(self, rows: int) -> Array:
        """Response of each output's normalised residual to a lasting step of one unit, shape (outputs, rows).

        The difference of two runs of the filter from its present state, with the inputs and outputs at their means.
        NaN for an output that is not predicted.

        Args:
            rows: number of rows from the onset on.
        """
        responses = np.full((self._count, rows), nan)
        centres = np.array(self.model.centres)
        steps = self.model.error_sd
        without = self._normalised_residuals(np.tile(centres, (rows, 1)))
        for i, output in enumerate(self._outputs):
            stepped = np.tile(centres, (rows, 1))
            stepped[:, i] += steps[i]
            responses[output] = (self._normalised_residuals(stepped) - without)[:, i] / steps[i]
        return responses

    def _normalised_residuals(self, values: Array) -> Array:
        """Normalised residuals of rows (outputs, then inputs) that follow some at the means, shape (rows, outputs)."""
        model, p = self.model, len(self._outputs)
        copy = BlackBoxFilter(model)
        copy.limit_sd, copy.state = self._filter.limit_sd, self._filter.state
        limits, residuals = [inf] * p, []
        for row in [*[list(model.centres)] * SETTLING_ROWS, *values.tolist()]:
            predicted = copy.update(row[p:], row[:p], limits)
            residuals.append(
                np.full(p, nan) if predicted is None else np.subtract(row[:p], predicted.prediction) / predicted.sd
            )
        return np.array(residuals[SETTLING_ROWS:])

    def restart(self) -> None:
        """See `Reference`."""
        self._filter.restart()

    def is_normal(self, time_min: float) -> bool:
        """True if a compiled step may take the row after the one of this time."""
        is_whole = len(self._outputs) == self._count
        return is_whole and self._filter.started and self._filter.learning and self._time_min == time_min

    @property
    def numbers(self) -> tuple[Array, Array]:
        """Belief and constants of the filter: its own numbers, see `BlackBoxFilter`."""
        return self._filter.belief, self._filter.constants

    def accept_row(self, time_min: float, inputs: tuple[float, ...]) -> None:
        """Note a row that was filtered in `numbers`."""
        self._time_min, self.last_inputs = time_min, inputs
        self._rows += 1
        if self._rows % COPY_ROWS == 0 and self._filter.learning:
            self._copies = [self._copies[1], self._filter.parameters]
