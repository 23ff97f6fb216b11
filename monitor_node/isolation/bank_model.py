"""Model of a bank of filters: all causes in one model, whose inputs select the cause of each filter."""

from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import CompiledFunction
from reactorwatch.diagnosis.fitting.augmented_model import augment_model
from reactorwatch.kalman.ekf import NoiseLevels
from reactorwatch.kalman.ekf_step import MODEL_CACHE_SIZE, row_function
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel, variable

MOST_SHARE = 4.0
"""Largest relative size: that of the filter over that of the look's fit."""


@dataclass(frozen=True, eq=False)
class BankModel:
    """A process model with causes whose sizes are estimated, and its filter step.

    The last state is the relative size of the cause, a constant. After the inputs of the process come the interval mean
    and the sample value of each cause at a relative size of 1, then constants of the causes' own.

    Attributes:
        model: the model.
        step: `row_function` of the model, compiled for independent rows: one filter is one row.
        n_inputs: number of inputs of the process.
        inputs: inputs without a cause, shape (n_u,); those of the process are 0.
    """

    model: ProcessModel
    step: CompiledFunction
    n_inputs: int
    inputs: Array

    @property
    def n_states(self) -> int:
        """Number of states, the relative size included."""
        return len(self.model.states)

    def constants(self, noise: NoiseLevels) -> Array:
        """Parameters and variances, as the compiled step takes them."""
        variances = [*np.square(noise.measurement_sd).tolist(), *np.square(noise.process_sd).tolist(), 0.0]
        return np.array([*self.model.values().tolist(), *variances])


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def bank_model_of(model: ProcessModel, effects: tuple[Effect, ...]) -> BankModel:
    """Make the model of a bank for these causes; none may add states or shift the input timing."""
    augmented = augment_model(model, effects)
    share = variable("relative_size", "1", (0.0, MOST_SHARE), 1.0, "size relative to the fitted one")
    result = augmented.model
    for symbol in (*augmented.interval_inputs, *augmented.sample_inputs):
        result = result.substitute(symbol, symbol * share.symbol)
    result = replace(result, states=(*result.states, share), rhs=(*result.rhs, ca.SX(0)))
    constants = [value for item in augmented.nominal_constants for value in item]
    inputs = np.zeros(len(result.inputs))
    inputs[len(inputs) - len(constants) :] = constants
    return BankModel(result, CompiledFunction(row_function(result), shared=[2]), len(model.inputs), inputs)
