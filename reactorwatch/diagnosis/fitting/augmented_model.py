"""A model augmented with effects whose magnitudes are inputs, so that a deviation may have any course in time.

The magnitude of an effect that shifts the input timing (`ProcessModel.time_offset`), as signals. The states depend on
the rate at which the shift grows, a row on its value. It grows no faster than time passes, for nothing acts before it
has set in: after a step the states first stand still for as long as the shift is large.

Measurement delay: the delayed values are shifted back to the time at which they were true. A delay line would cost a
filter many states. But a value that a sensor shows with a delay m is the one that a sensor without delay showed at t -
m. So the filter gets it there, as a row of its own between those of the other sensors. Its innovation counts for the
row in which it was recorded.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.profiles import Signal
from reactorwatch.diagnosis.run import Run, input_uncertainty_of
from reactorwatch.kalman.batch import FilterResult, InputUncertainty
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.kalman.error_dynamics import ErrorLinearization
from reactorwatch.process.effect import Effect, EffectConstant
from reactorwatch.process.model import MODEL_CACHE_SIZE, ProcessModel, Variable, variable


def effective_timing(signal: Signal, time_min: Array) -> Signal:
    """Split a timing offset into its rate, which acts on the states, and its value, which acts on the outputs.

    Args:
        signal: the magnitude in minutes, shape (rows,).
        time_min: times of the rows, shape (rows,).

    Returns:
        Rate over each interval in min/min, and value at each row in min.
    """
    ahead, step = np.maximum(signal.sample_value, 0.0), np.diff(time_min)
    rise = np.diff(ahead)
    # The mean over an interval with a jump gives the time since the jump.
    with np.errstate(divide="ignore", invalid="ignore"):
        since = step * np.clip((signal.interval_mean[:-1] - ahead[:-1]) / rise, 0.0, 1.0)
    for row in np.flatnonzero(rise > since).tolist():
        later, most = row + 1, ahead[row] + since[row]
        while later < ahead.size and ahead[later] > most:
            ahead[later] = most
            later, most = later + 1, most + step[min(later, step.size - 1)]
    return Signal(np.append(np.diff(ahead) / step, 0.0), ahead)


class ShiftedRun(NamedTuple):
    """A run with the values of one output shifted in time.

    Attributes:
        run: the run with more rows; its inputs include those that were given for every row.
        record_rows: positions of the record's rows, shape (rows,).
        delayed_rows: positions of the delayed values, shape (rows,).
        before_start: true if the value was true before the filter starts, so that it cannot be predicted, shape
            (rows,).
        uncertainty: intervals in which inputs changed at unknown times; None without any.
    """

    run: Run
    record_rows: NDArray[np.int64]
    delayed_rows: NDArray[np.int64]
    before_start: NDArray[np.bool_]
    uncertainty: InputUncertainty | None = None


def shift_measurements(run: Run, inputs: Array, held: NDArray[np.bool_], output: int, delay_min: Array) -> ShiftedRun:
    """Shift the values of a delayed output.

    Args:
        run: the record.
        inputs: inputs of every row, shape (rows, n).
        held: mask of inputs that are held from their row on; the others belong to their row's measurements.
        output: index of the delayed output.
        delay_min: delay in minutes, shape (rows,), at least 0.
    """
    rows = run.time_min.size
    begins = np.array([0, *run.breaks])
    begun_min = run.time_min[begins[np.searchsorted(begins, np.arange(rows), side="right") - 1]]
    true_min = run.time_min - np.maximum(delay_min, 0.0)
    before = true_min < begun_min
    true_min = np.maximum(true_min, begun_min)
    times, where = np.unique(np.concatenate([run.time_min, true_min]), return_inverse=True)
    prompt, late = where[:rows], where[rows:]
    source = np.clip(np.searchsorted(run.time_min, times, side="right") - 1, 0, rows - 1)
    spread = inputs[source]
    measured = np.full((times.size, run.measured.shape[1]), np.nan)
    for index in range(measured.shape[1]):
        measured[late if index == output else prompt, index] = run.measured[:, index]
    spread[late[:, None], np.flatnonzero(~held)] = inputs[:, ~held]
    uncertainty = input_uncertainty_of(run, spread, np.searchsorted(run.time_min, times, side="left"))
    return ShiftedRun(Run(times, spread, measured), prompt, late, before, uncertainty)


def restore_rows(innovations: FilterResult, by: ShiftedRun, output: int) -> FilterResult:
    """Rearrange a filter run of the shifted rows to the rows of the record."""
    items = [np.array(item[by.record_rows]) for item in innovations]
    for item, whole in zip(items[:5], innovations[:5], strict=True):
        item[:, output] = whole[by.delayed_rows, output]
    return FilterResult(*items)


@dataclass(frozen=True, eq=False)
class AugmentedModel:
    """A model with two more inputs for each effect.

    The interval mean acts on the balances, the sample value on the outputs. After these, the effects' own constants are
    inputs, too, the same in all rows.

    Attributes:
        model: the process model with the added inputs.
        interval_inputs: symbols of the interval means, one for each effect.
        sample_inputs: symbols of the sample values, one for each effect.
        shifts_time: for each effect, true if it shifts the timing; its interval input then is the rate at which the
            shift grows (`effective_timing`).
        constant_inputs: for each effect, the symbols of its own constants.
        nominal_constants: for each effect, their nominal values.
    """

    model: ProcessModel
    interval_inputs: tuple[ca.SX, ...]
    sample_inputs: tuple[ca.SX, ...]
    shifts_time: tuple[bool, ...]
    constant_inputs: tuple[tuple[ca.SX, ...], ...]
    nominal_constants: tuple[tuple[float, ...], ...]

    @property
    def n_effect_inputs(self) -> int:
        """Number of inputs that are not those of the process."""
        return 2 * len(self.interval_inputs) + sum(len(item) for item in self.constant_inputs)

    def constant_index(self, index: int) -> int:
        """Index of the first constant of an effect among the inputs of the error equations, after the magnitudes."""
        return len(self.interval_inputs) + sum(len(item) for item in self.constant_inputs[:index])

    @cached_property
    def errors(self) -> ErrorLinearization:
        """Equations of the filter's estimation errors with respect to the magnitudes, without noise levels."""
        unknown = NoiseLevels((1.0,) * len(self.model.outputs), (0.0,) * len(self.model.states))
        constants = tuple(symbol for item in self.constant_inputs for symbol in item)
        return ErrorLinearization(
            self.model, unknown, (*self.interval_inputs, *constants), (*self.sample_inputs, *constants)
        )

    def inputs(self, time_min: Array, inputs: Array, signals: Sequence[Signal]) -> Array:
        """Stack the record's inputs, the magnitudes and the constants, shape (rows, n_u + n_effect_inputs)."""
        columns, constants = [inputs], list[float]()
        for signal, shifts, nominal in zip(signals, self.shifts_time, self.nominal_constants, strict=True):
            columns += (effective_timing(signal, time_min) if shifts else signal)[:2]
            constants += signal.constants or nominal
        return np.column_stack([*columns, *(np.full(time_min.size, value) for value in constants)])


def _constant_input(name: str, item: EffectConstant) -> Variable:
    return variable(name, item.unit, (item.lower, item.upper), item.sd, item.meaning)


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def augment_model(model: ProcessModel, effects: tuple[Effect, ...]) -> AugmentedModel:
    """Add effects to a model with their magnitudes as inputs; cached with everything compiled from it.

    Args:
        model: the process model; must have what the effects act on.
        effects: effects in the order of the inputs to add.

    Raises:
        ValueError: the model lacks what an effect acts on.
    """
    interval_inputs, sample_inputs, shifts_time = [], [], []
    prefixes = []
    for number, effect in enumerate(effects, start=1):
        size = ca.SX.sym("size")
        prefixes.append(effect.prefix(model))
        extended = effect.apply(model, size)
        shifts_time.append(bool(ca.depends_on(extended.time_offset, size)))
        largest = max(abs(effect.lower), abs(effect.upper))  # a sine has both signs
        bounds = {"interval": np.inf if shifts_time[-1] else largest, "sample": largest}
        interval_input, sample_input = (
            variable(f"{effect.name}.{number}.{where}", effect.unit, (-bound, bound), effect.typical, effect.label)
            for where, bound in bounds.items()
        )
        ahead = ca.substitute(extended.time_offset, size, interval_input.symbol * model.clock.now)
        model = replace(extended.substitute(size, interval_input.symbol), time_offset=ahead)
        shown = extended.substitute(size, sample_input.symbol).outputs
        outputs = tuple(
            replace(item, expression=was.expression, noise_variance=was.noise_variance)
            for item, was in zip(model.outputs, shown, strict=True)
        )
        model = replace(model, outputs=outputs, inputs=(*model.inputs, interval_input, sample_input))
        interval_inputs.append(interval_input.symbol)
        sample_inputs.append(sample_input.symbol)
    constants = [
        tuple(_constant_input(f"{prefix}.{item.name}.constant", item) for item in effect.constants)
        for prefix, effect in zip(prefixes, effects, strict=True)
    ]
    for item in (item for added in constants for item in added):
        model = model.substitute(model.parameter(item.name.removesuffix(".constant")).symbol, item.symbol)
    return AugmentedModel(
        replace(model, inputs=(*model.inputs, *(item for added in constants for item in added))),
        tuple(interval_inputs),
        tuple(sample_inputs),
        tuple(shifts_time),
        tuple(tuple(item.symbol for item in added) for added in constants),
        tuple(tuple(item.value for item in effect.constants) for effect in effects),
    )
