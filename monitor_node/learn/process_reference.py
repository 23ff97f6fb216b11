"""Reference by a process model: its extended Kalman filter.

It is nonlinear, so inputs beyond the training and irregular rows are no problem.
"""

from dataclasses import replace
from functools import lru_cache
from math import isfinite, nan

import msgspec
import numpy as np

from monitor_node.ingest.alignment import NO_INTERVAL, MeasuredRow, missing_in_intervals
from monitor_node.learn.free_run import FreeRun, FreeRunMemory
from monitor_node.learn.references import FilterReference, PlantEquations, Reference, RowFilter, RowPrediction
from monitor_node.learn.training_rows import RowArrays
from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import CompiledFunction
from reactorwatch.contract.messages_pb2 import ModelSnapshot, Parameter
from reactorwatch.errors import InputError
from reactorwatch.kalman.batch import GATE, LONGEST_ROW_MIN, FilterRecord
from reactorwatch.kalman.ekf import Filter, FilterState
from reactorwatch.kalman.ekf_step import NoiseLevels, row_function
from reactorwatch.kalman.filter_states import NOISE, is_disturbance, learned_parameters, widen_model
from reactorwatch.kalman.noise_estimation import NoiseFit, fit_noise, is_coarse, losses_nearby, noise_starts
from reactorwatch.process.model import MODEL_CACHE_SIZE, ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.stored_state import Memory, copy_of

WANDER_ROWS = 10.0
"""Time constant of a wandering input, in rows, at which its search starts."""

ROUNDING_ROWS = 3.0
"""Time constant of a coarse sensor's rounding errors, in rows, at which its search starts."""


class ProcessMemory(Memory, tag="process"):
    """Memory of a `ProcessReference`.

    Attributes:
        noise: noise of the plant and its sensors, of all states of the filter.
        learned: values of the parameters of what the filter estimates beside the states of the model
            (`kalman.filter_states.learned_parameters`).
        alone: noise with which the equations alone, without disturbances, are likeliest; None: `noise`.
        filter: state of the filter; None before the first row.
        last_inputs: the newest value of each input that was not missing; NaN before the first.
        guessed: one flag an input: it was missing in the filter's newest row.
        held_rows: number of rows since then, which the filter did not use.
        reach: see `input_reach`, one an input.
        typical_sd: median standard deviation of each residual in the last `run`, in the outputs' units.
        free_run: memory of the free run.
    """

    noise: NoiseLevels
    learned: tuple[float, ...] = ()
    alone: NoiseLevels | None = None
    filter: FilterState | None = None
    last_inputs: tuple[float, ...] = ()
    guessed: tuple[bool, ...] = ()
    held_rows: int = 0
    reach: list[float] = msgspec.field(default_factory=list)
    typical_sd: list[float] = msgspec.field(default_factory=list)
    free_run: FreeRunMemory = msgspec.field(default_factory=FreeRunMemory)

    def reference(
        self, equations: ProcessModel | None, outputs: tuple[str, ...], models: Reference
    ) -> "ProcessReference":
        """Reference that resumes from this memory, bit for bit.

        Raises:
            ValueError: there are no equations, or others.
        """
        if equations is None:
            raise ValueError("the state must be of a plant without a process model")
        return ProcessReference(equations, outputs, copy_of(self))


class ProcessReference(FilterReference):
    """Extended Kalman filter of a process model.

    Raises:
        InputError: the model lacks an output.
        ValueError: the memory is of another model.

    Attributes:
        equations: the process model.
        model: model of the filter: the process model with the added states.
        plant_noise: noise of a filter of the equations alone.
    """

    kind = "equations"

    def __init__(self, model: ProcessModel, outputs: tuple[str, ...], memory: ProcessMemory) -> None:
        self._memory, self.equations, noise = memory, model, memory.noise
        of_states = NoiseLevels(noise.measurement_sd, noise.process_sd[: len(model.states)])
        self.plant_noise = of_states if memory.alone is None else memory.alone
        self.model = model = widen_model(model, model.uncertain, memory.learned)
        self._filter, inputs = Filter(model, noise), len(model.inputs)
        self._free_run = FreeRun(model, noise, memory.free_run)
        self._outputs, self._indices = outputs, output_indices(model, outputs)
        self._count = len(model.outputs)
        self._accept_all = len(outputs) == self._count and self._indices == list(range(self._count))
        self._all_known = (False,) * inputs
        if memory.filter is None:
            memory.last_inputs, memory.guessed, memory.reach = (nan,) * inputs, self._all_known, [0.0] * inputs
            memory.typical_sd = [1.0] * len(outputs)
        elif len(memory.filter.inputs) in (0, inputs):
            self._filter.state = memory.filter
        else:
            raise ValueError(f"the filter's state must have {inputs} inputs, got {memory.filter.inputs}")

    @classmethod
    def fit(
        cls,
        model: ProcessModel,
        outputs: tuple[str, ...],
        rows: RowArrays,
        smallest_sd: list[float],
    ) -> "ProcessReference":
        """Make a reference with the noise that is fitted to a training, see `fit_training_noise`."""
        found = fit_training_noise(model, outputs, rows, smallest_sd, model.uncertain)
        learned = tuple(found.parameters[name] for name in learned_parameters(model, model.uncertain))
        if not any(map(is_disturbance, model.uncertain)):
            return cls(model, outputs, ProcessMemory(found.levels, learned))
        alone = fit_training_noise(model, outputs, rows, smallest_sd, ())
        loudest = loudest_disturbances(widen_model(model, model.uncertain, learned), found.levels, outputs, rows)
        return cls(model, outputs, ProcessMemory(loudest, learned, alone.levels))

    @property
    def memory(self) -> ProcessMemory:
        """See `Reference`."""
        self._memory.filter = self._filter.state
        return self._memory

    @property
    def known_plant(self) -> PlantEquations:
        """Model and noise as if the constants were known: the filter's, with the disturbances alone beside the states.

        Rows narrow what is not known of the constants, so soon the filter judges nearly as this one does.
        """
        disturbances = tuple(filter(is_disturbance, self.equations.uncertain))
        model = widen_model(self.equations, disturbances, self._memory.learned)
        sds = dict(zip(self.model.state_names, self._memory.noise.process_sd, strict=True))
        noise = NoiseLevels(self._memory.noise.measurement_sd, tuple(sds[name] for name in model.state_names))
        return PlantEquations(model, noise)

    @property
    def plant(self) -> PlantEquations:
        """See `Reference`."""
        return PlantEquations(self.equations, self.plant_noise)

    def row_filter(self, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> RowFilter | None:
        """See `FilterReference`."""
        model, states = self.model, len(self.model.states)
        if model.breakpoints or (model.input_names, model.output_names) != (inputs, outputs):
            return None
        sizes = states + states**2, len(outputs) + states
        return RowFilter(_compiled_filter(model), model.values(), sizes, (0.0, LONGEST_ROW_MIN))

    def snapshot(self, output: int, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> ModelSnapshot:
        """Snapshot of the filter: its noise levels."""
        levels = self.noise_levels
        sensor = Parameter(name="sensor_sd", value=levels["sensors"][outputs[output]])
        states = [Parameter(name=f"{name}_sd", value=value) for name, value in levels["states"].items()]
        return ModelSnapshot(structure=self.kind, parameters=[sensor, *states], reference=True, held=True)

    def normalised_residuals(self, rows: RowArrays) -> Array:
        """See `Reference`."""
        fresh = ProcessReference(self.equations, self._outputs, copy_of(self.memory))
        fresh.restart()
        return fresh.run(rows)

    @property
    def noise_levels(self) -> dict[str, dict[str, float]]:
        """Standard deviations by name: of each sensor in its unit, of each state in its unit per square root minute."""
        states, constant = enumerate(self.model.state_names), self.model.constant_states
        return {
            "sensors": dict(zip(self.model.output_names, self._memory.noise.measurement_sd, strict=True)),
            "states": {name: self._memory.noise.process_sd[i] for i, name in states if i not in constant},
        }

    def update(self, row: MeasuredRow, accept: tuple[bool, ...]) -> RowPrediction:
        """See `Reference`.

        An input is held until the next row. So where a row or one of its inputs is missing, there is no prediction
        until the next row with all inputs. After one such row the prediction includes the uncertainty of the inputs:
        they were as before or as after, one of them plus or minus its largest pulse of one row in the training.
        """
        memory, time_min, changes = self._memory, row.time_ns / MINUTE_NS, list[tuple[float, tuple[float, ...]]]()
        self.has_returned = self._free_run.is_away = False
        inputs, missing = row.inputs, row.interval.missing
        unknown = any(memory.guessed) + memory.held_rows + missing
        if all(map(isfinite, inputs)):
            if unknown > 1:
                self._filter.interrupt()
            elif unknown:
                changes = self._possible_changes(time_min, inputs)
            memory.last_inputs, memory.guessed, memory.held_rows = inputs, self._all_known, 0
        elif unknown or not all(map(isfinite, memory.last_inputs)):
            pairs = zip(inputs, memory.last_inputs, strict=True)
            if not all(map(isfinite, memory.last_inputs)):
                memory.last_inputs = tuple(value if isfinite(value) else last for value, last in pairs)
            memory.held_rows += missing + 1
            unknown_values = [nan] * len(row.values)
            return RowPrediction(unknown_values, unknown_values)
        else:
            pairs = zip(inputs, memory.last_inputs, strict=True)
            memory.guessed = tuple(not isfinite(value) for value in inputs)
            memory.last_inputs = tuple(value if isfinite(value) else last for value, last in pairs)
        measured, accepted = row.values, list(accept)
        if not self._accept_all:
            measured, accepted = [nan] * self._count, [False] * self._count
            for i, value, is_accepted in zip(self._indices, row.values, accept, strict=True):
                measured[i], accepted[i] = value, is_accepted
        step = self._filter.update(time_min, memory.last_inputs, measured, gate=GATE, accept=accepted, changes=changes)
        if memory.free_run.state is None:
            self._free_run.add(self._filter, time_min, memory.last_inputs)
        elif (state := self._free_run.update(time_min, memory.last_inputs, measured)) is not None:
            self._filter.state, self.has_returned = state, True
        if self._accept_all:
            return RowPrediction(step.prediction, step.sd)
        return RowPrediction([step.prediction[i] for i in self._indices], [step.sd[i] for i in self._indices])

    def is_ordinary(self, time_min: float) -> bool:
        """True if the filter's newest row has this time, and no input of it was missing."""
        state, memory = self._filter.state, self._memory
        known = not any(memory.guessed) and not memory.held_rows and state.time_min == time_min
        return self._accept_all and known and state.inputs == memory.last_inputs

    @property
    def is_away(self) -> bool:
        """See `Reference`."""
        return self._free_run.is_away

    def set_learning(self, learning: bool) -> None:
        """Follow the plant in either case; beside it runs what follows nothing while nothing may be learned."""
        if not learning:
            self._free_run.start()
        else:
            self._free_run.stop()

    @property
    def numbers(self) -> tuple[Array, Array]:
        """Belief of the filter, and its variances: its own numbers, see `Filter`."""
        return self._filter.numbers

    def accept_row(self, time_min: float, inputs: tuple[float, ...]) -> None:
        """Note a row that a kernel has filtered in `numbers`."""
        self._memory.last_inputs = inputs
        self._filter.accept_row(time_min, inputs)
        self._free_run.add(self._filter, time_min, inputs)

    def _possible_changes(self, time_min: float, inputs: tuple[float, ...]) -> list[tuple[float, tuple[float, ...]]]:
        """Start of the time in which inputs are unknown, with each of their possible values.

        A row, or inputs of it, are missing. Empty: they were as before and after, or the filter starts with this row.
        """
        memory, before_min = self._memory, self._filter.state.time_min
        last, guessed = memory.last_inputs, any(memory.guessed)
        unknown = memory.guessed if guessed else (True,) * len(inputs)
        after = tuple(now if is_unknown else old for now, old, is_unknown in zip(inputs, last, unknown, strict=True))
        ends = {last, after}
        moving = [i for i, reach in enumerate(memory.reach) if reach and unknown[i]]
        if before_min is None or (len(ends) == 1 and not moving):
            return []
        possible = [
            self._within_bounds(end, i, by)
            for end in sorted(ends)
            for i in moving
            for by in (-memory.reach[i], memory.reach[i])
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
        self._free_run.forget()
        self._memory.guessed, self._memory.held_rows = self._all_known, 0

    def run(self, rows: RowArrays) -> Array:
        """Run over many rows; returns the normalised residuals, shape (n, outputs).

        The reach of the inputs is learned (`input_reach`). The filter restarts after missing rows.
        """
        memory, (time_min, inputs, measured) = self._memory, rows
        memory.reach = [input_reach(time_min, column) for column in inputs.T]
        if self._accept_all and np.isfinite(inputs).all():
            times = np.round(time_min * MINUTE_NS) / MINUTE_NS
            steps = self._filter.run(FilterRecord(times, _mask_before_missing(time_min, inputs), measured, GATE))
            z = steps.residual / steps.sd
            if not np.any(np.abs(z) > GATE):  # no acceptance depended on the row before
                memory.last_inputs, memory.guessed, memory.held_rows = tuple(inputs[-1].tolist()), self._all_known, 0
                memory.typical_sd = _median_sds(steps.sd)
                return z
            self._filter.restart()
        z, sds = np.full(measured.shape, np.nan), np.full(measured.shape, np.nan)
        accept, missing = (False,) * measured.shape[1], [0, *missing_in_intervals(time_min).tolist()]
        times_ns = np.round(time_min * MINUTE_NS).astype(np.int64).tolist()
        for i, (time_ns, given, values) in enumerate(zip(times_ns, inputs.tolist(), measured.tolist(), strict=True)):
            if missing[i]:
                self.restart()
            predicted = self.update(MeasuredRow(time_ns, tuple(given), values, [], NO_INTERVAL, False, []), accept)
            residual = [value - prediction for value, prediction in zip(values, predicted.prediction, strict=True)]
            sds[i] = predicted.sd
            z[i] = [size / sd for size, sd in zip(residual, predicted.sd, strict=True)]
            accept = tuple(abs(size) > GATE for size in z[i].tolist())
        memory.typical_sd = _median_sds(sds)
        return z


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def _compiled_filter(model: ProcessModel) -> CompiledFunction:
    """Machine code of the filter of a model, row by row."""
    return CompiledFunction(row_function(model))


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


def model_outputs(model: ProcessModel, outputs: tuple[str, ...], measured: Array) -> Array:
    """Columns of all outputs of the model; NaN for those that are not monitored."""
    columns = np.full((len(measured), len(model.outputs)), nan)
    columns[:, output_indices(model, outputs)] = measured
    return columns


def input_reach(time_min: Array, inputs: Array) -> float:
    """Largest pulse of an input that lasts one row: distance from the nearer of the rows before and after.

    It is 0 if each move lasts for two rows at least. Then the input of a missing row was that of a neighbour.
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
    rows: RowArrays,
    smallest_sd: list[float],
    uncertain: tuple[str, ...],
) -> NoiseFit:
    """Fit the noise of a plant and its sensors to its training."""
    columns, smallest = model_outputs(model, outputs, rows.outputs), [1e-6] * len(model.outputs)
    for i, sd in zip(output_indices(model, outputs), smallest_sd, strict=True):
        smallest[i] = sd
    wide, times = widen_model(model, uncertain), first_times(model, outputs, uncertain, rows)
    if times:
        wide = wide.with_values(times)
        # Rounding errors of more than some ten rows would take the place of what moves the plant.
        limits = {name: 3.0 * value for name, value in times.items() if name.endswith(".memory_min")}
        bounded = (replace(item, upper=limits.get(item.name, item.upper)) for item in wide.parameters)
        wide = replace(wide, parameters=tuple(bounded))
    starts = noise_starts(wide, columns, smallest)
    # Where a part of the noise has memory, only the rest is white. A sensor with less of it could pass for exact.
    white = [0.5 if f"{NOISE} {name}" in uncertain else 1.0 for name in model.output_names]
    return fit_noise(
        wide,
        FilterRecord(rows.time_min, _mask_before_missing(rows.time_min, rows.inputs), columns),
        [share * sd for share, sd in zip(white, smallest, strict=True)],
        learned_parameters(model, uncertain),
        nearby=starts.nearby,
        apart=starts.apart,
    )


def loudest_disturbances(
    model: ProcessModel, levels: NoiseLevels, outputs: tuple[str, ...], rows: RowArrays
) -> NoiseLevels:
    """The noise levels with the loudest disturbances that the training hardly tells from these.

    A training is a few time constants of what wanders slowly. Half of a disturbance that is understated is left in the
    residuals and adds up over many rows, and the promise is broken; one that is overstated costs a little power.
    """
    columns = model_outputs(model, outputs, rows.outputs)
    record = FilterRecord(rows.time_min, _mask_before_missing(rows.time_min, rows.inputs), columns, GATE)
    of_sensor = np.array([name.endswith(".memory") for name in model.state_names])
    sds = np.array(levels.process_sd)
    tried = [
        NoiseLevels(levels.measurement_sd, tuple(np.where(of_sensor, sds, size * sds).tolist()))
        for size in 1.1 ** np.arange(8.0)
    ]
    losses = np.array(losses_nearby(model, record, [1e-9] * len(model.outputs), tried))
    return tried[int(np.flatnonzero(losses <= losses[0] + 2.0)[-1])]  # as by Akaike's criterion


def first_times(
    model: ProcessModel, outputs: tuple[str, ...], uncertain: tuple[str, ...], rows: RowArrays
) -> dict[str, float]:
    """Time constants in minutes at which a search starts that depend on the rows, by name of the parameter.

    They are those of inputs that wander and of rounding errors.
    """
    period_min, found = float(np.median(np.diff(rows.time_min))), dict[str, float]()
    coarse = {f"{name}.memory_min" for name, column in zip(outputs, rows.outputs.T, strict=True) if is_coarse(column)}
    for name in learned_parameters(model, uncertain):
        if name.endswith(".wander_min"):
            found[name] = WANDER_ROWS * period_min
        elif name in coarse:
            found[name] = ROUNDING_ROWS * period_min
    return found
