"""Fit of a smooth correction inside the simulation, by damped Gauss-Newton steps from zero.

A filter without process noise is a simulation whose start is estimated from the first rows. Every step solves for all
coefficients at once, and keeps those functions that lower the BIC (forward selection, then backward elimination, on the
normal equations), so that a simple law is not beaten by a richer place.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import log

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import (
    HUBER,
    FaultFilter,
    FilterEvaluation,
    error_dynamics_between,
)
from reactorwatch.diagnosis.law.shapes import LARGEST, Shape
from reactorwatch.diagnosis.run import Run
from reactorwatch.kalman.ekf import NoiseLevels
from reactorwatch.kalman.ekf_step import MODEL_CACHE_SIZE
from reactorwatch.kalman.error_dynamics import ErrorDynamics, ErrorLinearization
from reactorwatch.process.model import ProcessModel

MOST_TERMS = 6
"""Largest number of functions of a correction."""

HALVINGS = 4
CONVERGED = 0.5
"""Gain in BIC below which a fit has converged."""

_RIDGE = 1e-9
_RUNAWAY = 1e100


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """A fitted correction.

    Attributes:
        shape: the shape.
        noise: noise levels of the fit.
        coefficients: coefficients of its functions; 0 of those that are not needed.
        evaluation: run of the filter.
        bic: twice the loss plus the charge for the coefficients; noise levels are not charged.
    """

    shape: Shape
    noise: Noise
    coefficients: Array
    evaluation: FilterEvaluation
    bic: float


class ShapeFitter:
    """Fits one correction to a run.

    Args:
        shape: the correction.
        run: the record.
        noise: noise levels.
    """

    def __init__(self, shape: Shape, run: Run, noise: Noise) -> None:
        self.shape, self._run = shape, run
        period_min = float(np.median(np.diff(run.time_min)))
        self.ekf = FaultFilter(shape.model, (), noise, period_min)
        if not run.breaks:  # a fit that loses an unstable plant is given up instead of started again in each row
            self.ekf.limit(None)
        self._first = np.array([shape.model.parameter(name).value for name in shape.parameters])
        self._errors = self._linearization(shape.parameters)

    def evaluate(self, coefficients: Array, select: bool = True) -> ShapeFit:
        """Run the filter at these coefficients; with `select`, those that are 0 are not charged."""
        self._use(coefficients)
        return self._fit_of(coefficients, self.ekf.evaluate(self._run, ()), select)

    def _fit_of(self, coefficients: Array, evaluation: FilterEvaluation, select: bool) -> ShapeFit:
        charged = np.count_nonzero(coefficients) if select else coefficients.size
        bic = 2.0 * evaluation.loss + charged * log(self._run.values)
        return ShapeFit(self.shape, self.ekf.noise, coefficients, evaluation, float(bic))

    def fit(
        self, start: Array, noise: Noise, steps: int, select: bool = True, first: FilterEvaluation | None = None
    ) -> ShapeFit:
        """Fit the coefficients.

        Args:
            start: initial coefficients.
            noise: noise levels.
            steps: maximum number of steps.
            select: whether to keep only those functions that lower the BIC.
            first: run of the filter at the initial coefficients, if it is known.
        """
        self.ekf.noise = noise
        best = self.evaluate(start, select) if first is None else self._fit_of(start, first, select)
        for _ in range(steps):
            target = self._target(best, select)
            if target is None:
                break
            before = best
            change = target - best.coefficients
            for halving in range(HALVINGS):
                trial = self.evaluate(best.coefficients + change * 0.5**halving if halving else target, select)
                if trial.bic < best.bic:
                    best = trial
                    break
            if before.bic - best.bic < CONVERGED:
                break
        return best

    def dynamics(self, fit: ShapeFit, further: Sequence[str] = ()) -> ErrorDynamics:
        """Error equations about a fit, for its coefficients and further parameters of the model."""
        self.ekf.noise = fit.noise
        errors = self._linearization((*self.shape.parameters, *further)) if further else self._errors
        errors.noise = self.ekf.noise_levels
        errors.changes = self.ekf.noise.parameter_changes | self._values(fit.coefficients)
        inputs, used = self.ekf.inputs(self._run, ()), self.ekf.used_values(self._run)
        return error_dynamics_between(errors, self._run, inputs, fit.evaluation.innovations, used)

    def _linearization(self, names: Sequence[str]) -> ErrorLinearization:
        return _linearization(self.ekf.model, tuple(names)).with_noise(self.ekf.noise_levels)

    def estimate_noise(self, fit: ShapeFit, noise: Noise, smallest_sd: Sequence[float]) -> Noise:
        """Noise levels under a fit by maximum likelihood; `noise` has the sensors with coloured noise."""
        self.ekf.noise = noise
        extended = self.shape.model.with_values(self._values(fit.coefficients))
        ekf = FaultFilter(extended, (), noise, float(np.median(np.diff(self._run.time_min))))
        return ekf.estimate_noise(self._run, (), smallest_sd)

    def _use(self, coefficients: Array) -> None:
        self.ekf.set_changes(self._values(coefficients))

    def _values(self, coefficients: Array) -> dict[str, float]:
        values = np.clip(self._first + coefficients, -LARGEST, LARGEST)
        return {**self.shape.scales, **dict(zip(self.shape.parameters, values.tolist(), strict=True))}

    def normal_equations(self, fit: ShapeFit) -> tuple[Array, Array]:
        """Information and gradient of all coefficients at a fit."""
        g = signatures.constant_signatures(self.dynamics(fit), fit.coefficients.size)
        w = np.nan_to_num(fit.evaluation.w[2:]).ravel()
        weights = HUBER / np.maximum(np.abs(w), HUBER)
        return g.T @ (g * weights[:, None]), g.T @ (weights * w)

    def _target(self, fit: ShapeFit, select: bool) -> Array | None:
        information, gradient = self.normal_equations(fit)
        if not np.all(np.isfinite(information)) or np.max(np.abs(information)) > _RUNAWAY:
            return None
        by = gradient + information @ fit.coefficients
        chosen = select_terms(information, by, log(self._run.values)) if select else list(range(by.size))
        result = np.zeros(by.size)
        if chosen:
            result[chosen] = _solve(information, by, chosen)[0]
        return result


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def _linearization(model: ProcessModel, names: tuple[str, ...]) -> ErrorLinearization:
    """Error equations of a model for some of its parameters; cached with what is compiled from them."""
    symbols = [model.parameter(name).symbol for name in names]
    unknown = NoiseLevels((1.0,) * len(model.outputs), (0.0,) * len(model.states))
    return ErrorLinearization(model, unknown, symbols, symbols)


def select_terms(information: Array, by: Array, charge: float) -> list[int]:
    """Functions that lower the BIC most: forward selection, then backward elimination.

    Args:
        information: information of all coefficients.
        by: information times the coefficients that fit best.
        charge: charge for a coefficient.
    """
    remaining, chosen, gain = set(np.flatnonzero(np.diag(information) > 0.0).tolist()), list[int](), 0.0
    while remaining and len(chosen) < MOST_TERMS:
        gains = {item: _solve(information, by, [*chosen, item])[1] for item in remaining}
        best = max(gains, key=lambda item: gains[item])
        if gains[best] - gain < charge:
            break
        gain = gains[best]
        chosen.append(best)
        remaining.remove(best)
    while len(chosen) > 1:
        without = {item: _solve(information, by, [other for other in chosen if other != item])[1] for item in chosen}
        worst = max(without, key=lambda item: without[item])
        if gain - without[worst] > charge:
            break
        gain = without[worst]
        chosen.remove(worst)
    return sorted(chosen)


def _solve(information: Array, by: Array, chosen: Sequence[int]) -> tuple[Array, float]:
    """Coefficients of some functions, and by how much they lower twice the loss."""
    inner, right = information[np.ix_(chosen, chosen)], by[list(chosen)]
    scale = np.sqrt(np.maximum(np.diag(inner), 1e-300))
    scaled = np.linalg.solve(inner / np.outer(scale, scale) + _RIDGE * np.eye(scale.size), right / scale)
    return scaled / scale, float(right @ (scaled / scale))
