"""Black box as reference: a state map learned from the training, for plants without equations.

Where held-out rows of the training show that the residuals are errors of the model rather than noise, as with next to
no noise, their size is that of held-out rows, limits follow from their peaks (`spc.detection.error_factor`), and
nothing is learned later: it would be the last errors.

Otherwise it goes on learning while nothing is wrong: `BlackBoxFilter` forgets a row after about `MEMORY` others. While
alarms are active it learns nothing, and what it learned shortly before is taken back: its parameters become those of a
copy that is `COPY_ROWS` to twice as many rows old, so a fault that was not noticed at once is not part of them.
"""

from math import inf, nan

import msgspec
import numpy as np

from monitor_node.ingest.alignment import TOLERANCE, MeasuredRow, regular_intervals
from monitor_node.learn.references import COPY_ROWS, FilterReference, Reference, RowFilter, RowPrediction
from monitor_node.learn.training_rows import RowArrays
from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import ModelSnapshot, Parameter
from reactorwatch.errors import InputError
from reactorwatch.identification.black_box_filter import MEMORY, RATE, BlackBoxFilter, BlackBoxFilterMemory
from reactorwatch.identification.black_box_fit import fit_black_box, held_out_residuals
from reactorwatch.identification.black_box_model import BlackBoxModel
from reactorwatch.kalman.batch import GATE
from reactorwatch.kalman.noise_estimation import initial_sensor_sd
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.stored_state import Memory, copy_of

UNFAMILIAR = {
    "black-box": "rows are not judged while inputs have values that the black box has not learned, and teach it"
}
"""Obstacle once there was a row at an unfamiliar point of operation."""

LARGEST_BY_NOISE = 1.1
"""Size of held-out residuals in standard deviations up to which noise explains them: 1.00 to 1.05 with noise, 1.2 to 2
without (records of `make promise`, other seeds)."""

NOISE_RATIOS = (0.5, 2.0)
"""Smallest and largest residual over the noise that third differences of the output show with which noise explains them
in any case: 0.8 to 1.6 for reactors and heat exchangers with noise, 0.01 to 0.1 and above 1,000 for reactors without.
With disturbances that wander, held-out residuals of noise have sizes up to 1.3."""

LARGEST_ERROR = 3.24
"""Standard deviations that the largest held-out error of a model has, as the largest of 1,000 normal values."""


class BlackBoxMemory(Memory, tag="black-box"):
    """Memory of a `BlackBoxReference`.

    Attributes:
        model: the fitted state map.
        outputs: index of each output of the model among the monitored ones.
        count: number of monitored outputs.
        period_min: sampling period of the training.
        error_scale: ratio of the model's standard deviations to those of its fit; 0 where noise explains the residuals.
        typical_sd: median standard deviation of each residual in the training, in the outputs' units; 1 if unknown.
        filter: memory of the filter; None: a new one.
        time_min: time of the newest row; None before the first.
        last_inputs: inputs of that row.
        rows: number of rows since the training.
        unfamiliar_rows: number of these in which the model knew too little of the point of operation.
        copies: the older and the newer copy of the parameters, each with its covariance below it, row by row.
    """

    model: BlackBoxModel
    outputs: list[int]
    count: int
    period_min: float
    typical_sd: list[float]
    error_scale: float = 0.0
    filter: BlackBoxFilterMemory | None = None
    time_min: float | None = None
    last_inputs: tuple[float, ...] = ()
    rows: int = 0
    unfamiliar_rows: int = 0
    copies: list[Array] = msgspec.field(default_factory=list)

    def reference(
        self, equations: ProcessModel | None, outputs: tuple[str, ...], models: Reference
    ) -> "BlackBoxReference":
        """Reference that resumes from this memory, bit for bit.

        Raises:
            ValueError: the memory is damaged.
        """
        return BlackBoxReference(copy_of(self))


class BlackBoxReference(FilterReference):
    """Filter of a state map whose parameters are learned; see `references.Reference`.

    Attributes:
        model: the fitted state map.
        held_out: errors in rows of the training that were held out, shape (n, outputs), NaN where there is none; of no
            row where it was not just learned.
    """

    kind = "black-box"

    def __init__(self, memory: BlackBoxMemory) -> None:
        self._memory, self.model = memory, memory.model
        self._filter = BlackBoxFilter(memory.model, memory.filter)
        memory.filter = self._filter.memory
        if memory.error_scale:
            self._filter.constants[RATE] = 0.0
        self.held_out = np.empty((0, memory.count))
        self._outputs, self._count, self.period_min = memory.outputs, memory.count, memory.period_min
        if memory.unfamiliar_rows:
            self.obstacles = UNFAMILIAR
        if not memory.copies:
            memory.copies = [self._parameters()] * 2

    def _parameters(self) -> Array:
        """A copy of the parameters with their covariance below them, row by row."""
        theta, covariance = self._filter.parameters
        return np.vstack([theta[None], covariance]).ravel()

    @classmethod
    def learn(
        cls, rows: RowArrays, evaluated: Array, smallest_sd: list[float], delay: int
    ) -> tuple["BlackBoxReference", Array]:
        """Learn a black box from a training.

        Args:
            rows: rows that are fitted; outputs are NaN where missing, disturbed or left out.
            evaluated: outputs that are predicted, shape (n, outputs).
            smallest_sd: smallest standard deviation of each output.
            delay: delay of the inputs in rows.

        Returns:
            The reference, and the normalised residuals, scaled to the size of out-of-sample residuals, or those of
            held-out blocks if they are errors of the model; NaN if missing.

        Raises:
            InputError: there are too few rows or too many signals, or no output varies.
        """
        time_min, inputs, measured = rows
        outputs = np.flatnonzero(np.isfinite(measured).any(axis=0)).tolist()
        if not outputs:
            raise InputError("outputs must vary in the training, none does")
        follows = np.concatenate([[False], regular_intervals(time_min)])
        smallest = np.array(smallest_sd)[outputs]
        model = fit_black_box(inputs, measured[:, outputs], follows, smallest, delay)
        period_min, count = float(np.median(np.diff(time_min))), measured.shape[1]
        reference = cls(BlackBoxMemory(model, outputs, count, period_min, [1.0] * count))
        known = evaluated[:, outputs]
        residuals, sds = reference._filter.run(inputs, known, follows)
        held_out, held_out_sds = held_out_residuals(model, (inputs, measured[:, outputs], follows), known, smallest)
        fitted = np.isfinite(measured[:, outputs]) & np.isfinite(held_out)
        squares = np.sum(np.square(held_out), axis=0, where=fitted) / np.maximum(np.sum(fitted, axis=0), 1)
        sizes = [column[np.isfinite(column)] for column in np.abs(held_out * held_out_sds).T]
        typical = np.array([np.median(item) if item.size else 0.0 for item in sizes]) / 0.6745  # of a normal value
        noise = np.array([initial_sensor_sd(column) for column in known.T])
        is_noise = (NOISE_RATIOS[0] * noise <= typical) & (typical <= NOISE_RATIOS[1] * noise)
        if np.any((squares > LARGEST_BY_NOISE**2) & ~is_noise):
            scale = float(np.nanmax(np.abs(held_out))) / LARGEST_ERROR
            residuals, sds = held_out * held_out_sds, held_out_sds * scale
            reference = cls(
                BlackBoxMemory(model.scale_sds(scale), outputs, count, period_min, [1.0] * count, error_scale=scale)
            )
            reference._filter.run(inputs, known, follows)
            reference._filter.learning = False
            reference._filter.limit_sd = 1.3 * np.nanquantile(sds, 0.99, axis=0) / model.spreads[: len(outputs)]
        for output, column in zip(outputs, sds.T, strict=True):
            if np.isfinite(column).any():
                reference.typical_sd[output] = float(np.nanmedian(column))
        reference._memory.time_min, reference._memory.last_inputs = float(time_min[-1]), tuple(inputs[-1].tolist())
        z, reference.held_out = np.full(measured.shape, nan), np.full(measured.shape, nan)
        z[:, outputs], reference.held_out[:, outputs] = residuals / sds * model.out_of_sample, held_out * held_out_sds
        return reference, z

    @property
    def memory(self) -> BlackBoxMemory:
        """See `Reference`."""
        return self._memory

    @property
    def parameters(self) -> tuple[Array, Array]:
        """Copies of the parameters and their covariance, of scaled signals."""
        return self._filter.parameters

    def snapshot(self, output: int, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> ModelSnapshot | None:
        """See `Reference`; of scaled signals, and None if the output is not predicted."""
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
            rows=self.model.rows + self._memory.rows,
            forgetting=1.0 - 1.0 / MEMORY,
            reference=True,
            held=not self._filter.learning,
        )

    def normalised_residuals(self, rows: RowArrays) -> Array:
        """See `Reference`; by the model as fitted."""
        time_min, inputs, outputs = rows
        follows = np.concatenate([[False], regular_intervals(time_min)])
        residuals, sds = BlackBoxFilter(self.model).run(inputs, outputs[:, self._outputs], follows)
        z = np.full(outputs.shape, nan)
        z[:, self._outputs] = residuals / sds * self.model.out_of_sample
        return z

    @property
    def errs(self) -> bool:
        """See `Reference`."""
        return self._memory.error_scale > 0.0

    @property
    def weakness(self) -> str:
        """See `Reference`."""
        if self.errs or self.model.dynamics_sd <= 0.2:  # errors of a model that errs are known from held-out blocks
            return ""
        return (
            "the training moved the plant too little to determine its dynamics: at new set points false alarms may be "
            "more than promised; train over more set points"
        )

    def row_filter(self, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> RowFilter:
        """See `Reference`."""
        belief, constants = self.numbers
        shortest, longest = ((1.0 + sign * TOLERANCE) * self.period_min for sign in (-1.0, 1.0))
        return RowFilter(None, np.empty(0), (belief.size, constants.size), (shortest, longest))

    def set_learning(self, learning: bool) -> None:
        """Learn from the rows to come or not; the end of learning takes back what was learned last."""
        if learning == self._filter.learning or self.errs:  # what a model that errs would learn is its last errors
            return
        self._filter.learning = learning
        if not learning:
            numbers = self._memory.copies[0].reshape(-1, self.model.shape.parameters)
            self._filter.reset_parameters((numbers[0], numbers[1:]))
        self._memory.copies = [self._parameters()] * 2

    def update(self, row: MeasuredRow, accept: tuple[bool, ...]) -> RowPrediction:
        """See `Reference`. There is no prediction just after a missing row."""
        time_min, before = row.time_ns / MINUTE_NS, self._memory.time_min
        if before is None or abs(time_min - before - self.period_min) > TOLERANCE * self.period_min:
            self._filter.restart()
        measured = [row.values[i] for i in self._outputs]
        limits = [inf if accept[i] else GATE for i in self._outputs]
        predicted = self._filter.update(row.inputs, measured, limits)
        self.accept_row(time_min, row.inputs)
        prediction, sd = [nan] * self._count, [1.0] * self._count
        if predicted is None:
            return RowPrediction(prediction, sd)
        for i, output in enumerate(self._outputs):
            prediction[output], sd[output] = predicted.prediction[i], predicted.sd[i]
        if predicted.judged:
            return RowPrediction(prediction, sd)
        self._memory.unfamiliar_rows += 1
        self.obstacles = UNFAMILIAR
        return RowPrediction([nan] * self._count, sd, (prediction, sd))

    def step_responses(self, rows: int) -> Array:
        """See `Reference`; the difference of two runs of the filter from its present state, with means of the signals.

        NaN for an output that is not predicted.
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
        copy = BlackBoxFilter(model, copy_of(self._filter.memory))
        limits, residuals = [inf] * p, []
        for row in [*[list(model.centres)] * 50, *values.tolist()]:
            predicted = copy.update(row[p:], row[:p], limits)
            residuals.append(
                np.full(p, nan) if predicted is None else np.subtract(row[:p], predicted.prediction) / predicted.sd
            )
        return np.array(residuals[50:])

    def restart(self) -> None:
        """See `Reference`."""
        self._filter.restart()

    def is_ordinary(self, time_min: float) -> bool:
        """True if a compiled step may take the row after the one of this time."""
        is_whole, is_usual = len(self._outputs) == self._count, self._filter.learning != self.errs
        return is_whole and is_usual and self._filter.memory.started and self._memory.time_min == time_min

    @property
    def numbers(self) -> tuple[Array, Array]:
        """Belief and constants of the filter: its own numbers, see `BlackBoxFilter`."""
        return self._filter.belief, self._filter.constants

    def accept_row(self, time_min: float, inputs: tuple[float, ...]) -> None:
        """Note a row that was filtered in `numbers`."""
        memory = self._memory
        memory.time_min, memory.last_inputs = time_min, inputs
        memory.rows += 1
        if memory.rows % COPY_ROWS == 0 and self._filter.learning:
            memory.copies = [memory.copies[1], self._parameters()]
