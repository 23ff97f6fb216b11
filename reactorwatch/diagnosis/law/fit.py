"""Fit of a smooth correction inside the simulation, by damped Gauss-Newton steps (`fitting.descent`) from zero.

Every step keeps those functions that lower the BIC (forward selection, then backward elimination, on the normal
equations), so that a simple law is not beaten by a richer place.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import log

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.descent import NEARLY_LINEAR, Equations, descend
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter, FilterEvaluation
from reactorwatch.diagnosis.fitting.simulation import FittedSimulation, linearize
from reactorwatch.diagnosis.law.shapes import LARGEST, Shape
from reactorwatch.diagnosis.run import Run
from reactorwatch.kalman.error_dynamics import ErrorDynamics
from reactorwatch.process.model import MODEL_CACHE_SIZE, Place

MOST_TERMS = 6
"""Largest number of functions of a correction."""

_linearize_shape = lru_cache(maxsize=MODEL_CACHE_SIZE)(linearize)  # shapes are made once for a model and a place

_RIDGE = 1e-9


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """A fitted correction.

    Attributes:
        fitter: fitter of its shape, for other noise levels.
        noise: noise levels of the fit.
        coefficients: coefficients of its functions; 0 of those that are not needed.
        evaluation: run of the filter.
        bic: twice the loss plus the charge for the coefficients; noise levels are not charged.
    """

    fitter: "ShapeFitter"
    noise: Noise
    coefficients: Array
    evaluation: FilterEvaluation
    bic: float

    @property
    def loss(self) -> float:
        """Half of the BIC, which a fit lowers."""
        return 0.5 * self.bic

    @property
    def shape(self) -> Shape:
        """Shape of the correction."""
        return self.fitter.shape

    @property
    def place(self) -> Place:
        """Place of the correction."""
        return self.shape.place

    @property
    def lag_min(self) -> float:
        """Time constant with which the correction lags behind its variables; 0: none."""
        return self.shape.lag_min(self.coefficients)


class ShapeFitter:
    """Fits one correction to a run.

    Args:
        shape: the correction.
        run: the record.
        noise: noise levels.
    """

    def __init__(self, shape: Shape, run: Run, noise: Noise) -> None:
        self.shape, self._run = shape, run
        self._simulation = FittedSimulation(shape.model, shape.parameters, run, noise, _linearize_shape)
        self._first = np.array([shape.model.parameter(name).value for name in shape.parameters])

    def evaluate(self, coefficients: Array, select: bool = True) -> ShapeFit:
        """Run the filter at these coefficients; with `select`, those that are 0 are not charged."""
        return self._fit_of(coefficients, self._simulation.evaluate(self._values(coefficients)), select)

    def _fit_of(self, coefficients: Array, evaluation: FilterEvaluation, select: bool) -> ShapeFit:
        charged = np.count_nonzero(coefficients) if select else coefficients.size
        bic = 2.0 * evaluation.loss + charged * log(self._run.values)
        return ShapeFit(self, self._simulation.ekf.noise, coefficients, evaluation, float(bic))

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
        self._simulation.ekf.noise = noise
        dropped = np.full(start.size, select)

        def equations(fit: ShapeFit) -> Equations:
            information, gradient = self.normal_equations(fit)
            if select and np.all(np.isfinite(information)):
                by = gradient + information @ fit.coefficients
                dropped[:] = True
                dropped[select_terms(information, by, log(self._run.values))] = False
                # A function that is not worth its charge goes back to zero, independently of all others.
                separate = np.logical_or.outer(dropped, dropped)
                information = np.where(separate, np.diag(np.diag(information)), information)
                gradient = np.where(dropped, 0.0, by) - information @ fit.coefficients
            return information, gradient

        def move(fit: ShapeFit, step: Array) -> ShapeFit:
            return self.evaluate(np.where(dropped, 0.0, fit.coefficients + step), select)

        point = self.evaluate(start, select) if first is None else self._fit_of(start, first, select)
        return descend(point, equations, move, steps, dampings=NEARLY_LINEAR)

    def dynamics(self, fit: ShapeFit, further: Sequence[str] = ()) -> ErrorDynamics:
        """Error equations about a fit, for its coefficients and further parameters of the model."""
        self._simulation.ekf.noise = fit.noise
        return self._simulation.dynamics(self._values(fit.coefficients), fit.evaluation, further)

    def normal_equations(self, fit: ShapeFit) -> tuple[Array, Array]:
        """Information and gradient of all coefficients at a fit."""
        self._simulation.ekf.noise = fit.noise
        return self._simulation.normal_equations(self._values(fit.coefficients), fit.evaluation)

    def estimate_noise(self, fit: ShapeFit, noise: Noise, smallest_sd: Sequence[float]) -> Noise:
        """Noise levels under a fit by maximum likelihood; `noise` has the sensors with coloured noise."""
        extended = self.shape.model.with_values(self._values(fit.coefficients))
        return FaultFilter(extended, (), noise, self._run.period_min).estimate_noise(self._run, (), smallest_sd)

    def _values(self, coefficients: Array) -> dict[str, float]:
        values = np.clip(self._first + coefficients, -LARGEST, LARGEST)
        return {**self.shape.scales, **dict(zip(self.shape.parameters, values.tolist(), strict=True))}


def select_terms(information: Array, by: Array, charge: float) -> list[int]:
    """Functions that lower the BIC most: forward selection, then backward elimination.

    Args:
        information: information of all coefficients.
        by: information times the coefficients that fit best.
        charge: charge for a coefficient.
    """
    remaining, chosen, gain = set(np.flatnonzero(np.diag(information) > 0.0).tolist()), list[int](), 0.0
    while remaining and len(chosen) < MOST_TERMS:
        gains = {item: _gain(information, by, [*chosen, item]) for item in remaining}
        best = max(gains, key=lambda item: gains[item])
        if gains[best] - gain < charge:
            break
        gain = gains[best]
        chosen.append(best)
        remaining.remove(best)
    while len(chosen) > 1:
        without = {item: _gain(information, by, [other for other in chosen if other != item]) for item in chosen}
        worst = max(without, key=lambda item: without[item])
        if gain - without[worst] > charge:
            break
        gain = without[worst]
        chosen.remove(worst)
    return sorted(chosen)


def _gain(information: Array, by: Array, chosen: Sequence[int]) -> float:
    """Reduction of twice the loss by some functions."""
    inner, right = information[np.ix_(chosen, chosen)], by[list(chosen)]
    scale = np.sqrt(np.maximum(np.diag(inner), 1e-300))
    scaled = np.linalg.solve(inner / np.outer(scale, scale) + _RIDGE * np.eye(scale.size), right / scale)
    return float(right @ (scaled / scale))
