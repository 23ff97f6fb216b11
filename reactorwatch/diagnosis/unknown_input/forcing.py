"""A forcing of unknown course: an effect whose size is neither a number nor one of the usual courses in time.

Its size is a smooth function of what the effect's own terms depend on, plus red noise in time (an Ornstein-Uhlenbeck
process); where its terms depend on an input, the noise may be renewed as that moves, and else stay, for what becomes of
an input on its way becomes of it then. The function is straight between knots; its values there are normal beforehand,
with a covariance that falls with the distance between knots (Rasmussen & Williams 2006, Gaussian Processes for Machine
Learning, ch. 2, 4 and 5). So how well a forcing explains a run is one number, its marginal likelihood, which charges by
itself for how much it may bend; and every forcing has the same few numbers to choose (`Levels`).

A size may depend on its own terms alone, else something would be between them: what the feed brings does not know how
hot the reactor is, what the coolant takes away does. This tells places apart that push the same state.

All is linear about a path through the states. About the path that follows from it, it is so again, and after a few
rounds that is the likeliest one (Bell 1994, The iterated Kalman smoother as a Gauss-Newton method, SIAM J.
Optimization 4).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.augmented_model import SizedModel, with_size_inputs
from reactorwatch.diagnosis.fitting.profiles import Signal, hats
from reactorwatch.diagnosis.run import Run, doubt_of
from reactorwatch.diagnosis.unknown_input.smoother import Linear, smoothed, whitened
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel

KNOTS = 10
LENGTH = 0.4
"""Over which a function turns, as a share of the range of what it depends on."""

STRAIGHT = 4.0
"""Variance of a function's slope over the range, where that of what bends is 1."""

FUNCTION_SIZES = np.exp(np.arange(-9.0, 7.0, 0.5))
"""In typical sizes of the effect."""

_RUNAWAY = 1e12


@dataclass(frozen=True)
class Levels:
    """The numbers that a forcing has besides its course.

    Attributes:
        red: standard deviation of the red noise, in typical sizes of the effect.
        lasts_min: how long it remembers, by its clock.
        sensor_sd: of the sensors' noise, one an output.
        clock: which of the clocks of `Linearised`.
    """

    red: float
    lasts_min: float
    sensor_sd: tuple[float, ...]
    clock: int = 0


@dataclass(frozen=True, eq=False)
class Fitted:
    """What a forcing makes of a run.

    Attributes:
        loss: minus the logarithm of its marginal likelihood, up to the constant that all hypotheses share.
        levels: at which.
        terms: sizes of the function's terms, in typical sizes of the effect.
    """

    loss: float
    levels: Levels
    terms: Array


@dataclass(frozen=True, eq=False)
class Reference:
    """A path to linearise about, and what else is known of a run.

    Attributes:
        x: the path, shape (rows, n_x).
        size: of the forcing along it.
        process_sd: of the process noise, one a state.
        known: which values count, shape (rows, n_y).
        began: rows in which all begins anew, shape (rows,).
        start: the state there, shape (rows, n_x).
        start_covariance: its covariance, shape (rows, n_x, n_x).
    """

    x: Array
    size: Signal
    process_sd: Array
    known: NDArray[np.bool_]
    began: NDArray[np.bool_]
    start: Array
    start_covariance: Array


class Forcing:
    """An effect with a size of unknown course.

    Args:
        model: of the plant.
        effect: without memory.

    Attributes:
        effect: as given.
        sees: places, among states and inputs, of what its terms depend on.
    """

    def __init__(self, model: ProcessModel, effect: Effect) -> None:
        self.effect = effect
        self._sized = with_size_inputs(model, (effect,))
        self.sees = tuple(_sees(self._sized))
        self._errors = self._sized.errors  # a path has no noise

    def about(self, reference: Reference, run: Run) -> "Linearised":
        """The forcing about a path."""
        inputs = self._sized.inputs(run.time_min, run.inputs, [reference.size])
        path = self._errors.along(run.time_min, inputs, reference.x, doubt_of(run, inputs))
        rows, n_x = reference.x.shape
        F, G, D = np.zeros((rows, n_x, n_x)), np.zeros((rows, n_x)), path.D[:, :, 0]
        F[1:], G[1:] = path.F, path.G[:, :, 0]
        step_min = np.diff(run.time_min, prepend=run.time_min[0])
        clocks = [step_min, *(_ticks(run.inputs[:, place - n_x], run.span_min) for place in self.sees if place >= n_x)]
        linear = Linear(
            F,
            G,
            path.H,
            D,
            np.square(reference.process_sd) * step_min[:, None]
            + np.square(np.vstack([np.zeros(n_x), path.predicted_sd])),
            reference.known,
            reference.began,
            reference.start - reference.x,
            reference.start_covariance,
        )
        terms, covariance = self._terms(run, reference.x)
        over_way = np.concatenate([np.zeros((1, terms.over_row.shape[1])), terms.over_row[:-1]])
        offset = np.zeros((rows, n_x, 1 + over_way.shape[1]))
        offset[1:, :, 0] = path.predicted - reference.x[1:] - G[1:] * reference.size.over_row[:-1, None]
        offset[:, :, 1:] = G[:, :, None] * over_way[:, None, :]
        seen = np.empty((rows, D.shape[1], offset.shape[2]))
        seen[:, :, 0] = np.nan_to_num(run.measured - path.outputs + D * reference.size.at_row[:, None])
        seen[:, :, 1:] = -D[:, :, None] * terms.at_row[:, None, :]
        return Linearised(
            linear, offset, seen, tuple(clocks), terms, np.asarray(np.linalg.cholesky(covariance)), self.effect
        )

    def _terms(self, run: Run, x: Array) -> tuple[Signal, Array]:
        """The function's terms of a typical size along a path, and their covariance where the function is 1 large."""
        z = np.column_stack([x, run.inputs])
        after = np.vstack([z[1:], z[-1:]])
        after[:, x.shape[1] :] = z[:, x.shape[1] :]  # inputs are held
        ones = np.ones((len(z), 1))
        over_row, at_row, count = [ones], [ones], 1
        for place in self.sees:
            low, high = float(np.min(z[:, place])), float(np.max(z[:, place]))
            if high > low:
                now, then = (hats((item[:, place] - low) / (high - low), KNOTS) for item in (z, after))
                over_row.append(0.5 * (now + then))
                at_row.append(now)
                count += KNOTS
        covariance = np.eye(count)
        for begin in range(1, count, KNOTS):
            covariance[begin : begin + KNOTS, begin : begin + KNOTS] = _bending()
        typical = self.effect.typical
        return Signal(typical * np.concatenate(over_row, axis=1), typical * np.concatenate(at_row, axis=1)), covariance


@dataclass(frozen=True, eq=False)
class Linearised:
    """A forcing about a path; see `smoother` for what `linear`, `offset` and `seen` are.

    Attributes:
        clocks: how far each goes from the row before, shape (rows,); the first is time, inputs move the others.
        terms: of the function.
        root: of the covariance of their sizes.
        effect: that is the forcing.
    """

    linear: Linear
    offset: Array
    seen: Array
    clocks: tuple[Array, ...]
    terms: Signal
    root: Array
    effect: Effect

    def fit(self, levels: Levels) -> Fitted:
        """With the likeliest size of the function."""
        w, logs = whitened(self.linear, *self._red(levels), self.offset, self.seen)
        w = w.reshape(-1, w.shape[2])
        gram = w.T @ w
        if not np.all(np.isfinite(gram)) or gram[0, 0] > _RUNAWAY:
            return Fitted(inf, levels, np.zeros(len(self.root)))
        values, vectors = np.linalg.eigh(self.root.T @ gram[1:, 1:] @ self.root)
        by, sizes = -vectors.T @ (self.root.T @ gram[1:, 0]), FUNCTION_SIZES[:, None]
        spread = 1.0 + sizes**2 * np.maximum(values, 0.0)
        losses = 0.5 * np.sum(np.log(spread) - sizes**2 * by**2 / spread, axis=1) + 0.5 * gram[0, 0] + logs
        best = int(np.argmin(losses))
        terms = self.root @ (vectors @ (sizes[best] ** 2 * by / spread[best]))
        return Fitted(float(losses[best]), levels, terms)

    def course(self, fitted: Fitted) -> tuple[Array, Signal]:
        """By how much the likeliest path differs from this one, and the size of the forcing along it."""
        offset, seen = (item[:, :, 0] + item[:, :, 1:] @ fitted.terms for item in (self.offset, self.seen))
        d, red = smoothed(self.linear, *self._red(fitted.levels), offset, seen)
        sizes = (np.clip(item @ fitted.terms + red, self.effect.lower, self.effect.upper) for item in self.terms)
        return d, Signal(*sizes)

    def _red(self, levels: Levels) -> tuple[Array, Array, float]:
        sd = levels.red * self.effect.typical
        return np.square(levels.sensor_sd), np.exp(-self.clocks[levels.clock] / levels.lasts_min), sd * sd


def _ticks(values: Array, span_min: float) -> Array:
    """A clock that goes as far as an input moves, and over the record as far as time."""
    moved = np.abs(np.diff(values, prepend=values[0]))
    return np.asarray(moved * (span_min / max(float(np.sum(moved)), 1e-300)))


def _bending() -> Array:
    """Covariance of a smooth function at the knots: Matern's with 3/2, and a straight line."""
    knots = np.linspace(0.0, 1.0, KNOTS)
    apart = np.sqrt(3.0) * np.abs(knots[:, None] - knots) / LENGTH
    return np.asarray((1.0 + apart) * np.exp(-apart) + STRAIGHT * np.outer(knots - 0.5, knots - 0.5))


def _sees(sized: SizedModel) -> Sequence[int]:
    """Which of the plant's states and inputs, in this order, the terms of the effect depend on."""
    model, felt, seen = sized.model, sized.rate_symbols[0], sized.output_symbols[0]
    terms = [ca.substitute(ca.jacobian(ca.vertcat(*model.rhs), felt), felt, 0)]
    for output in model.outputs:
        by = ca.jacobian(output.expression, seen)
        if by.nnz():  # a sensor knows what it measures
            terms += [by, output.expression]
    symbols = [item.symbol for item in (*model.states, *model.inputs[:-2])]
    return [place for place, symbol in enumerate(symbols) if any(ca.depends_on(term, symbol) for term in terms)]
