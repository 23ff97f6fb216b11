"""One number, how often a false alarm may come, shared over everything that can raise an alarm.

A plant is watched by many charts, and each adds its false alarms: at k charts of a plain 3-sigma limit they come k
times as often. Here the number is promised for the plant, in alarms per 30 days, and every chart gets the same share of
it. Whatever the charts have in common, the expected number of alarms is the sum of theirs, so the promise is not a
bound but an expectation. (Alarms that come together are one incident: of these there are fewer.)

Limits for a share come from the run lengths in `spc.run_length`, which hold when mean and standard deviation are
known. They are learned from n rows, and a limit that ignores it is too tight: Jones, Champ & Rigdon (2001), The
performance of exponentially weighted moving average charts with estimated parameters, Technometrics 43, find
a run length of 200 fall to 145. An average of weight lambda has the variance lambda / (2 - lambda); the mean that was
learned adds 1 / n to it, and the standard deviation that was learned makes a normal number into one of Student's, with
the degrees of freedom nu that belong to the variance 1 / (2 nu) of its relative error. So the limit L becomes

    sqrt(1 + (2 - lambda) / (lambda n)) t_nu^-1(Phi(L)),

the one that a new average crosses as rarely as L is crossed when all is known. That is Student's prediction interval
(Hahn 1970, Additional factors for calculating prediction intervals, J. Amer. Statist. Assoc. 65); several signals:
`estimated_t2`. It holds on average over trainings: one plant may have been lucky with its training, another
not.
"""

from collections.abc import Callable
from functools import lru_cache
from math import ceil, comb, exp, floor, log, log10, sqrt

from scipy import special

from reactorwatch.errors import InputError
from reactorwatch.spc.m_of_n import false_alarm_rate
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.run_length.control_limits import LONGEST_DESIGN, SHORTEST

DAYS = 30
DAYS_MIN = DAYS * 24 * 60.0

USUAL_PER_30_DAYS = 1.0
"""False alarms of a plant that are promised where the settings ask for no number."""


def promise_per_30_days(asked: float | None, alarms: int, period_min: float) -> float:
    """The false alarms of a plant in 30 days that are promised.

    Args:
        asked: number that the settings ask for; None: `USUAL_PER_30_DAYS`, or the nearest number that charts can keep.
        alarms: number of alarms that share them.
        period_min: sampling period of the rows.

    Raises:
        InputError: charts cannot keep what is asked for.
    """
    rows = DAYS_MIN / period_min * alarms
    fewest, most = rows / LONGEST_DESIGN, rows / (10 * SHORTEST)
    if asked is None:
        return min(max(USUAL_PER_30_DAYS, fewest), most)
    if not fewest <= asked <= most:
        bounds = f"[{_two_digits(fewest, ceil)}, {_two_digits(most, floor)}]"
        raise InputError(
            f"false_alarms_per_30_days must be in {bounds} for {alarms} alarms and rows every {period_min:g} min, got "
            f"{asked:g}; set it within that range, or leave it out for the nearest number to 1 that can be kept"
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
    return min(max(DAYS_MIN / period_min * alarms / per_30_days, 10 * SHORTEST), LONGEST_DESIGN)


@lru_cache(maxsize=64)
def point_probability(arl0: float, raise_count: int, window: int) -> float:
    """Allowed probability of a single point out if an alarm takes `raise_count` of them among `window`.

    Args:
        arl0: run length to the alarm without a fault.
        raise_count: see `m_of_n`.
        window: see `m_of_n`.
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
