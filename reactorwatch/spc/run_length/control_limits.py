"""Optimal design: the chart that detects a shift fastest at a given rate of false alarms.

For each value of the parameter that sets a chart's memory (k of the CUSUM, lambda of the EWMA and the MEWMA), the limit
that gives the in-control run length is found as a root; among these charts the one with the shortest zero-state run
length at the shift is found by a one-dimensional search (Crowder 1989, Design of exponentially weighted moving average
schemes, J. Quality Technology 21; Gan 1991, An optimal design of CUSUM quality control charts, same journal 23;
Prabhu & Runger 1997, Designing a multivariate EWMA control chart, same journal 29). The minimum is flat, so its
argument is rounded to three digits and the limit is computed for that. A chart without memory has only its limit.
"""

from collections.abc import Callable, Iterable
from functools import cache
from math import exp, log

import msgspec
from scipy import special

from reactorwatch.errors import InputError
from reactorwatch.spc.run_length.arguments import check_range
from reactorwatch.spc.run_length.cusum import LARGEST_LIMIT, cusum
from reactorwatch.spc.run_length.ewma import ewma
from reactorwatch.spc.run_length.mewma import LARGEST_DIMENSION, SMALLEST_WEIGHT, mewma
from reactorwatch.spc.run_length.mewma import LARGEST_LIMIT_WITHOUT_SHIFT as LARGEST_MEWMA_LIMIT
from reactorwatch.spc.run_length.shewhart import checked_rules, shewhart
from reactorwatch.spc.run_length.t2 import t2

SHORTEST, LONGEST_DESIGN = 5.0, 1e8
SMALLEST_SHIFT, LARGEST_SHIFT = 0.1, 10.0
_SMALLEST_EWMA_WEIGHT = 0.002


Parameters = dict[str, float | int | list[int]]


class Design(msgspec.Struct, frozen=True):
    """A designed chart and its run lengths.

    Attributes:
        chart: name in the catalogue.
        parameters: values by the parameter names of the run-length commands.
        arl0: run length without a shift, in samples.
        shift: shift to be detected, in sigma.
        arl: run length at the shift, in samples.
    """

    chart: str
    parameters: Parameters
    arl0: float
    shift: float
    arl: float


def design(chart: str, arl0: float, shift: float, *, dimension: int = 2, rules: Iterable[int] = (1,)) -> Design:
    """Design the fastest chart of a kind for a shift.

    >>> design("cusum", 370.4, 1.0).parameters["k"]
    0.5

    Args:
        chart: shewhart, cusum, ewma, mewma or t2.
        arl0: run length without a shift, in [5, 1e8].
        shift: shift to be detected, in sigma (of several signals: Mahalanobis), in [0.1, 10].
        dimension: number of signals, of mewma and t2.
        rules: run rules, of shewhart.

    Raises:
        InputError: there is no such chart, or an argument out of its range.
    """
    check_range("arl0", arl0, SHORTEST, LONGEST_DESIGN)
    check_range("shift", shift, SMALLEST_SHIFT, LARGEST_SHIFT)
    check_range("dimension", dimension, 1, LARGEST_DIMENSION)
    if chart == "shewhart":
        wanted = checked_rules(rules)
        limit = shewhart_limit(arl0, wanted)
        return Design(chart, {"rules": list(wanted), "limit": limit}, arl0, shift, shewhart(shift, limit, wanted))
    if chart == "t2":
        limit = t2_limit(arl0, dimension)
        return Design(chart, {"dimension": dimension, "limit": limit}, arl0, shift, t2(shift, dimension, limit))
    if chart == "cusum":
        # Beyond this allowance even a limit of 0 signals too seldom.
        largest = 0.98 * float(-special.ndtri(0.5 / arl0))
        k = _fastest_parameter(
            lambda k: cusum(shift, k, cusum_limit(arl0, k)),
            min(0.35 * shift, 0.7 * largest),
            min(0.75 * shift, largest),
        )
        h = cusum_limit(arl0, k)
        return Design(chart, {"k": k, "h": h}, arl0, shift, cusum(shift, k, h))
    if chart == "ewma":
        weight = _fastest_parameter(lambda w: ewma(shift, w, ewma_limit(arl0, w)), _SMALLEST_EWMA_WEIGHT, 1.0)
        limit = ewma_limit(arl0, weight)
        return Design(chart, {"lambda": weight, "limit": limit}, arl0, shift, ewma(shift, weight, limit))
    if chart == "mewma":
        weight = _fastest_parameter(
            lambda w: mewma(shift, dimension, w, mewma_limit(arl0, dimension, w)),
            max(SMALLEST_WEIGHT, min(0.03 * shift**1.4, 0.2)),
            min(0.4 * shift**1.4, 1.0),
            accuracy=0.03,
        )
        limit = mewma_limit(arl0, dimension, weight)
        parameters: Parameters = {"dimension": dimension, "lambda": weight, "limit": limit}
        return Design(chart, parameters, arl0, shift, mewma(shift, dimension, weight, limit))
    raise InputError(f"chart must be one of shewhart, cusum, ewma, mewma, t2, got {chart!r}")


def shewhart_limit(arl0: float, rules: Iterable[int] = (1,)) -> float:
    """Width L for an in-control run length."""
    wanted = checked_rules(rules)
    if wanted == (1,):
        return float(-special.ndtri(0.5 / arl0))
    if 4 in wanted and arl0 >= (rule_4 := shewhart(0.0, 12.0, (4,))):
        raise InputError(f"arl0 must be below {rule_4:g} with rule 4, which depends on no limit, got {arl0:g}")
    return _root(lambda limit: shewhart(0.0, limit, wanted), arl0, 0.5, 30.0)


@cache
def cusum_limit(arl0: float, k: float) -> float:
    """Limit h of the two-sided CUSUM of allowance k for an in-control run length."""
    # The run length grows about as exp(2 k h).
    return _root(lambda h: cusum(0.0, k, h), arl0, 0.5 / min(max(k, 0.01), 1.0), LARGEST_LIMIT)


@cache
def ewma_limit(arl0: float, weight: float) -> float:
    """Limit L of the EWMA of weight lambda for an in-control run length."""
    return _root(lambda limit: ewma(0.0, weight, limit), arl0, 0.5, 10.0)


@cache
def mewma_limit(arl0: float, dimension: int, weight: float) -> float:
    """Limit H of the MEWMA of weight lambda for an in-control run length."""
    return _root(
        lambda limit: mewma(0.0, dimension, weight, limit), arl0, max(2.0, 0.5 * dimension), LARGEST_MEWMA_LIMIT
    )


def t2_limit(arl0: float, dimension: int) -> float:
    """Limit of T2 for an in-control run length."""
    return float(special.chdtri(dimension, 1.0 / arl0))


def _root(run_length: Callable[[float], float], arl0: float, step: float, largest: float) -> float:
    """Limit at which a run length that increases with the limit equals arl0."""
    from scipy import optimize  # imported here, as it takes a tenth of a start

    low, high = 1e-3, step
    while run_length(high) < arl0:
        low, high = high, high + step
        if high > largest:
            raise InputError(f"arl0 must be lower, or the shift larger: the limit would be beyond {largest:g}")
    return float(optimize.brentq(lambda limit: log(run_length(limit) / arl0), low, high, xtol=1e-9))


def _fastest_parameter(
    run_length: Callable[[float], float], lowest: float, highest: float, accuracy: float = 2e-3
) -> float:
    """Parameter, to three digits, of the shortest run length; searched on a logarithmic scale."""
    from scipy import optimize  # imported here, as it takes a tenth of a start

    result = optimize.minimize_scalar(
        lambda x: run_length(exp(x)), bounds=(log(lowest), log(highest)), method="bounded", options={"xatol": accuracy}
    )
    best = min(max(float(f"{exp(float(result.x)):.3g}"), lowest), highest)
    return highest if run_length(highest) <= run_length(best) else best
