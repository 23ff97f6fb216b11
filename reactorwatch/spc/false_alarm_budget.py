"""One number, how often a false alarm may come, shared over everything that can raise an alarm.

A plant is watched by many charts, and each adds its false alarms: at k charts of a plain 3-sigma limit they come k
times as often. Here the number is promised for the plant, in alarms per 30 days, and every chart gets the same share of
it. Whatever the charts have in common, the expected number of alarms is the sum of theirs, so the promise is not a
bound but an expectation. (Alarms that come together are one incident: of these there are fewer.)

Limits for a share come from the run lengths of the charts, which hold when mean and standard deviation are known. They
are learned from n rows, and a limit that ignores it is too tight: Jones, Champ & Rigdon (2001), The performance of
exponentially weighted moving average charts with estimated parameters, Technometrics 43, find a run length of 200 fall
to 145. An average of weight lambda has the variance lambda / (2 - lambda); the mean that was learned adds 1 / n to it,
and the standard deviation that was learned makes a normal number into one of Student's, with the degrees of freedom nu
that belong to the variance 1 / (2 nu) of its relative error. So the limit L becomes

    sqrt(1 + (2 - lambda) / (lambda n)) t_nu^-1(Phi(L)),

the one that a new average crosses as rarely as L is crossed when all is known. That is Student's prediction interval
(Hahn 1970, Additional factors for calculating prediction intervals, J. Amer. Statist. Assoc. 65); several signals:
`charts/t2.py`. It holds on average over trainings: one plant may have been lucky with its training, another
not.

The promise holds on average over trainings. The rate of one plant depends on the errors of its own training: with the
true standard deviation s and mean m of a residual, in units of the learned standard deviation, an average of weight
lambda crosses its widened limit W about

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

from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from math import ceil, comb, exp, floor, log, log10, sqrt
from typing import NamedTuple

import numpy as np
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.spc.prewhitening import LARGEST_ORDER, Prewhitening
from reactorwatch.spc.run_length import LONGEST_DESIGN, SHORTEST_DESIGN, false_alarm_rate

DAYS = 30
"""Days for which false alarms are promised."""

DAYS_MIN = DAYS * 24 * 60.0
"""The same in minutes."""

USUAL_ROWS = 8640.0
"""Rows of 5 minutes in 30 days. Slower rows are fewer, and one false alarm in 30 days would be one in 30 daily rows."""

SHORTEST_ARL0 = 10 * SHORTEST_DESIGN
"""Shortest run length of an alarm, in rows: more frequent alarms are no promise."""

QUANTILE = 0.93
"""Quantile of a plant's rate that is taken as its bound at 90 %: rates by tails are good to some percent (`make
promise` holds the bound to simulation)."""

DRAWS, SEED = 400, 20_260_523
"""Draws of the errors of a training, of which the quantile is the 28th largest; always the same ones."""


def usual_per_30_days(period_min: float) -> float:
    """False alarms in 30 days that are promised where nothing is asked: 1, or 1 in `USUAL_ROWS` rows if that is fewer.

    >>> usual_per_30_days(0.1), usual_per_30_days(50.0)
    (1.0, 0.1)
    """
    return min(1.0, DAYS_MIN / period_min / USUAL_ROWS)


def promise_per_30_days(asked: float | None, alarms: int, period_min: float) -> float:
    """The false alarms of a plant in 30 days that are promised.

    Args:
        asked: number that the settings ask for; None: `usual_per_30_days`, or the fewest that charts can keep.
        alarms: number of alarms that share them.
        period_min: sampling period of the rows.

    Raises:
        InputError: charts cannot keep what is asked for.
    """
    rows = DAYS_MIN / period_min * alarms
    fewest, most = rows / LONGEST_DESIGN, rows / SHORTEST_ARL0
    if asked is None:
        return max(usual_per_30_days(period_min), fewest)
    if not fewest <= asked <= most:
        bounds = f"[{_two_digits(fewest, ceil)}, {_two_digits(most, floor)}]"
        raise InputError(
            f"false_alarms_per_30_days must be in {bounds} for {alarms} alarms and rows every {period_min:g} min, got "
            f"{asked:g}; set it within that range, or leave it out for one that can be kept"
        )
    return asked


def _two_digits(value: float, rounded: Callable[[float], int]) -> str:
    """A bound in two digits, which is itself within the bounds."""
    unit = 10.0 ** (floor(log10(value)) - 1)
    return f"{rounded(value / unit) * unit:.2g}"


def share_arl0(per_30_days: float, alarms: int, period_min: float) -> float:
    """The run length that each of a plant's alarms is to have without a fault, in rows.

    Args:
        per_30_days: false alarms of the plant that are promised, see `promise_per_30_days`.
        alarms: number of alarms that share them.
        period_min: sampling period of the rows.
    """
    return min(max(DAYS_MIN / period_min * alarms / per_30_days, SHORTEST_ARL0), LONGEST_DESIGN)


@lru_cache(maxsize=64)
def point_probability(arl0: float, raise_count: int, window: int) -> float:
    """Allowed probability of a single point out if an alarm takes `raise_count` of them among `window`.

    Args:
        arl0: run length to the alarm without a fault.
        raise_count: see `false_alarm_rates`.
        window: see `false_alarm_rates`.
    """
    from scipy import optimize  # only here: to import it is a tenth of a start

    def off(log_p: float) -> float:
        return false_alarm_rate(raise_count, window, exp(log_p)) * arl0 - 1.0

    # A point completes at most so many patterns, each as rare as its points together.
    lowest = -log(arl0 * comb(window - 1, raise_count - 1)) / raise_count
    return exp(float(optimize.brentq(off, lowest - 0.1, -0.01)))


def widen_limit(limit: float, weight: float, learned: Prewhitening) -> float:
    """Widen the limit of an average for the errors of a learned mean and standard deviation.

    Args:
        limit: limit that holds when both are known, in standard deviations.
        weight: lambda, of the newest value in the average.
        learned: the training.
    """
    student = -float(special.stdtrit(degrees_of_freedom(learned, weight), float(special.ndtr(-limit))))
    return sqrt(1.0 + (2.0 - weight) / (weight * learned.rows)) * student


def degrees_of_freedom(learned: Prewhitening, weight: float) -> float:
    """Degrees of freedom of the learned standard deviation, for a chart whose newest value has this weight."""
    return max(0.5 / scale_variance(learned, weight), 5.0)


def scale_variance(learned: Prewhitening, weight: float) -> float:
    """Variance of the relative error of that standard deviation, for such a chart."""
    return learned.sd_variance + (1.0 - weight) ** 2 * learned.passed_variance


def return_level(statistics: Array, arl0: float) -> float:
    """Level that a statistic exceeds once in a number of rows, extrapolated from its peaks; 0 where these are too few.

    The squares of the larger half of the peaks, one a block of 20 rows, are extrapolated exponentially, as those of
    normal values are (peaks over a threshold: Davison & Smith 1990, Models for exceedances over high thresholds, J.
    Roy. Statist. Soc. B 52). Where tails are heavier, peaks are larger, and the level follows.

    >>> e = np.abs(np.random.default_rng(0).standard_normal(100_000))
    >>> round(return_level(e[:10_000], 10_000), 1), round(float(np.sort(e)[-10]), 1)
    (4.0, 3.9)

    Args:
        statistics: statistics of the training, shape (rows,); NaN where there is none.
        arl0: number of rows.
    """
    blocks = np.array_split(np.nan_to_num(statistics) ** 2, max(statistics.size // 20, 1))
    largest = np.sort([float(block.max()) for block in blocks if block.size])
    upper = len(largest) // 2
    if upper < 5:  # too few for an estimate of their tail
        return 0.0
    threshold, excess = largest[-upper - 1], largest[-upper:] - largest[-upper - 1]
    scale = float(excess.mean()) * (1.0 + 1.0 / sqrt(upper))
    return sqrt(threshold + scale * max(0.0, log(arl0 * upper / statistics.size)))


# --- errors of the training --------------------------------------------------------------------------------------


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
    numbers = np.random.default_rng(SEED).standard_normal((signals, 3, DRAWS))
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
