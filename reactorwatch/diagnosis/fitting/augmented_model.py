"""A model augmented with effects whose magnitudes are inputs, so that a deviation may have any course in time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import input_timing
from reactorwatch.diagnosis.fitting.profiles import Signal
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.kalman.error_dynamics import ErrorLinearization
from reactorwatch.process.effect import Effect, EffectConstant
from reactorwatch.process.model import MODEL_CACHE_SIZE, ProcessModel, Variable, variable


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
            shift grows (`input_timing`).
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
            columns += (input_timing.effective_timing(signal, time_min) if shifts else signal)[:2]
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
