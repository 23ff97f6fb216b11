"""Fit of a smooth correction inside the simulation, by damped Gauss-Newton steps from zero.

A filter without process noise is a simulation whose start is estimated from the first rows. Every step solves for all
coefficients at once, and keeps those functions that lower the BIC (forward selection, then backward elimination, on the
normal equations), so that a simple law is not beaten by a richer place.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import HUBER, FaultFilter, FilterEvaluation
from reactorwatch.diagnosis.fitting.profiles import Signal
from reactorwatch.diagnosis.law.shapes import Shape
from reactorwatch.diagnosis.run import Run
from reactorwatch.kalman.error_dynamics import ErrorDynamics

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
        ekf: filter of its model.
        coefficients: coefficients of its functions; 0 of those that are not needed.
        evaluation: run of the filter.
        bic: twice the loss plus the charge for the coefficients; noise levels are not charged.
    """

    shape: Shape
    ekf: FaultFilter
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
        self.ekf = FaultFilter(shape.model, shape.effects, noise, period_min)
        self._ones = np.ones((run.time_min.size - 2, 1))

    def evaluate(self, coefficients: Array, select: bool = True) -> ShapeFit:
        """Run the filter at these coefficients; with `select`, those that are 0 are not charged."""
        evaluation = self.ekf.evaluate(self._run, self.signals(coefficients))
        charged = np.count_nonzero(coefficients) if select else coefficients.size
        bic = 2.0 * evaluation.loss + charged * log(self._run.values)
        return ShapeFit(self.shape, self.ekf, coefficients, evaluation, float(bic))

    def fit(self, start: Array, noise: Noise, steps: int, select: bool = True) -> ShapeFit:
        """Fit the coefficients.

        Args:
            start: initial coefficients.
            noise: noise levels.
            steps: maximum number of steps.
            select: whether to keep only those functions that lower the BIC.
        """
        self.ekf.noise = noise
        best = self.evaluate(start, select)
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

    def dynamics(self, fit: ShapeFit) -> ErrorDynamics:
        """Error equations about a fit."""
        return self.ekf.error_dynamics(self._run, self.signals(fit.coefficients), fit.evaluation.innovations)

    def normal_equations(self, fit: ShapeFit) -> tuple[Array, Array]:
        """Information and gradient of all coefficients at a fit."""
        dynamics = self.dynamics(fit)
        columns = [
            signatures.forward_signatures(dynamics, index, self._ones, self._ones).reshape(-1)
            for index in range(fit.coefficients.size)
        ]
        g, w = np.column_stack(columns), np.nan_to_num(fit.evaluation.w[2:]).ravel()
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

    def signals(self, coefficients: Array) -> list[Signal]:
        """Coefficients as constant signals."""
        return self.constant_signals(coefficients, self._run)

    @staticmethod
    def constant_signals(values: Array, run: Run) -> list[Signal]:
        """Constant signals with these values."""
        return [Signal(column, column) for column in np.tile(values, (run.time_min.size, 1)).T]


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
    scale = np.sqrt(np.diag(inner))
    scaled = np.linalg.solve(inner / np.outer(scale, scale) + _RIDGE * np.eye(scale.size), right / scale)
    return scaled / scale, float(right @ (scaled / scale))
