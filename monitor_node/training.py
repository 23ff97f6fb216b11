"""What is learned before a plant is watched: the reference, what chance does to its residuals, and from which rows.

The rows are kept until the training ends. Then the filter of the process model is tuned to them, or the identified
model is taken, whichever the settings ask for; stretches that were themselves disturbed are left out; and the residuals
that remain teach what is normal. A training of which too much is disturbed is refused, and begins anew. After
`MOST_REFUSALS` the next one is taken whole: a plant that never rests has to be watched as well.
"""

from collections import deque
from math import isfinite, log10
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from monitor_node.config import MonitorConfig
from monitor_node.prewhitening import Prewhitening, learn
from monitor_node.references import ArxReference, ProcessReference, Reference, tuned
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


class Training:
    """The rows of a training.

    Args:
        config: of the monitor.
        model: of the plant; None if only the identified model is to be taken.
    """

    def __init__(self, config: MonitorConfig, model: ProcessModel | None) -> None:
        self._config = config
        self._model = model
        self._rows: deque[tuple[int, float, list[float], list[float]]] = deque(maxlen=MOST_ROWS)
        self._residuals = [0] * len(config.outputs)
        self._values = [0] * len(config.outputs)

    def add(self, time_ns: int, input_value: float, values: list[float], residuals: list[float]) -> None:
        """Take a row in.

        Args:
            time_ns: of the row.
            input_value: NaN if missing.
            values: of the outputs; NaN where missing.
            residuals: of the identified models on rows that they have not learned from; NaN where there are none.
        """
        if self._rows and time_ns <= self._rows[-1][0]:  # the publisher began again: so does the record
            self._rows.clear()
            self._residuals, self._values = [0] * len(values), [0] * len(values)
        self._rows.append((time_ns, input_value, values, residuals))
        for index, (value, residual) in enumerate(zip(values, residuals, strict=True)):
            self._values[index] += isfinite(value)
            self._residuals[index] += isfinite(residual)

    @property
    def enough(self) -> bool:
        """Whether there are enough rows to learn from."""
        counts = self._residuals if self._model is None else self._values
        return min(counts) >= FEWEST_ROWS

    def finish(self, *, last_chance: bool) -> Trained:
        """Learn; the rows are then forgotten.

        Args:
            last_chance: whether the training is taken whatever it is like.
        """
        rows, self._rows = list(self._rows), deque(maxlen=MOST_ROWS)
        time_min = np.array([row[0] for row in rows]) / MINUTE_NS
        inputs = np.array([row[1] for row in rows])
        measured = np.array([row[2] for row in rows])
        identified = np.array([row[3] for row in rows])
        reference, z, found = self._reference(time_min, inputs, measured, identified)
        refused = _refused(self._config.outputs, time_min, found)
        if refused and last_chance:
            found = [Undisturbed(np.isfinite(column), [], [], 0) for column in z.T]
        z = np.where(np.column_stack([item.usable for item in found]), z, np.nan)
        smallest = _smallest(self._config, reference)
        learned = [learn(column, sd) for column, sd in zip(z.T, smallest, strict=True)]
        e = np.column_stack([_whitened(column, item) for column, item in zip(z.T, learned, strict=True)])
        checks = [Check(name="training", result=refused or _left_out(self._config.outputs, time_min, found) or "ok")]
        usable = np.where(np.isfinite(z), measured, np.nan)
        complete = e[np.all(np.isfinite(e), axis=1)]
        return Trained(reference, learned, complete, usable, checks, "" if last_chance else refused)

    def _reference(
        self, time_min: Array, inputs: Array, measured: Array, identified: Array
    ) -> tuple[Reference, Array, list[Undisturbed]]:
        """The reference, its residuals in its own standard deviations, and what can be learned from them."""
        if self._model is not None:
            process, z, residuals = self._process_reference(self._model, time_min, inputs, measured)
            found = [undisturbed(column) for column in z.T]
            if any(item.stretches or item.outliers for item in found) and not any(item.refused for item in found):
                usable = np.where(np.column_stack([item.usable for item in found]), measured, np.nan)
                process, z, residuals = self._process_reference(self._model, time_min, inputs, usable)
                z = np.where(np.isfinite(measured), z, np.nan)
            if self._config.reference == "process" or _as_well(residuals, identified):
                return process, z, found
        return ArxReference(inputs), identified, [undisturbed(column) for column in identified.T]

    def _process_reference(
        self, model: ProcessModel, time_min: Array, inputs: Array, measured: Array
    ) -> tuple[ProcessReference, Array, Array]:
        config = self._config
        smallest = [config.smallest_sd.get(signal, 0.0) for signal in config.outputs]
        noise = tuned(model, config.outputs, time_min, inputs, measured, smallest)
        reference = ProcessReference(model, config.outputs, noise)
        residuals, z = reference.run(time_min, inputs, measured)
        return reference, z, residuals


def _smallest(config: MonitorConfig, reference: Reference) -> list[float]:
    """The least standard deviation of the residuals, in the units that they are in."""
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


def _refused(outputs: tuple[str, ...], time_min: Array, found: list[Undisturbed]) -> str:
    refused = [name for name, item in zip(outputs, found, strict=True) if item.refused]
    if not refused:
        return ""
    return f"more than a third of it was disturbed in {' and '.join(refused)}"


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
