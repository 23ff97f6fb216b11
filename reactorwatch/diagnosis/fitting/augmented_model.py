"""A model augmented with effects whose magnitudes are inputs, so that a deviation may have any course in time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import input_timing
from reactorwatch.diagnosis.fitting.profiles import Signal
from reactorwatch.kalman.ekf import NoiseLevels
from reactorwatch.kalman.ekf_step import MODEL_CACHE_SIZE
from reactorwatch.kalman.error_dynamics import ErrorLinearization
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel, variable


@dataclass(frozen=True, eq=False)
class AugmentedModel:
    """A model with two more inputs for each effect.

    The interval mean acts on the balances, the sample value on the outputs.

    Attributes:
        model: the process model with the added inputs.
        interval_inputs: symbols of the interval means, one for each effect.
        sample_inputs: symbols of the sample values, one for each effect.
        shifts_time: for each effect, true if it shifts the timing; its interval input then is the rate at which the
            shift grows (`input_timing`).
    """

    model: ProcessModel
    interval_inputs: tuple[ca.SX, ...]
    sample_inputs: tuple[ca.SX, ...]
    shifts_time: tuple[bool, ...]

    @cached_property
    def errors(self) -> ErrorLinearization:
        """Equations of the filter's estimation errors with respect to the magnitudes, without noise levels."""
        unknown = NoiseLevels((1.0,) * len(self.model.outputs), (0.0,) * len(self.model.states))
        return ErrorLinearization(self.model, unknown, self.interval_inputs, self.sample_inputs)

    def inputs(self, time_min: Array, inputs: Array, signals: Sequence[Signal]) -> Array:
        """Stack the record's inputs and the magnitudes, shape (rows, n_u + 2 effects)."""
        columns = [inputs]
        for signal, shifts in zip(signals, self.shifts_time, strict=True):
            columns += input_timing.effective_timing(signal, time_min) if shifts else signal
        return np.column_stack(columns)


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
    for number, effect in enumerate(effects, start=1):
        size = ca.SX.sym("size")
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
        outputs = tuple(
            replace(item, expression=ca.substitute(was.expression, size, sample_input.symbol))
            for item, was in zip(model.outputs, extended.outputs, strict=True)
        )
        model = replace(model, outputs=outputs, inputs=(*model.inputs, interval_input, sample_input))
        interval_inputs.append(interval_input.symbol)
        sample_inputs.append(sample_input.symbol)
    return AugmentedModel(model, tuple(interval_inputs), tuple(sample_inputs), tuple(shifts_time))
