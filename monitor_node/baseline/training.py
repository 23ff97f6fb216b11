"""What is learned before a plant is watched: the reference, what chance does to its residuals, and from which rows.

The rows are kept until the training ends. Then the filter of the process model is tuned to them, or the identified
model is taken, whichever the settings ask for; stretches that were themselves disturbed are left out; and the residuals
that remain teach what is normal. A training of which too much is disturbed is refused, and begins anew. After
`MOST_REFUSALS` the next one is taken whole: a plant that never rests has to be watched as well.

A signal that does not come, or of which too little can be learned, is left out with the reason, and the others are
watched. Without values of the input the identified models predict each output from its own past alone.
"""

from collections import deque
from collections.abc import Callable
from math import isfinite, log10
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from monitor_node.baseline.outlier_blocks import Undisturbed, undisturbed
from monitor_node.baseline.predictor import ArxPredictor, fewest_rows
from monitor_node.baseline.references import ArxReference, ProcessReference, Reference, tuned
from monitor_node.baseline.resolution import resolution_sd
from monitor_node.baseline.signal_range import ranges_of
from monitor_node.config import MonitorConfig
from monitor_node.ingest.sampling import TOLERANCE
from reactorwatch.contract.messages_pb2 import Check
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.spc.prewhitening import Prewhitening, learn
from reactorwatch.stored_state import StoredState, packed, packed_times, unpacked, unpacked_times

Array = NDArray[np.float64]

MOST_ROWS = 10_000
"""Of a training that is longer the newest so many teach; memory stays bounded."""

FEWEST_ROWS = 50
"""Fewer residuals than this teach nothing; the training goes on until they are there."""

MOST_REFUSALS = 2

Residuals: TypeAlias = tuple[Array, list[float]]
"""Residuals, shape (n, outputs), and for each output the standard deviation that is of no interest, in their unit."""

MINOR = 0.2
"""A stretch is not disturbed if it is off by less than a few times this, in the smallest standard deviation that counts
of an identified model's residuals, or in standard deviations of the filter's."""

AS_WELL = 1.5
"""`auto` takes the process model if its residuals, prewhitened, are at most so many times as large as those of the
identified one. The doubt is in its favour: where the input goes beyond the training, it still holds."""


USUAL_SHARE = 0.9
"""Of the rows that come as they should; with fewer, that is what is wrong."""

NO_VALUE = "no value of it has come"
"""Why a signal that never came is left out."""

NOTHING_LEARNED = Prewhitening(0.0, (), 1.0, FEWEST_ROWS, 0.5 / FEWEST_ROWS, 0.0)
"""Stands for an output that is left out: no value of it is evaluated."""


class Trained(NamedTuple):
    """What a training came to.

    Attributes:
        reference: that rows are expected by from now on.
        learned: what chance does to its residuals, one an output.
        e: those residuals, prewhitened, shape (n, outputs); NaN where there is none.
        measured: the outputs in rows that were not disturbed, shape (n, outputs); NaN elsewhere.
        checks: what can be said of the training, for people.
        refused: why it has to begin anew; empty if it is fit.
        left_out: signals that cannot be watched, each with the reason.
    """

    reference: Reference
    learned: list[Prewhitening]
    e: Array
    measured: Array
    checks: list[Check]
    refused: str
    left_out: dict[str, str]


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
        of_identified = max(fewest_rows(config.order, config.delay), FEWEST_ROWS)
        self._fewest_rows = FEWEST_ROWS if model is not None else of_identified

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

    def is_enough(self, silent: list[bool]) -> bool:
        """True if there are enough rows to learn from; outputs that are silent are not waited for.

        Args:
            silent: one an output.
        """
        counts = [known for known, is_silent in zip(self._known, silent, strict=True) if not is_silent]
        return min(counts, default=0) >= self._fewest_rows

    def finish(self, *, last_chance: bool) -> Trained:
        """Learn; the rows are then forgotten.

        Args:
            last_chance: whether the training is taken whatever it is like.
        """
        rows, self._rows = list(self._rows), deque(maxlen=MOST_ROWS)
        time_min = np.array([row[0] for row in rows]) / MINUTE_NS
        inputs = np.array([row[1] for row in rows])
        measured = np.array([row[2] for row in rows])
        outputs = self._config.outputs
        steps = [resolution_sd(column) for column in measured.T]
        smallest = [
            max(self._config.smallest_sd.get(name, 0.0), sd, 1e-12) for name, sd in zip(outputs, steps, strict=True)
        ]
        left_out = _too_few_values(outputs, measured) | self._constant(measured, steps)
        measured[:, [name in left_out for name in outputs]] = np.nan
        reference, z, found = self._reference(time_min, inputs, measured, smallest, steps)
        if isinstance(reference, ArxReference) and (why := _too_few_values((self._config.input,), inputs[:, None])):
            left_out |= why
        left_out |= _too_few_residuals(outputs, z, time_min, inputs, left_out)
        evaluated = [name not in left_out for name in outputs]
        refused = _refused(outputs, found, evaluated) if any(evaluated) else "; ".join(dict.fromkeys(left_out.values()))
        if refused and last_chance and any(evaluated):
            refused, found = "", [Undisturbed(np.isfinite(column), [], [], 0) for column in z.T]
        usable = np.column_stack([item.usable for item in found]) & np.array(evaluated)
        z = np.where(usable, z, np.nan)
        if isinstance(reference, ProcessReference):
            smallest = [sd / typical for sd, typical in zip(smallest, reference.typical_sd, strict=True)]
        learned = [
            learn(column, sd) if is_evaluated else NOTHING_LEARNED
            for column, sd, is_evaluated in zip(z.T, smallest, evaluated, strict=True)
        ]
        e = np.column_stack([_whitened(column, item) for column, item in zip(z.T, learned, strict=True)])
        checks = [Check(name="training", result=refused or _left_out(outputs, time_min, found, evaluated) or "ok")]
        checks += [Check(name="signals", result=f"{name} is left out: {why}") for name, why in left_out.items()]
        return Trained(reference, learned, e, np.where(usable, measured, np.nan), checks, refused, left_out)

    def _constant(self, measured: Array, steps: list[float]) -> dict[str, str]:
        """Outputs that never vary, and of which no setting says how much is of interest, each with the reason."""
        return {
            name: f"it reads {np.nanmax(column):.6g} in the whole training; smallest_sd could say what matters of it"
            for name, column, step in zip(self._config.outputs, measured.T, steps, strict=True)
            if not step and not self._config.smallest_sd.get(name) and np.isfinite(column).any()
        }

    def _reference(
        self, time_min: Array, inputs: Array, measured: Array, smallest: list[float], steps: list[float]
    ) -> tuple[Reference, Array, list[Undisturbed]]:
        """The reference, its residuals in its own standard deviations, and what can be learned from them."""
        minor = [max(MINOR * sd, step) for sd, step in zip(smallest, steps, strict=True)]
        has_input = np.count_nonzero(np.isfinite(inputs)) >= FEWEST_ROWS
        known_input = inputs if has_input else np.zeros(inputs.size)
        if not has_input:
            self._predict_without_input(time_min, measured)
        identified, found = _twice(lambda rows: (self._identified(time_min, known_input, rows), minor), measured)
        if self._model is None or not has_input:
            return ArxReference(known_input), identified, found
        possible = self._possible(inputs, measured)
        if possible is None:
            return ArxReference(known_input), identified, found
        possible_inputs, known = possible
        process: list[ProcessReference] = []

        def innovations(rows: Array) -> Residuals:
            process.append(self._process_reference(time_min, possible_inputs, rows, smallest))
            z = process[-1].run(time_min, possible_inputs, known)[1]
            return z, [max(MINOR, step / sd) for step, sd in zip(steps, process[-1].typical_sd, strict=True)]

        z, found_by_process = _twice(innovations, known)
        residuals = z * np.array(process[-1].typical_sd)
        if self._config.reference == "process" or _as_well(residuals, identified):
            return process[-1], z, found_by_process
        return ArxReference(known_input), identified, found

    def _predict_without_input(self, time_min: Array, measured: Array) -> None:
        """Let the identified models learn the rows once more, with an input that never moves."""
        spacings = np.diff(time_min, prepend=np.nan)
        period = float(np.nanmedian(spacings)) if spacings.size > 1 else 0.0
        follows = (np.abs(spacings - period) <= TOLERANCE * period).tolist()
        times_ns = [round(minutes * MINUTE_NS) for minutes in time_min.tolist()]
        for predictor, column in zip(self._predictors, measured.T.tolist(), strict=True):
            for time_ns, value, is_next in zip(times_ns, column, follows, strict=True):
                predictor.put_by(time_ns, 0.0, value, follows=is_next)

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

    def _process_reference(
        self, time_min: Array, inputs: Array, measured: Array, smallest: list[float]
    ) -> ProcessReference:
        outputs = self._config.outputs
        assert self._model is not None
        noise = tuned(self._model, outputs, time_min, inputs, measured, smallest)
        return ProcessReference(self._model, outputs, noise)


def _twice(residuals: Callable[[Array], Residuals], measured: Array) -> tuple[Array, list[Undisturbed]]:
    """Residuals of a model that was learned without the rows that were disturbed, and which rows these were.

    Args:
        residuals: learns from rows and gives residuals of all.
        measured: shape (n, outputs).
    """
    z, smallest = residuals(measured)
    found = [undisturbed(column, sd) for column, sd in zip(z.T, smallest, strict=True)]
    if not any(item.stretches or item.outliers for item in found) or any(item.refused for item in found):
        return z, found
    kept = np.column_stack([item.usable for item in found]) | ~np.isfinite(z)
    return residuals(np.where(kept, measured, np.nan))[0], found


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


def _too_few_values(names: tuple[str, ...], columns: Array) -> dict[str, str]:
    """Signals that hardly ever came, each with the reason."""
    counts = np.count_nonzero(np.isfinite(columns), axis=0).tolist()
    return {
        name: NO_VALUE
        if not count
        else f"only {count} of {len(columns)} rows have a value of it, {FEWEST_ROWS} are needed"
        for name, count in zip(names, counts, strict=True)
        if count < FEWEST_ROWS
    }


def _too_few_residuals(
    outputs: tuple[str, ...], z: Array, time_min: Array, inputs: Array, left_out: dict[str, str]
) -> dict[str, str]:
    """Outputs that came, but could hardly ever be predicted, each with the reason."""
    counts = np.count_nonzero(np.isfinite(z), axis=0).tolist()
    return {
        name: f"only {count} of its {len(z)} rows could be predicted, {FEWEST_ROWS} are needed: "
        f"{_why_unpredicted(time_min, inputs)}"
        for name, count in zip(outputs, counts, strict=True)
        if count < FEWEST_ROWS and name not in left_out
    }


def _why_unpredicted(time_min: Array, inputs: Array) -> str:
    """Why rows could not be predicted."""
    spacings = np.diff(time_min)
    period = float(np.median(spacings)) if spacings.size else 0.0
    regular = np.count_nonzero(np.abs(spacings - period) <= TOLERANCE * period)
    if regular < USUAL_SHARE * spacings.size:
        return f"do rows come one by one period? {regular} of {spacings.size} spacings are within a tenth of the usual"
    known = int(np.count_nonzero(np.isfinite(inputs)))
    if FEWEST_ROWS <= known < USUAL_SHARE * inputs.size:
        return f"the input has a value in {known} of them"
    return "too often a value is missing in the rows before"


def _refused(outputs: tuple[str, ...], found: list[Undisturbed], evaluated: list[bool]) -> str:
    refused = [
        name
        for name, item, is_evaluated in zip(outputs, found, evaluated, strict=True)
        if item.refused and is_evaluated
    ]
    return f"more than a third of it was disturbed in {' and '.join(refused)}" if refused else ""


def _left_out(outputs: tuple[str, ...], time_min: Array, found: list[Undisturbed], evaluated: list[bool]) -> str:
    """What was left out, for people; empty if nothing was."""
    told = []
    for name, item, is_evaluated in zip(outputs, found, evaluated, strict=True):
        if not is_evaluated:
            continue
        for (first, last), shift in zip(item.stretches, item.shifts, strict=True):
            digits = max(0, 2 - int(log10(max(time_min[-1] - time_min[0], 1.0))))
            since, until = time_min[first] - time_min[0], time_min[last] - time_min[0]
            when = f"{since:.{digits}f} to {until:.{digits}f} min from its start"
            told.append(f"left out {when}: {name} was off by {shift:+.1f} sd")
        if item.outliers:
            told.append(f"left out {item.outliers} outliers of {name}")
    return "; ".join(told)
