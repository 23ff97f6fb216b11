"""A forcing with unknown course: an effect whose magnitude follows none of the usual profiles.

Its magnitude is a smooth function of the variables in the effect's own terms, plus red noise in time (an
Ornstein-Uhlenbeck process). Where a term depends on an input, the noise may instead change only as the input moves, for
what happens to an input on its way depends on the input. The function is piecewise linear; its knot values have a
Gaussian prior whose covariance falls with distance (Rasmussen & Williams 2006, Gaussian Processes for Machine Learning,
ch. 2, 4 and 5). So one number, the marginal likelihood, says how well a forcing explains a run, and charges it for its
flexibility; and every forcing has the same few hyperparameters (`Levels`).

The function may depend on the variables of its own terms alone: the feed does not know the reactor's temperature, but
the heat removed by the coolant depends on it. This separates locations that act on the same state.

Everything is linearised about a path of the states, then about the path that results; a few rounds give the most likely
path (Bell 1994, The iterated Kalman smoother as a Gauss-Newton method, SIAM J. Optimization 4).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.augmented_model import AugmentedModel, augment_model
from reactorwatch.diagnosis.fitting.profiles import Signal, hat_functions
from reactorwatch.diagnosis.run import Run, input_uncertainty_of
from reactorwatch.diagnosis.unknown_input.smoother import PathModel, normalize_columns, smooth
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel

KNOTS = 10
LENGTH = 0.4
"""Length scale of the function, as a fraction of its argument's range."""

STRAIGHT = 4.0
"""Variance of the function's slope over the range; the variance of its curved part is 1."""

FUNCTION_SIZES = np.exp(np.arange(-9.0, 7.0, 0.5))
"""Standard deviations of the function, in typical magnitudes of the effect."""

_RUNAWAY = 1e12


@dataclass(frozen=True)
class Levels:
    """Hyperparameters of a forcing.

    Attributes:
        red: standard deviation of the red noise, in typical magnitudes of the effect.
        lasts_min: time constant of the red noise, by its clock.
        sensor_sd: standard deviation of the sensors' noise, one for each output.
        clock: index among the clocks of `LinearisedForcing`.
    """

    red: float
    lasts_min: float
    sensor_sd: tuple[float, ...]
    clock: int = 0


@dataclass(frozen=True, eq=False)
class ForcingFit:
    """Fit of a forcing to a run.

    Attributes:
        loss: negative log marginal likelihood, up to the constant common to all hypotheses.
        levels: hyperparameters of the forcing.
        terms: coefficients of the function's terms, in typical magnitudes of the effect.
    """

    loss: float
    levels: Levels
    terms: Array


@dataclass(frozen=True, eq=False)
class ReferenceTrajectory:
    """A path to linearise about, with the run's fixed data.

    Attributes:
        x: states along the path, shape (rows, n_x).
        size: magnitude of the forcing along the path.
        process_sd: standard deviation of the process noise, one for each state.
        known: mask of values that are used, shape (rows, n_y).
        restarts: rows at which the filter restarts, shape (rows,).
        start: initial states at these rows, shape (rows, n_x).
        start_covariance: covariance of the states, shape (rows, n_x, n_x).
    """

    x: Array
    size: Signal
    process_sd: Array
    used: NDArray[np.bool_]
    restarts: NDArray[np.bool_]
    start: Array
    start_covariance: Array


class Forcing:
    """An effect with a magnitude of unknown course.

    Args:
        model: process model of the plant.
        effect: effect without internal states.

    Attributes:
        effect: the effect as given.
        dependencies: indices, among states and inputs, of the variables in its terms.
    """

    def __init__(self, model: ProcessModel, effect: Effect) -> None:
        self.effect = effect
        self._augmented = augment_model(model, (effect,))
        self.dependencies = tuple(_dependencies(self._augmented))
        self._errors = self._augmented.errors  # a path has no noise

    def linearise(self, reference: ReferenceTrajectory, run: Run) -> "LinearisedForcing":
        """Linearise the forcing about a path."""
        inputs = self._augmented.inputs(run.time_min, run.inputs, [reference.size])
        path = self._errors.along(run.time_min, inputs, reference.x, input_uncertainty_of(run, inputs))
        rows, n_x = reference.x.shape
        F, G, D = np.zeros((rows, n_x, n_x)), np.zeros((rows, n_x)), path.D[:, :, 0]
        F[1:], G[1:] = path.F, path.G[:, :, 0]
        step_min = np.diff(run.time_min, prepend=run.time_min[0])
        clocks = [
            step_min,
            *(_ticks(run.inputs[:, index - n_x], run.span_min) for index in self.dependencies if index >= n_x),
        ]
        linear = PathModel(
            F,
            G,
            path.H,
            D,
            np.square(reference.process_sd) * step_min[:, None]
            + np.square(np.vstack([np.zeros(n_x), path.predicted_sd])),
            reference.used,
            reference.restarts,
            reference.start - reference.x,
            reference.start_covariance,
        )
        terms, covariance = self._terms(run, reference.x)
        over_way = np.concatenate([np.zeros((1, terms.interval_mean.shape[1])), terms.interval_mean[:-1]])
        offset = np.zeros((rows, n_x, 1 + over_way.shape[1]))
        offset[1:, :, 0] = path.predicted - reference.x[1:] - G[1:] * reference.size.interval_mean[:-1, None]
        offset[:, :, 1:] = G[:, :, None] * over_way[:, None, :]
        seen = np.empty((rows, D.shape[1], offset.shape[2]))
        seen[:, :, 0] = np.nan_to_num(run.measured - path.outputs + D * reference.size.sample_value[:, None])
        seen[:, :, 1:] = -D[:, :, None] * terms.sample_value[:, None, :]
        return LinearisedForcing(
            linear, offset, seen, tuple(clocks), terms, np.asarray(np.linalg.cholesky(covariance)), self.effect
        )

    def _terms(self, run: Run, x: Array) -> tuple[Signal, Array]:
        """Terms of the function along a path at typical magnitude, and the covariance of their coefficients."""
        z = np.column_stack([x, run.inputs])
        after = np.vstack([z[1:], z[-1:]])
        after[:, x.shape[1] :] = z[:, x.shape[1] :]  # inputs are held
        ones = np.ones((len(z), 1))
        interval_mean, sample_value, count = [ones], [ones], 1
        for index in self.dependencies:
            low, high = float(np.min(z[:, index])), float(np.max(z[:, index]))
            if high > low:
                now, then = (hat_functions((item[:, index] - low) / (high - low), KNOTS) for item in (z, after))
                interval_mean.append(0.5 * (now + then))
                sample_value.append(now)
                count += KNOTS
        covariance = np.eye(count)
        for begin in range(1, count, KNOTS):
            covariance[begin : begin + KNOTS, begin : begin + KNOTS] = _bending_covariance()
        typical = self.effect.typical
        return Signal(
            typical * np.concatenate(interval_mean, axis=1), typical * np.concatenate(sample_value, axis=1)
        ), covariance


@dataclass(frozen=True, eq=False)
class LinearisedForcing:
    """A forcing linearised about a path; `smoother` explains `linear`, `offset` and `seen`.

    Attributes:
        clocks: increments of each clock, shape (rows,); the first clock is time, inputs move the others.
        terms: terms of the function.
        root: Cholesky factor of the covariance of their coefficients.
        effect: the effect.
    """

    linear: PathModel
    offset: Array
    seen: Array
    clocks: tuple[Array, ...]
    terms: Signal
    root: Array
    effect: Effect

    def fit(self, levels: Levels) -> ForcingFit:
        """Fit the function at these hyperparameters, its standard deviation included."""
        w, logs = normalize_columns(self.linear, *self._red_noise(levels), self.offset, self.seen)
        w = w.reshape(-1, w.shape[2])
        gram = w.T @ w
        if not np.all(np.isfinite(gram)) or gram[0, 0] > _RUNAWAY:
            return ForcingFit(inf, levels, np.zeros(len(self.root)))
        values, vectors = np.linalg.eigh(self.root.T @ gram[1:, 1:] @ self.root)
        by, sizes = -vectors.T @ (self.root.T @ gram[1:, 0]), FUNCTION_SIZES[:, None]
        spread = 1.0 + sizes**2 * np.maximum(values, 0.0)
        losses = 0.5 * np.sum(np.log(spread) - sizes**2 * by**2 / spread, axis=1) + 0.5 * gram[0, 0] + logs
        best = int(np.argmin(losses))
        terms = self.root @ (vectors @ (sizes[best] ** 2 * by / spread[best]))
        return ForcingFit(float(losses[best]), levels, terms)

    def smooth_path(self, fitted: ForcingFit) -> tuple[Array, Signal]:
        """Deviation of the most likely path from this one, and the magnitude of the forcing along it."""
        offset, seen = (item[:, :, 0] + item[:, :, 1:] @ fitted.terms for item in (self.offset, self.seen))
        d, red = smooth(self.linear, *self._red_noise(fitted.levels), offset, seen)
        bounds = (self.effect.lower, self.effect.upper)
        interval_mean, sample_value = (np.clip(item @ fitted.terms + red, *bounds) for item in self.terms[:2])
        return d, Signal(interval_mean, sample_value)

    def _red_noise(self, levels: Levels) -> tuple[Array, Array, float]:
        sd = levels.red * self.effect.typical
        return np.square(levels.sensor_sd), np.exp(-self.clocks[levels.clock] / levels.lasts_min), sd * sd


def _ticks(values: Array, span_min: float) -> Array:
    """Clock that advances with an input's movement, scaled to the record's span."""
    moved = np.abs(np.diff(values, prepend=values[0]))
    return np.asarray(moved * (span_min / max(float(np.sum(moved)), 1e-300)))


def _bending_covariance() -> Array:
    """Prior covariance of the function at its knots: Matern 3/2 plus a straight line."""
    knots = np.linspace(0.0, 1.0, KNOTS)
    apart = np.sqrt(3.0) * np.abs(knots[:, None] - knots) / LENGTH
    return np.asarray((1.0 + apart) * np.exp(-apart) + STRAIGHT * np.outer(knots - 0.5, knots - 0.5))


def _dependencies(augmented: AugmentedModel) -> Sequence[int]:
    """Indices of the plant's states and inputs, in this order, that the effect's terms depend on."""
    model, interval_input, seen = augmented.model, augmented.interval_inputs[0], augmented.sample_inputs[0]
    terms = [ca.substitute(ca.jacobian(ca.vertcat(*model.rhs), interval_input), interval_input, 0)]
    for output in model.outputs:
        by = ca.jacobian(output.expression, seen)
        if by.nnz():  # a sensor's error may depend on what it measures
            terms += [by, output.expression]
    symbols = [item.symbol for item in (*model.states, *model.inputs[: -augmented.n_effect_inputs])]
    return [index for index, symbol in enumerate(symbols) if any(ca.depends_on(term, symbol) for term in terms)]
