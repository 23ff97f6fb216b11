"""A model in which the sizes of some effects are inputs, so that a deviation may have any course in time."""

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
class SizedModel:
    """A model with two inputs an effect: the size that the balances feel, and the one that the outputs show.

    Attributes:
        model: the process.
        rate_symbols: the symbols of the first, one an effect.
        output_symbols: those of the second.
        moves_clock: of each effect, whether it does, so that the first is how fast the size grows (`input_timing`).
    """

    model: ProcessModel
    rate_symbols: tuple[ca.SX, ...]
    output_symbols: tuple[ca.SX, ...]
    moves_clock: tuple[bool, ...]

    @cached_property
    def errors(self) -> ErrorLinearization:
        """The equations of its filter's errors with respect to the sizes; its noise is to be given."""
        unknown = NoiseLevels((1.0,) * len(self.model.outputs), (0.0,) * len(self.model.states))
        return ErrorLinearization(self.model, unknown, self.rate_symbols, self.output_symbols)

    def inputs(self, time_min: Array, inputs: Array, signals: Sequence[Signal]) -> Array:
        """The inputs of a record with the sizes beside them, shape (rows, n_u + 2 effects)."""
        shifts = zip(signals, self.moves_clock, strict=True)
        felt = [input_timing.felt(signal, time_min) if moves else signal for signal, moves in shifts]
        return np.column_stack([inputs, *(item for signal in felt for item in signal)])


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def with_size_inputs(model: ProcessModel, effects: tuple[Effect, ...]) -> SizedModel:
    """The model with the effects in it, their sizes as inputs; kept, with what is compiled from it.

    Args:
        model: any that has what the effects act on.
        effects: in the order of the inputs to be.

    Raises:
        ValueError: the model lacks what an effect acts on.
    """
    rate_symbols, output_symbols, moves_clock = [], [], []
    for number, effect in enumerate(effects, start=1):
        size = ca.SX.sym("size")
        extended = effect.apply(model, size)
        moves_clock.append(bool(ca.depends_on(extended.time_offset, size)))
        largest = max(abs(effect.lower), abs(effect.upper))  # bounds are those of a size; a sine swings about zero
        bounds = {"felt": np.inf if moves_clock[-1] else largest, "seen": largest}
        felt, seen = (
            variable(f"{effect.name}.{number}.{where}", effect.unit, (-bound, bound), effect.typical, effect.label)
            for where, bound in bounds.items()
        )
        ahead = ca.substitute(extended.time_offset, size, felt.symbol * model.clock.now)
        model = replace(extended.substitute(size, felt.symbol), time_offset=ahead)
        outputs = tuple(
            replace(item, expression=ca.substitute(was.expression, size, seen.symbol))
            for item, was in zip(model.outputs, extended.outputs, strict=True)
        )
        model = replace(model, outputs=outputs, inputs=(*model.inputs, felt, seen))
        rate_symbols.append(felt.symbol)
        output_symbols.append(seen.symbol)
    return SizedModel(model, tuple(rate_symbols), tuple(output_symbols), tuple(moves_clock))
