"""Reference by a process model: its extended Kalman filter.

It is nonlinear, so inputs beyond the training and irregular rows are no problem.
"""

from collections.abc import Sequence
from math import isfinite, nan

import numpy as np

from monitor_node.baseline.references import GATE, RowPrediction
from monitor_node.ingest.sampling import missing_in_intervals
from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.kalman.ekf import Filter, FilterState, NoiseLevels
from reactorwatch.kalman.filter_record import FilterRecord
from reactorwatch.kalman.noise_estimation import NoiseFit, fit_noise
from reactorwatch.kalman.uncertain_model import is_disturbance, learned_parameters, noise_starts, widen_model
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.stored_state import StoredState

MOST_UNKNOWN = 1
"""Rows in succession whose input may be unknown; after more, the filter restarts."""


class ProcessReferenceState(StoredState, frozen=True, tag="process"):
    """State of a `ProcessReference`.

    Attributes:
        noise: noise of the plant and its sensors.
        filter: state of the filter.
        last_inputs: the newest value of each input that was not missing; NaN before the first.
        guessed: one flag an input: it was missing in the filter's newest row.
        typical_sd: see `ProcessReference`.
        held_rows: number of rows since then, which the filter did not use.
        reach: see `input_reach`, one an input.
        learned: see `ProcessReference`.
        plant_noise: see `ProcessReference`; None: `noise`.
    """

    noise: NoiseLevels
    filter: FilterState
    last_inputs: list[float]
    guessed: list[bool]
    typical_sd: list[float]
    held_rows: int
    reach: list[float]
    learned: tuple[float, ...] = ()
    plant_noise: NoiseLevels | None = None


class ProcessReference:
    """Extended Kalman filter of a process model.

    Args:
        model: process model.
        outputs: names of the monitored outputs, in order.
        noise: noise of the plant and its sensors, of all states of the filter.
        learned: values of the parameters of what the filter estimates beside the states of the model
            (`kalman.uncertain_model.learned_parameters`).
        plant_noise: noise with which the equations alone, without disturbances, are likeliest; None: that given.

    Raises:
        InputError: the model lacks an output.

    Attributes:
        equations: the process model.
        model: model of the filter: the process model with the added states.
        noise: noise of the plant and its sensors, of all states of the filter.
        plant_noise: noise of a filter of the equations alone.
    """

    kind = "equations"

    def __init__(
        self,
        model: ProcessModel,
        outputs: tuple[str, ...],
        noise: NoiseLevels,
        learned: tuple[float, ...] = (),
        plant_noise: NoiseLevels | None = None,
    ) -> None:
        self.equations, self.noise, self._learned = model, noise, learned
        of_states = NoiseLevels(noise.measurement_sd, noise.process_sd[: len(model.states)])
        self.plant_noise = of_states if plant_noise is None else plant_noise
        self.model = model = widen_model(model, model.uncertain, learned)
        self._filter = Filter(model, noise)
        self._indices = output_indices(model, outputs)
        self._count = len(model.outputs)
        self._accept_all = len(outputs) == self._count and self._indices == list(range(self._count))
        self._all_known = (False,) * len(model.inputs)
        self.last_inputs, self._guessed, self._held_rows = (nan,) * len(model.inputs), self._all_known, 0
        self._reach = [0.0] * len(model.inputs)
        self.typical_sd = [1.0] * len(outputs)
        """Median standard deviation of each residual in the last `run`, in the outputs' units."""

    @classmethod
    def fit(
        cls,
        model: ProcessModel,
        outputs: tuple[str, ...],
        time_min: Array,
        inputs: Array,
        measured: Array,
        smallest_sd: list[float],
    ) -> "ProcessReference":
        """Make a reference with the noise that is fitted to a training, see `fit_training_noise`."""
        found = fit_training_noise(model, outputs, time_min, inputs, measured, smallest_sd, model.uncertain)
        learned = tuple(found.parameters[name] for name in learned_parameters(model.uncertain))
        if not any(map(is_disturbance, model.uncertain)):
            return cls(model, outputs, found.levels, learned)
        alone = fit_training_noise(model, outputs, time_min, inputs, measured, smallest_sd, ())
        return cls(model, outputs, found.levels, learned, alone.levels)

    @classmethod
    def from_state(
        cls, state: ProcessReferenceState, model: ProcessModel, outputs: tuple[str, ...]
    ) -> "ProcessReference":
        """Resume bit-identically from a state.

        Raises:
            ValueError: the state is of another model.
        """
        reference = cls(model, outputs, state.noise, state.learned, state.plant_noise)
        if len(state.filter.inputs) not in (0, len(model.inputs)):
            raise ValueError(f"the filter's state must have {len(model.inputs)} inputs, got {state.filter.inputs}")
        reference._filter.state = state.filter
        reference.last_inputs, reference._guessed = tuple(state.last_inputs), tuple(state.guessed)
        reference._held_rows, reference._reach = state.held_rows, list(state.reach)
        reference.typical_sd = list(state.typical_sd)
        return reference

    @property
    def known_plant(self) -> tuple[ProcessModel, NoiseLevels]:
        """Model and noise as if the constants were known: the filter's, with the disturbances alone beside the states.

        Rows narrow what is not known of the constants, so soon the filter judges nearly as this one does.
        """
        disturbances = tuple(filter(is_disturbance, self.equations.uncertain))
        model = widen_model(self.equations, disturbances, self._learned)
        sds = dict(zip(self.model.state_names, self.noise.process_sd, strict=True))
        return model, NoiseLevels(self.noise.measurement_sd, tuple(sds[name] for name in model.state_names))

    @property
    def noise_levels(self) -> dict[str, dict[str, float]]:
        """Standard deviations by name: of each sensor in its unit, of each state in its unit per square root minute."""
        states, constant = enumerate(self.model.state_names), self.model.constant_states
        return {
            "sensors": dict(zip(self.model.output_names, self.noise.measurement_sd, strict=True)),
            "states": {name: self.noise.process_sd[i] for i, name in states if i not in constant},
        }

    @property
    def state(self) -> ProcessReferenceState:
        """See `Reference`."""
        return ProcessReferenceState(
            self.noise,
            self._filter.state,
            list(self.last_inputs),
            list(self._guessed),
            list(self.typical_sd),
            self._held_rows,
            list(self._reach),
            self._learned,
            self.plant_noise if any(map(is_disturbance, self.equations.uncertain)) else None,
        )

    def update(
        self, time_ns: int, inputs: Sequence[float], values: list[float], accept: tuple[bool, ...], missing: int = 0
    ) -> RowPrediction:
        """See `Reference`.

        An input is held until the next row. So where a row or one of its inputs is missing, there is no prediction
        until the next row with all inputs. After one such row the prediction includes the uncertainty of the inputs:
        they were as before or as after, one of them plus or minus its largest pulse of one row in the training.
        """
        time_min, changes = time_ns / MINUTE_NS, list[tuple[float, tuple[float, ...]]]()
        unknown = any(self._guessed) + self._held_rows + missing
        if all(map(isfinite, inputs)):
            if unknown > MOST_UNKNOWN:
                self._filter.interrupt()
            elif unknown:
                changes = self._possible_changes(time_min, tuple(inputs))
            self.last_inputs, self._guessed, self._held_rows = tuple(inputs), self._all_known, 0
        elif unknown or not all(map(isfinite, self.last_inputs)):
            pairs = zip(inputs, self.last_inputs, strict=True)
            if not all(map(isfinite, self.last_inputs)):
                self.last_inputs = tuple(value if isfinite(value) else last for value, last in pairs)
            self._held_rows += missing + 1
            unknown_values = [nan] * len(values)
            return RowPrediction(unknown_values, unknown_values)
        else:
            pairs = zip(inputs, self.last_inputs, strict=True)
            self._guessed = tuple(not isfinite(value) for value in inputs)
            self.last_inputs = tuple(value if isfinite(value) else last for value, last in pairs)
        if self._accept_all:
            step = self._filter.update(time_min, self.last_inputs, values, gate=GATE, accept=accept, changes=changes)
            return RowPrediction(step.prediction, step.sd)
        measured, accepted = [nan] * self._count, [False] * self._count
        for i, value, is_accepted in zip(self._indices, values, accept, strict=True):
            measured[i], accepted[i] = value, is_accepted
        step = self._filter.update(
            time_min, self.last_inputs, measured, gate=GATE, accept=tuple(accepted), changes=changes
        )
        return RowPrediction([step.prediction[i] for i in self._indices], [step.sd[i] for i in self._indices])

    def is_normal(self, time_min: float) -> bool:
        """True if the filter's newest row has this time, and no input of it was missing."""
        state = self._filter.state
        known = not any(self._guessed) and not self._held_rows and state.time_min == time_min
        return self._accept_all and known and state.inputs == self.last_inputs

    @property
    def numbers(self) -> tuple[Array, Array]:
        """Belief of the filter, and its variances: its own numbers, see `Filter`."""
        return self._filter.belief, self._filter.variances

    def accept_row(self, time_min: float, inputs: tuple[float, ...]) -> None:
        """Note a row that a kernel has filtered in `numbers`."""
        self.last_inputs = inputs
        self._filter.accept_row(time_min, inputs)

    def _possible_changes(self, time_min: float, inputs: tuple[float, ...]) -> list[tuple[float, tuple[float, ...]]]:
        """Start of the time in which inputs are unknown, with each of their possible values.

        A row, or inputs of it, are missing. Empty: they were as before and after, or the filter starts with this row.
        """
        before_min, last, guessed = self._filter.state.time_min, self.last_inputs, any(self._guessed)
        unknown = self._guessed if guessed else (True,) * len(inputs)
        after = tuple(now if is_unknown else old for now, old, is_unknown in zip(inputs, last, unknown, strict=True))
        ends = {last, after}
        moving = [i for i, reach in enumerate(self._reach) if reach and unknown[i]]
        if before_min is None or (len(ends) == 1 and not moving):
            return []
        possible = [
            self._within_bounds(end, i, by)
            for end in sorted(ends)
            for i in moving
            for by in (-self._reach[i], self._reach[i])
        ] or [self._within_bounds(end, None, 0.0) for end in sorted(ends)]
        since_min = before_min if guessed else 0.5 * (before_min + time_min)
        return [(since_min, other) for other in possible]

    def _within_bounds(self, inputs: tuple[float, ...], moved: int | None, by: float) -> tuple[float, ...]:
        """Inputs, one of them moved by a pulse, within their bounds."""
        variables = self.model.inputs
        return tuple(
            min(max(value + by if i == moved else value, variable.lower), variable.upper)
            for i, (value, variable) in enumerate(zip(inputs, variables, strict=True))
        )

    def restart(self) -> None:
        """See `Reference`; what is known about the constants is kept."""
        self._filter.interrupt()
        self._guessed, self._held_rows = self._all_known, 0

    def run(self, time_min: Array, inputs: Array, measured: Array) -> tuple[Array, Array]:
        """Run over many rows; returns residuals and normalised residuals, each of shape (n, outputs).

        The reach of the inputs is learned (`input_reach`). The filter restarts after missing rows.

        Args:
            time_min: times in minutes, shape (n,).
            inputs: input values, shape (n, inputs).
            measured: output values, shape (n, outputs).
        """
        self._reach = [input_reach(time_min, column) for column in inputs.T]
        if self._accept_all and np.isfinite(inputs).all():
            times = np.round(time_min * MINUTE_NS) / MINUTE_NS
            steps = self._filter.run(FilterRecord(times, _mask_before_missing(time_min, inputs), measured, GATE))
            z = steps.residual / steps.sd
            if not np.any(np.abs(z) > GATE):  # no acceptance depended on the row before
                self.last_inputs, self._guessed, self._held_rows = tuple(inputs[-1].tolist()), self._all_known, 0
                self.typical_sd = _median_sds(steps.sd)
                return steps.residual, z
            self._filter.restart()
        residuals, z = np.full(measured.shape, np.nan), np.full(measured.shape, np.nan)
        sds = np.full(measured.shape, np.nan)
        accept, missing = (False,) * measured.shape[1], [0, *missing_in_intervals(time_min).tolist()]
        for row, values in enumerate(measured.tolist()):
            if missing[row]:
                self.restart()
            predicted = self.update(round(time_min[row] * MINUTE_NS), inputs[row].tolist(), values, accept)
            residual = [value - prediction for value, prediction in zip(values, predicted.prediction, strict=True)]
            residuals[row], sds[row] = residual, predicted.sd
            z[row] = [size / sd for size, sd in zip(residual, predicted.sd, strict=True)]
            accept = tuple(abs(size) > GATE for size in z[row].tolist())
        self.typical_sd = _median_sds(sds)
        return residuals, z


def _median_sds(sds: Array) -> list[float]:
    """Median of each column; 1 for a column without finite values."""
    finite = [column[np.isfinite(column)] for column in sds.T]
    return [float(np.median(column)) if column.size else 1.0 for column in finite]


def output_indices(model: ProcessModel, outputs: tuple[str, ...]) -> list[int]:
    """Indices of the outputs in the model.

    Raises:
        InputError: one is not among them.
    """
    for output in outputs:
        if output not in model.output_names:
            raise InputError(
                f"reference 'equations' needs outputs of the process, {', '.join(model.output_names)}, got {output!r}; "
                f'set reference = "arx"'
            )
    return [model.output_names.index(output) for output in outputs]


def input_reach(time_min: Array, inputs: Array) -> float:
    """Largest pulse of an input that lasts one row: distance from the nearer of the rows before and after.

    It is 0 if each move lasts for two rows at least. Then the input of a missing row was that of a neighbour.

    Args:
        time_min: times in minutes, shape (n,).
        inputs: values of the input, shape (n,); NaN if missing.
    """
    moved, is_next = np.abs(np.diff(inputs)), missing_in_intervals(time_min) == 0
    nearer = np.where(is_next[:-1] & is_next[1:], np.minimum(moved[:-1], moved[1:]), 0.0)
    return float(np.nanmax(nearer, initial=0.0))


def _mask_before_missing(time_min: Array, inputs: Array) -> Array:
    """The inputs, with NaN in rows before missing rows, so that a filter restarts after these."""
    return np.where((np.append(missing_in_intervals(time_min), 0) > 0)[:, None], nan, inputs)


def fit_training_noise(
    model: ProcessModel,
    outputs: tuple[str, ...],
    time_min: Array,
    inputs: Array,
    measured: Array,
    smallest_sd: list[float],
    uncertain: tuple[str, ...],
) -> NoiseFit:
    """Fit the noise of a plant and its sensors to its training.

    Args:
        model: process model.
        outputs: names of the monitored outputs.
        time_min: times in minutes, shape (n,).
        inputs: input values, shape (n, inputs).
        measured: output values, shape (n, outputs); NaN if missing or left out.
        smallest_sd: least standard deviation of each sensor.
        uncertain: what the filter estimates beside the states of the model, see `kalman.uncertain_model`.
    """
    columns = np.full((time_min.size, len(model.outputs)), np.nan)
    smallest = [1e-6] * len(model.outputs)
    for i, column, sd in zip(output_indices(model, outputs), measured.T, smallest_sd, strict=True):
        columns[:, i], smallest[i] = column, sd
    inputs = _mask_before_missing(time_min, inputs)
    return fit_noise(
        widen_model(model, uncertain),
        FilterRecord(time_min, inputs, columns),
        smallest,
        learned_parameters(uncertain),
        nearby=noise_starts(model, uncertain, columns, smallest),
    )
