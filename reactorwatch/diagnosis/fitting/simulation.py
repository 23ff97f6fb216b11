"""Simulation whose parameters are fitted: its errors, and their normal equations.

A filter without process noise is a simulation whose start is estimated from the first rows.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import TypeAlias

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import (
    FaultFilter,
    FilterEvaluation,
    error_dynamics_between,
    huber_weights,
)
from reactorwatch.diagnosis.run import Run
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.kalman.error_dynamics import ErrorDynamics, ErrorLinearization
from reactorwatch.process.model import ProcessModel

Linearize: TypeAlias = Callable[[ProcessModel, tuple[str, ...]], ErrorLinearization]


class FittedSimulation:
    """Filter of one run by a model of which some parameters are fitted.

    Args:
        model: process model with the parameters.
        names: names of the fitted parameters.
        run: the record.
        noise: noise levels.
        linearize_cached: cached form of `linearize`, for models that are used again; None: kept for this object.

    Attributes:
        names: names of the fitted parameters.
        run: the record.
        ekf: the filter.
    """

    def __init__(
        self,
        model: ProcessModel,
        names: Sequence[str],
        run: Run,
        noise: Noise,
        linearize_cached: Linearize | None = None,
    ) -> None:
        self.names, self.run = tuple(names), run
        self._linearize = linearize_cached or lru_cache(linearize)
        self.ekf = FaultFilter(model, (), noise, run.period_min)
        if not run.breaks:  # a fit that loses an unstable plant is given up instead of started again in each row
            self.ekf.limit(None)

    def evaluate(self, values: Mapping[str, float]) -> FilterEvaluation:
        """Run the filter at these values of parameters."""
        self.ekf.set_changes(values)
        return self.ekf.evaluate(self.run, ())

    def dynamics(
        self, values: Mapping[str, float], evaluation: FilterEvaluation, further: Sequence[str] = ()
    ) -> ErrorDynamics:
        """Error equations about a run of the filter, for the fitted parameters and further ones of the model."""
        errors = self._linearize(self.ekf.model, (*self.names, *further)).with_noise(self.ekf.noise_levels)
        errors.changes = self.ekf.noise.parameter_changes | dict(values)
        inputs, used = self.ekf.inputs(self.run, ()), self.ekf.used_values(self.run)
        return error_dynamics_between(errors, self.run, inputs, evaluation.innovations, used)

    def normal_equations(self, values: Mapping[str, float], evaluation: FilterEvaluation) -> tuple[Array, Array]:
        """Information and gradient of the fitted parameters about a run of the filter."""
        g = signatures.constant_signatures(self.dynamics(values, evaluation), len(self.names))
        w = np.nan_to_num(evaluation.w[2:]).ravel()
        weights = huber_weights(w)
        return g.T @ (g * weights[:, None]), g.T @ (weights * w)


def linearize(model: ProcessModel, names: tuple[str, ...]) -> ErrorLinearization:
    """Error equations of a model for some of its parameters."""
    symbols = [model.parameter(name).symbol for name in names]
    unknown = NoiseLevels((1.0,) * len(model.outputs), (0.0,) * len(model.states))
    return ErrorLinearization(model, unknown, symbols, symbols)
