"""What is learned before a plant is watched: the reference, what chance does to its residuals, and from which rows.

The rows are kept until the training ends. Then the filter of the process model is tuned to them, or the identified
model is taken, whichever the settings ask for; stretches that were themselves disturbed are left out; and the residuals
that remain teach what is normal. A training of which too much is disturbed is refused, and begins anew. After
`MOST_REFUSALS` the next one is taken whole: a plant that never rests has to be watched as well.
"""

from collections import deque
from collections.abc import Callable
from math import isfinite, log10
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from monitor_node.config import MonitorConfig
from monitor_node.predictor import ArxPredictor
from monitor_node.prewhitening import Prewhitening, learn
from monitor_node.references import ArxReference, ProcessReference, Reference, tuned
from monitor_node.signal_range import ranges_of
from monitor_node.stored_state import StoredState, packed, packed_times, unpacked, unpacked_times
from monitor_node.undisturbed import Undisturbed, undisturbed
from reactorwatch.contract.messages_pb2 import Check
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS

Array = NDArray[np.float64]

MOST_ROWS = 10_000
"""Of a training that is longer the newest so many teach; memory stays bounded."""

FEWEST_ROWS = 50
"""Fewer residuals than this teach nothing; the training goes on until they are there."""

MOST_REFUSALS = 2

MINOR = 0.2
"""A stretch is not disturbed if it is off by less than a few times this, in the smallest standard deviation that counts
of an identified model's residuals, or in standard deviations of the filter's."""

AS_WELL = 1.5
"""`auto` takes the process model if its residuals, prewhitened, are at most so many times as large as those of the
identified one. The doubt is in its favour: where the input goes beyond the training, it still holds."""


class Trained(NamedTuple):
    """What a training came to.

    Attributes:
        reference: that rows are expected by from now on.
        learned: what chance does to its residuals, one an output.
        e: those residuals, prewhitened, shape (n, outputs), of rows that are complete.
        measured: the outputs in rows that were not disturbed, shape (n, outputs); NaN elsewhere.
        checks: what can be said of the training, for people.
        refused: why it has to begin anew; empty if it is fit.
    """

    reference: Reference
    learned: list[Prewhitening]
    e: Array
    measured: Array
    checks: list[Check]
    refused: str


MOST_OUT_OF_RANGE = 1.0 / 3.0
"""Share of a signal's values that the process cannot have; with more of them the plant is not that process."""


class TrainingState(StoredState, frozen=True):
    """The rows of a training, and how many values of each output were there.

    Attributes:
        times_ns: of the rows, 64 bits each.
        rows: doubles: the input and the outputs of each.
        known: one count an output.
    """

    times_ns: bytes
    rows: bytes
    known: list[int]


class Training:
    """The rows of a training.

    Args:
        config: of the monitor.
        model: of the plant; None if only the identified model is to be taken.
        predictors: the identified models, one an output.
    """

    def __init__(self, config: MonitorConfig, model: ProcessModel | None, predictors: list[ArxPredictor]) -> None:
        self._config = config
        self._model = model
        self._predictors = predictors
        self._rows: deque[tuple[int, float, list[float]]] = deque(maxlen=MOST_ROWS)
        self._known = [0] * len(config.outputs)

    @property
    def state(self) -> TrainingState:
        """A copy of all that it remembers."""
        rows = [(input_value, *values) for _, input_value, values in self._rows]
        return TrainingState(packed_times(row[0] for row in self._rows), packed(rows), list(self._known))

    def restore(self, state: TrainingState) -> None:
        """Go on where a training of the same settings was when `state` was taken.

        Raises:
            ValueError: the state is damaged.
        """
        outputs = len(self._config.outputs)
        times_ns, rows = unpacked_times(state.times_ns), unpacked(state.rows, 1 + outputs).tolist()
        if len(times_ns) != len(rows) or len(state.known) != outputs:
            raise ValueError(f"a training must have a time a row and {outputs} counts, got {len(times_ns)} times")
        self._rows.extend((time_ns, row[0], row[1:]) for time_ns, row in zip(times_ns, rows, strict=True))
        self._known = list(state.known)

    def add(self, time_ns: int, input_value: float, values: list[float]) -> None:
        """Take a row in.

        Args:
            time_ns: of the row.
            input_value: NaN if missing.
            values: of the outputs; NaN where missing.
        """
        if self._rows and time_ns <= self._rows[-1][0]:  # the publisher began again: so does the record
            self._rows.clear()
            self._known = [0] * len(values)
        self._rows.append((time_ns, input_value, values))
        for index, value in enumerate(values):
            self._known[index] += isfinite(value)

    @property
    def enough(self) -> bool:
        """Whether there are enough rows to learn from."""
        return min(self._known) >= FEWEST_ROWS

    def finish(self, *, last_chance: bool) -> Trained:
        """Learn; the rows are then forgotten.

        Args:
            last_chance: whether the training is taken whatever it is like.
        """
        rows, self._rows = list(self._rows), deque(maxlen=MOST_ROWS)
        time_min = np.array([row[0] for row in rows]) / MINUTE_NS
        inputs = np.array([row[1] for row in rows])
        measured = np.array([row[2] for row in rows])
        reference, z, found = self._reference(time_min, inputs, measured)
        refused = _refused(self._config.outputs, z, found)
        if refused and last_chance and _enough(z):
            refused, found = "", [Undisturbed(np.isfinite(column), [], [], 0) for column in z.T]
        usable = np.column_stack([item.usable for item in found])
        z = np.where(usable, z, np.nan)
        smallest = _smallest(self._config, reference)
        learned = [learn(column, sd) for column, sd in zip(z.T, smallest, strict=True)]
        e = np.column_stack([_whitened(column, item) for column, item in zip(z.T, learned, strict=True)])
        complete = e[np.all(np.isfinite(e), axis=1)]
        checks = [Check(name="training", result=refused or _left_out(self._config.outputs, time_min, found) or "ok")]
        return Trained(reference, learned, complete, np.where(usable, measured, np.nan), checks, refused)

    def _reference(self, time_min: Array, inputs: Array, measured: Array) -> tuple[Reference, Array, list[Undisturbed]]:
        """The reference, its residuals in its own standard deviations, and what can be learned from them."""
        smallest = [MINOR * sd for sd in _smallest(self._config, None)]
        identified, found = _twice(lambda rows: self._identified(time_min, inputs, rows), measured, smallest)
        if self._model is None:
            return ArxReference(inputs), identified, found
        possible = self._possible(inputs, measured)
        if possible is None:
            return ArxReference(inputs), identified, found
        known_inputs, known = possible
        process: list[ProcessReference] = []

        def innovations(rows: Array) -> Array:
            process.append(self._process_reference(time_min, known_inputs, rows))
            return process[-1].run(time_min, known_inputs, known)[1]

        z, found_by_process = _twice(innovations, known, [MINOR] * measured.shape[1])
        residuals = z * np.array(process[-1].typical_sd)
        if self._config.reference == "process" or _as_well(residuals, identified):
            return process[-1], z, found_by_process
        return ArxReference(inputs), identified, found

    def _possible(self, inputs: Array, measured: Array) -> tuple[Array, Array] | None:
        """Inputs and outputs, NaN where the process cannot have such a value; None: too many are, it is another one."""
        signals = (self._config.input, *self._config.outputs)
        columns = np.column_stack([inputs, measured])
        lower, upper = np.array([(item.lower, item.upper) for item in ranges_of(self._model, signals)]).T
        out = np.isfinite(columns) & ((columns < lower) | (columns > upper))
        if self._config.reference != "process" and np.any(np.mean(out, axis=0) > MOST_OUT_OF_RANGE):
            return None
        columns = np.where(out, np.nan, columns)
        return columns[:, 0], columns[:, 1:]

    def _identified(self, time_min: Array, inputs: Array, measured: Array) -> Array:
        """The residuals of the identified models."""
        columns = zip(self._predictors, measured.T, strict=True)
        return np.column_stack([predictor.hold(time_min, inputs, column) for predictor, column in columns])

    def _process_reference(self, time_min: Array, inputs: Array, measured: Array) -> ProcessReference:
        config = self._config
        assert self._model is not None
        smallest = [config.smallest_sd.get(signal, 0.0) for signal in config.outputs]
        noise = tuned(self._model, config.outputs, time_min, inputs, measured, smallest)
        return ProcessReference(self._model, config.outputs, noise)


def _twice(
    residuals: Callable[[Array], Array], measured: Array, smallest: list[float]
) -> tuple[Array, list[Undisturbed]]:
    """Residuals of a model that was learned without the rows that were disturbed, and which rows these were.

    Args:
        residuals: learns from rows and gives residuals of all.
        measured: shape (n, outputs).
        smallest: standard deviation, one an output, in the residuals' units.
    """
    z = residuals(measured)
    found = [undisturbed(column, sd) for column, sd in zip(z.T, smallest, strict=True)]
    if not any(item.stretches or item.outliers for item in found) or any(item.refused for item in found):
        return z, found
    kept = np.column_stack([item.usable for item in found]) | ~np.isfinite(z)
    return residuals(np.where(kept, measured, np.nan)), found


def _smallest(config: MonitorConfig, reference: Reference | None) -> list[float]:
    """The least standard deviation of the residuals, in the units that they are in: the outputs' or the filter's."""
    smallest = [max(config.smallest_sd.get(signal, 0.0), 1e-12) for signal in config.outputs]
    if isinstance(reference, ProcessReference):
        return [sd / of_filter for sd, of_filter in zip(smallest, reference.typical_sd, strict=True)]
    return smallest


def _whitened(z: Array, learned: Prewhitening) -> Array:
    e = z - learned.constant
    for lag, coefficient in enumerate(learned.coefficients, start=1):
        e[lag:] -= coefficient * z[:-lag]
        e[:lag] = np.nan
    return np.asarray(e / learned.sd)


def _as_well(process: Array, identified: Array) -> bool:
    """Whether the process model predicts about as well as the identified one."""
    both = np.isfinite(process) & np.isfinite(identified)
    for ours, theirs, known in zip(process.T, identified.T, both.T, strict=True):
        if np.count_nonzero(known) >= FEWEST_ROWS:
            sizes = [learn(np.where(known, column, np.nan), 1e-12).sd for column in (ours, theirs)]
            if sizes[0] > AS_WELL * sizes[1]:
                return False
    return True


def _enough(z: Array) -> bool:
    return bool(np.min(np.count_nonzero(np.isfinite(z), axis=0)) >= FEWEST_ROWS)


def _refused(outputs: tuple[str, ...], z: Array, found: list[Undisturbed]) -> str:
    if not _enough(z):
        return (
            f"of too few rows could be told what to expect, {FEWEST_ROWS} are needed: do rows come one by one period?"
        )
    refused = [name for name, item in zip(outputs, found, strict=True) if item.refused]
    return f"more than a third of it was disturbed in {' and '.join(refused)}" if refused else ""


def _left_out(outputs: tuple[str, ...], time_min: Array, found: list[Undisturbed]) -> str:
    """What was left out, for people; empty if nothing was."""
    told = []
    for name, item in zip(outputs, found, strict=True):
        for (first, last), shift in zip(item.stretches, item.shifts, strict=True):
            digits = max(0, 2 - int(log10(max(time_min[-1] - time_min[0], 1.0))))
            since, until = time_min[first] - time_min[0], time_min[last] - time_min[0]
            when = f"{since:.{digits}f} to {until:.{digits}f} min from its start"
            told.append(f"left out {when}: {name} was off by {shift:+.1f} sd")
        if item.outliers:
            told.append(f"left out {item.outliers} outliers of {name}")
    return "; ".join(told)
