"""Fit of a hypothesis with its nuisance to a run, by damped Gauss-Newton steps (`fitting.descent`) in a trust region.

The loss is that of the whitened residual and of the priors. The logarithm of the evidence is Laplace's approximation,

    log E = -loss - log det(1 + S J'J S)/2,

J being the whitened derivatives and S the standard deviations of the priors.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.descent import descend
from reactorwatch.diagnosis.fitting.profiles import Signal
from reactorwatch.diagnosis.inexact.hypotheses import (
    CONSTANT,
    CURVE,
    CURVE_COST,
    KNOTS,
    NONE,
    ONSETS,
    WIDTH,
    Courses,
    Hypothesis,
    random_walk,
)
from reactorwatch.diagnosis.inexact.noise import Discrepancy
from reactorwatch.diagnosis.inexact.nuisance import Nuisance
from reactorwatch.diagnosis.inexact.simulation import Simulated

STEPS = 8
"""Steps of a fit."""

FARTHEST = 2.0
"""Radius of the trust region in standard deviations of the priors: further away the derivatives are others."""

LIKELY = 3.0
"""Distance in standard deviations of its prior within which a fit starts."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A hypothesis at its fit.

    Attributes:
        hypothesis: the hypothesis, with its fitted onset and size, and the evidence of the fit.
        theta: nuisance, shape (size,).
        curve: sizes at the knots of a curve, shape (KNOTS,); zeros for another profile.
        residual: residual at the kept rows, 0 where not measured, shape (kept rows, n_y).
        simulated: the simulation.
        size_sd: standard deviation of the size.
        onset_sd: standard deviation of the onset in minutes.
        theta_sd: standard deviation of the nuisance, shape (size,).
        derivatives: derivatives of the readings at the kept rows by all parameters, shape (kept rows, n_y, n).
        white: the same whitened.
        white_residual: whitened residual.
        information: information of all parameters, their priors included, shape (n, n).
        discrepancy: discrepancy with which it was fitted.
    """

    hypothesis: Hypothesis
    theta: Array
    curve: Array
    residual: Array
    simulated: Simulated
    size_sd: float
    onset_sd: float
    theta_sd: Array
    derivatives: Array
    white: Array
    white_residual: Array
    information: Array
    discrepancy: Discrepancy

    @property
    def log_evidence(self) -> float:
        """Logarithm of the evidence."""
        return self.hypothesis.log_evidence

    def log_evidence_with(self, discrepancy: Discrepancy) -> float:
        """The same with another discrepancy, the parameters and their share of the evidence as they are."""
        values, white = np.count_nonzero(self.residual, axis=0), discrepancy.whiten(self.residual)
        gained = values @ np.log(self.discrepancy.sd / discrepancy.sd)
        return self.log_evidence + float(gained + 0.5 * (np.sum(self.white_residual**2) - np.sum(white**2)))

    def residual_without(self, hidden: NDArray[np.bool_]) -> Array:
        """Residual at these of the kept rows of a fit to the others, by the derivatives of this fit."""
        part, unexplained = self.white[hidden].reshape(-1, len(self.information)), self.white_residual[hidden].ravel()
        # the fit ends where the gradient of all rows is 0, so without some of them it is theirs
        step = np.linalg.solve(self.information - part.T @ part, part.T @ unexplained)
        return np.asarray(self.residual[hidden] + self.derivatives[hidden] @ step)


@dataclass(frozen=True, eq=False)
class _Point:
    """Parameters of a fit, and what they give."""

    theta: Array
    own: Array
    loss: float
    residual: Array
    white: Array
    simulated: Simulated


class Fitter:
    """Fits hypotheses to the measured values at the kept rows.

    Args:
        nuisance: layout of the nuisance.
        courses: courses in time.
        widths: standard deviation of each nuisance that is a cause, by its index.
        measured: measured values at the kept rows, NaN where there is none, shape (kept rows, n_y).
    """

    def __init__(self, nuisance: Nuisance, courses: Courses, widths: dict[int, float], measured: Array) -> None:
        self._nuisance, self._courses, self._widths = nuisance, courses, widths
        self._measured, self._known = measured, np.isfinite(measured)
        self._hats = courses.hats()

    def fit(self, hypothesis: Hypothesis, theta: Array, noise: Discrepancy) -> Fitted | None:
        """Fit from a nuisance; None if the simulation diverges there.

        Args:
            hypothesis: what is fitted, with its expected onset and size.
            theta: nuisance from which the fit starts.
            noise: discrepancy and noise.
        """
        return _Fit(self, hypothesis, noise).climb(theta)

    def residual(self, theta: Array, simulated: Simulated) -> Array:
        """Measured values minus readings at the kept rows, 0 where not measured."""
        read = self._nuisance.read(simulated, theta)[self._nuisance.simulation.rows]
        return np.where(self._known, self._measured - read, 0.0)

    def mask(self, derivatives: Array) -> Array:
        """Derivatives at the kept rows, 0 where not measured."""
        return np.where(self._known[..., None], derivatives, 0.0)


class _Fit:
    """One fit of a hypothesis."""

    def __init__(self, fitter: Fitter, hypothesis: Hypothesis, noise: Discrepancy) -> None:
        self._fitter, self._hypothesis, self._noise = fitter, hypothesis, noise
        nuisance = self._nuisance = fitter._nuisance
        self._sds = nuisance.sds(hypothesis.prior)
        kind, index, courses = hypothesis.kind, hypothesis.effect, fitter._courses
        self._is_timed = kind not in (NONE, CONSTANT, CURVE)
        self._lower, self._upper, self._own_sds = np.zeros(0), np.zeros(0), np.zeros(0)
        if kind == CONSTANT:
            self._sds[index] = fitter._widths[index]
        elif kind == CURVE:
            self._walk = random_walk(float(nuisance.simulation.typical[index]))
            self._own_sds = np.ones(KNOTS)
            self._lower, self._upper = np.full(KNOTS, -np.inf), np.full(KNOTS, np.inf)
        elif self._is_timed:
            effect, times = nuisance.simulation.effects[index], courses.time_min
            self._own_sds = np.array([WIDTH * abs(effect.typical), courses.span_min / 12.0**0.5])
            self._lower = np.array([effect.lower - effect.neutral, times[0]])
            self._upper = np.array([effect.upper - effect.neutral, times[-1] - courses.period_min])
        self._all_sds = np.concatenate([self._sds, self._own_sds])
        self._last: tuple[_Point, tuple[Array, Array, Array, Array]] | None = None
        self._moves: Array | None = None  # derivatives by the times of the inputs' moves, once they are known

    def climb(self, theta: Array) -> Fitted | None:
        """Steps from a nuisance, and from a smaller size where the first diverges."""
        starts = [np.zeros(KNOTS)] if self._hypothesis.kind == CURVE else [np.zeros(0)]
        if self._is_timed:
            size, onset = self._hypothesis.size, self._hypothesis.onset
            starts = [np.clip([share * size, onset], self._lower, self._upper) for share in (1.0, 0.3, 0.0)]
        reach = LIKELY * self._sds  # a start that this prior excludes would cost all steps
        theta = np.clip(np.clip(theta, -reach, reach), self._nuisance.lower, self._nuisance.upper)
        point = next((item for own in starts if (item := self._evaluate(theta, own)) is not None), None)
        if point is None:
            return None
        best = descend(point, lambda item: self._normal_equations(item)[2:], self._move, STEPS)
        return self._result(best, *self._normal_equations(best)[:3])

    def _move(self, point: _Point, step: Array) -> _Point | None:
        """The point after a step in the trust region and within the bounds."""
        step = step * min(1.0, FARTHEST / max(float(np.max(np.abs(step / self._all_sds))), 1e-12))
        n = self._sds.size
        own = point.own + step[n:]
        if self._is_timed:  # the derivative by the onset holds only near it
            reach = 0.5 * self._fitter._courses.span_min / ONSETS
            own[1] = point.own[1] + np.clip(step[n + 1], -reach, reach)
        nuisance = self._nuisance
        theta = np.clip(point.theta + step[:n], nuisance.lower, nuisance.upper)
        return self._evaluate(theta, np.clip(own, self._lower, self._upper))

    def _deviation(self, own: Array) -> Signal | None:
        """Deviations of all effects; None without any."""
        if not own.size:
            return None
        hats, index = self._fitter._hats, self._hypothesis.effect
        if self._is_timed:
            course = self._fitter._courses.course(self._hypothesis.kind, float(own[1]))
            course = Signal(own[0] * course.interval_mean, own[0] * course.sample_value)
        else:
            sizes = self._walk @ own
            course = Signal(hats.interval_mean @ sizes, hats.sample_value @ sizes)
        is_cause = np.arange(self._nuisance.simulation.typical.size) == index
        return Signal(np.outer(course.interval_mean, is_cause), np.outer(course.sample_value, is_cause))

    def _evaluate(self, theta: Array, own: Array) -> _Point | None:
        simulated = self._nuisance.simulate(theta, self._deviation(own))
        if simulated is None:
            return None
        residual = self._fitter.residual(theta, simulated)
        residual = residual - self._moves_effect(theta)
        white = self._noise.whiten(residual)
        loss = 0.5 * float(np.sum(white**2)) + 0.5 * float(np.sum((theta / self._sds) ** 2))
        centred = own / self._own_sds if not self._is_timed else own[:1] / self._own_sds[:1]
        return _Point(theta, own, loss + 0.5 * float(np.sum(centred**2)), residual, white, simulated)

    def _moves_effect(self, theta: Array) -> Array:
        """Effect of the times of the inputs' moves, which is linear in them."""
        shares = theta[self._nuisance.moves]
        if self._moves is None or not np.any(shares):
            return np.zeros(1)
        return np.asarray(self._moves @ shares)

    def _normal_equations(self, point: _Point) -> tuple[Array, Array, Array, Array]:
        """Derivatives, the same whitened, information and gradient at a point; those of the last one are kept."""
        if self._last is not None and self._last[0] is point:
            return self._last[1]
        course = self._by_parameters(point.own)
        found = self._nuisance.linearise(point.theta, point.simulated, self._hypothesis.effect, course)
        masked = self._fitter.mask(found.derivatives)
        if self._moves is None:
            self._moves = masked[:, :, self._nuisance.moves].copy()
        white = self._noise.whiten(masked)
        flat = white.reshape(-1, white.shape[-1])
        information = flat.T @ flat + np.diag(self._all_sds**-2.0)
        deviations = np.concatenate([point.theta, point.own]) / self._all_sds**2
        if self._is_timed:
            deviations[-1] = 0.0
        result = masked, white, information, flat.T @ point.white.ravel() - deviations
        self._last = point, result
        return result

    def _by_parameters(self, own: Array) -> Signal | None:
        """Derivatives of the cause's deviation by each of its parameters, shape (rows, parameters), if any."""
        if not own.size:
            return None
        courses, hats = self._fitter._courses, self._fitter._hats
        if not self._is_timed:
            return Signal(hats.interval_mean @ self._walk, hats.sample_value @ self._walk)
        size, onset = own.tolist()
        one, other = (of(self._hypothesis.kind, onset) for of in (courses.course, courses.by_onset))
        mean = np.column_stack([one.interval_mean, size * other.interval_mean])
        return Signal(mean, np.column_stack([one.sample_value, size * other.sample_value]))

    def _result(self, point: _Point, derivatives: Array, white: Array, information: Array) -> Fitted:
        flat = white.reshape(-1, white.shape[-1])
        scaled = np.eye(self._all_sds.size) + self._all_sds[:, None] * (flat.T @ flat) * self._all_sds
        evidence = -point.loss - 0.5 * float(np.linalg.slogdet(scaled)[1])
        values = np.count_nonzero(self._fitter._known, axis=0)
        evidence -= float(values @ np.log(self._noise.sd)) + CURVE_COST * (self._hypothesis.kind == CURVE)
        sds = np.sqrt(np.maximum(np.diag(np.linalg.inv(information)), 0.0))
        hypothesis, n = self._hypothesis, self._sds.size
        curve, size_sd, onset_sd = np.zeros(KNOTS), 0.0, 0.0
        if hypothesis.kind == CONSTANT:
            hypothesis = hypothesis._replace(size=float(point.theta[hypothesis.effect]))
            size_sd = float(sds[hypothesis.effect])
        elif self._is_timed:
            hypothesis = hypothesis._replace(size=float(point.own[0]), onset=float(point.own[1]))
            size_sd, onset_sd = sds[n:].tolist()
        elif hypothesis.kind == CURVE:
            curve = self._walk @ point.own
            hypothesis = hypothesis._replace(size=float(curve[np.argmax(np.abs(curve))]))
        return Fitted(
            hypothesis._replace(log_evidence=evidence),
            point.theta,
            curve,
            point.residual,
            point.simulated,
            size_sd,
            onset_sd,
            sds[:n],
            derivatives,
            white,
            point.white,
            information,
            self._noise,
        )
