"""Rate of false alarms of one plant, given the errors that its training may have made.

Limits are widened so that the promise holds on average over trainings (`false_alarm_budget`). The rate of one plant
depends on the errors of its own training: with the true standard deviation s and mean m of a residual, in units of the
learned standard deviation, an average of weight lambda crosses its widened limit W about

    [Phi(-(W - d) / s) + Phi(-(W + d) / s)] / [2 Phi(-L)],      d = m sqrt((2 - lambda) / lambda),

times as often as intended, L being the limit that holds when all is known: the approximation by which limits are
widened. Seen from the training, s^2 is nu / chi2(nu), and m / s normal with the variance 1 / n (the fiducial
distribution of Student's interval). An upper quantile of the rate over these errors is what a plant keeps with that
confidence: a tolerance bound instead of the mean (Hahn & Meeker 1991, Statistical Intervals, ch. 4; for control
charts Gandy & Kvaloy 2013, Guaranteed conditional performance of control charts via bootstrap methods, Scandinavian
Journal of Statistics 40). The errors of one signal are the same for all its charts, so rates are summed draw by draw.
New residuals vary more than those to which the autoregression was fitted: by 1 / n for each coefficient that it could
have had.
"""

from collections.abc import Sequence
from functools import cache
from math import sqrt
from typing import NamedTuple

import numpy as np
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.spc.false_alarm_budget import degrees_of_freedom, scale_variance, widen_limit
from reactorwatch.spc.prewhitening import LARGEST_ORDER, Prewhitening

DRAWS = 400
CONFIDENCE = 0.9
QUANTILE = 0.93
"""Quantile that is taken as the bound with this confidence: rates by tails alone are good to some percent."""


MOST_TURNED = 8
"""Largest number of signals for which errors of correlations are drawn; of more, the limit has them on average."""

_SEED = 20_260_523
_BISECTIONS = 40


class TrainingErrors(NamedTuple):
    """Errors that the trainings of some signals may have made, as standard normal numbers, one row a draw.

    Attributes:
        scale: error of the standard deviation, shape (draws, signals).
        passed: error of the part of a lasting shift that the prewhitened residual shows, same shape.
        mean: error of the mean, same shape.
    """

    scale: Array
    passed: Array
    mean: Array

    @classmethod
    def draw(cls, signals: int) -> "TrainingErrors":
        """Draw errors of a number of signals; always the same ones."""
        return cls(*_draw(signals))

    def of(self, signals: Sequence[int]) -> "TrainingErrors":
        """Errors of some of the signals, by their indices."""
        return TrainingErrors(*(item[:, list(signals)] for item in self))

    def true_scale(self, signal: int, learned: Prewhitening, weight: float) -> Array:
        """True standard deviation, over the learned one, as an average with this weight shows it, shape (draws,)."""
        freedom = degrees_of_freedom(learned, weight)
        known = scale_variance(learned, weight)
        own, passed = sqrt(learned.sd_variance), (1.0 - weight) * sqrt(learned.passed_variance)
        mixed = (own * self.scale[:, signal] + passed * self.passed[:, signal]) / sqrt(max(known, 1e-300))
        return np.asarray(np.sqrt((1.0 + LARGEST_ORDER / learned.rows) * freedom / _chi2(freedom, mixed)))


def _chi2(freedom: float, errors: Array) -> Array:
    """Chi-squares with these degrees of freedom whose errors are standard normal numbers."""
    return np.asarray(2.0 * special.gammainccinv(0.5 * freedom, special.ndtr(-errors)))


def student_tail(limit: float, freedom: float, errors: Array) -> Array:
    """Probability that an average is beyond a limit, by errors of its estimated variance, same shape as the errors.

    Args:
        limit: limit in estimated standard deviations.
        freedom: degrees of freedom of the variance.
        errors: errors of the variance, see `TrainingErrors.scale`.
    """
    return np.asarray(special.ndtr(-limit * np.sqrt(_chi2(freedom, errors) / freedom)))


@cache
def _draw(signals: int) -> tuple[Array, Array, Array]:
    numbers = np.random.default_rng(_SEED).standard_normal((signals, 3, DRAWS))
    scale, passed, mean = (np.ascontiguousarray(numbers[:, i].T) for i in range(3))
    return scale, passed, mean


def relative_rate(limit: float, weight: float, learned: Prewhitening, errors: TrainingErrors) -> Array:
    """Rate of a chart of one signal, relative to the intended one, shape (draws,).

    Args:
        limit: limit that holds when all is known, in standard deviations of the average.
        weight: weight of the newest value in the average.
        learned: the training.
        errors: errors of this signal.
    """
    wide = widen_limit(limit, weight, learned)
    scale = errors.true_scale(0, learned, weight)
    shift = scale * errors.mean[:, 0] * sqrt((2.0 - weight) / (weight * learned.rows))
    return two_sided_tail(wide, shift, scale) / (2.0 * special.ndtr(-limit))


def two_sided_tail(limit: float, mean: Array, sd: Array) -> Array:
    """Probability that a normal number is beyond +- a limit."""
    return np.asarray(special.ndtr(-(limit - mean) / sd) + special.ndtr(-(limit + mean) / sd))


def joint_relative_rate(
    known: float, limit: float, weight: float, learned: Sequence[Prewhitening], rows: float, errors: TrainingErrors
) -> Array:
    """Rate of a chart of the squared length of a vector, relative to the intended one, shape (draws,).

    Args:
        known: limit that holds when all is known.
        limit: limit of the chart.
        weight: weight of the newest vector in the average.
        learned: the training of each signal.
        rows: number of rows from which the correlations of the signals were estimated.
        errors: errors of these signals.
    """
    count = len(learned)
    scale = np.column_stack([errors.true_scale(i, item, weight) for i, item in enumerate(learned)])
    factor = sqrt((2.0 - weight) / weight)
    mean = scale * errors.mean * factor / np.sqrt([float(item.rows) for item in learned])
    turned = _correlation_errors(count, rows) if count <= MOST_TURNED else np.tile(np.eye(count), (DRAWS, 1, 1))
    covariance = scale[:, :, None] * turned * scale[:, None, :]
    sizes, directions = np.linalg.eigh(covariance)
    shifts = np.einsum("dij,di->dj", directions, mean) / np.sqrt(sizes)
    return weighted_chi2_tail(sizes, shifts**2, limit) / float(special.chdtrc(count, known))


def _correlation_errors(count: int, rows: float) -> Array:
    """True correlation matrices of signals that the training found uncorrelated, shape (draws, count, count)."""
    numbers = np.random.default_rng(_SEED + 1).standard_normal((DRAWS, count, count)) / sqrt(rows)
    errors = np.tril(numbers, -1)
    matrix = errors + errors.transpose(0, 2, 1) + np.eye(count)
    sizes, directions = np.linalg.eigh(matrix)
    matrix = np.einsum("dij,dj,dkj->dik", directions, np.maximum(sizes, 0.05), directions)
    lengths = np.sqrt(np.einsum("dii->di", matrix))
    return np.asarray(matrix / (lengths[:, :, None] * lengths[:, None, :]))


def weighted_chi2_tail(weights: Array, noncentrality: Array, limit: float) -> Array:
    """Probability that a weighted sum of squares of normal numbers exceeds a limit, shape (sums,).

    By the saddlepoint (Lugannani & Rice 1980, Advances in Applied Probability 12; Kuonen 1999, Saddlepoint
    approximations for distributions of quadratic forms in normal variables, Biometrika 86); good to some percent of
    the probability itself, far out in the tail.

    >>> round(float(weighted_chi2_tail(np.ones((1, 2)), np.zeros((1, 2)), 30.0)[0] * np.exp(15.0)), 2)  # exactly 1
    1.03

    Args:
        weights: weights, shape (sums, terms), above 0.
        noncentrality: squares of the numbers' means, same shape.
        limit: the limit; where it is not above the mean of the sum the result is 1/2 to 1.
    """
    mean = np.sum(weights * (1.0 + noncentrality), axis=1)
    largest = weights.max(axis=1)
    low, high = np.zeros(len(weights)), (1.0 - 1e-12) / (2.0 * largest)
    for _ in range(_BISECTIONS):  # bisection: K' increases from the mean to infinity
        t = 0.5 * (low + high)
        rest = 1.0 - 2.0 * weights * t[:, None]
        slope = np.sum(weights / rest + weights * noncentrality / rest**2, axis=1)
        low, high = np.where(slope < limit, t, low), np.where(slope < limit, high, t)
    t = np.maximum(0.5 * (low + high), 1e-9 / largest)
    rest = 1.0 - 2.0 * weights * t[:, None]
    K = np.sum(-0.5 * np.log(rest) + noncentrality * weights * t[:, None] / rest, axis=1)
    curvature = np.sum(2.0 * weights**2 / rest**2 + 4.0 * weights**2 * noncentrality / rest**3, axis=1)
    w = np.sqrt(np.maximum(2.0 * (t * limit - K), 1e-300))
    u = t * np.sqrt(curvature)
    tail = special.ndtr(-w) + np.exp(-0.5 * w * w) / np.sqrt(2.0 * np.pi) * (1.0 / u - 1.0 / w)
    return np.asarray(np.where(limit > mean * (1.0 + 1e-3), np.clip(tail, 0.0, 1.0), 0.5))
