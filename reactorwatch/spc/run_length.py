"""Run lengths of Markov chains, shared by all charts, and the limit for a run length.

A chart's statistic is a Markov chain that ends when the chart signals. With K the transitions among the states in
which it has not signalled, the mean number of samples to the signal from each state solves (1 - K) L = 1 (Brook & Evans
1972, Biometrika 59). For a statistic that takes a continuum of values, K is its kernel at the nodes of a quadrature,
times the weights: Nystroem's method for the integral equation, which converges exponentially for the smooth kernels of
normal data. For a discrete chain K is exact.

Zero state: the change is present from the first sample on. Steady state: the chart has long run without a signal when
the change occurs, so the state is distributed as the left eigenvector of the in-control K (the conditional steady
state: no false alarm has come yet).

Each chart's own run length and limit are in its file, for independent normal data with known mean and covariance. The
fastest chart for a shift: for each value of the parameter that sets the memory (k of the CUSUM, lambda of the EWMA and
the MEWMA) the limit that gives the in-control run length is found as a root; among these charts the one with the
shortest zero-state run length at the shift is found by a one-dimensional search (Crowder 1989, Design of exponentially
weighted moving average schemes, J. Quality Technology 21; Gan 1991, An optimal design of CUSUM quality control charts,
same journal 23; Prabhu & Runger 1997, Designing a multivariate EWMA control chart, same journal 29). The minimum is
flat, so its argument is rounded to three digits and the limit is computed for that.
"""

from collections.abc import Callable
from functools import cache, lru_cache
from math import ceil, exp, isfinite, log

import numpy as np
from scipy import linalg, special

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError

LONGEST = 1e12
"""Longest run length that double precision resolves: beyond it 1 - K is rounding error."""

MOST_SHIFTED_SIGNALS = 50
"""Most signals whose run length after a shift is computed: the nodes of its two dimensions grow with them."""

SHORTEST_DESIGN, LONGEST_DESIGN = 5.0, 1e8
"""Run lengths that limits are computed for: well within those that double precision resolves."""


# --- arguments and results ---------------------------------------------------------------------------------------


def check_range(name: str, value: float, lowest: float, highest: float) -> float:
    """Check a range; returns the value.

    Raises:
        InputError: it is not in [lowest, highest].
    """
    if not lowest <= value <= highest:
        raise InputError(f"{name} must be in [{lowest:g}, {highest:g}], got {value}")
    return float(value)


def shift_size(shift: float) -> float:
    """Size of a shift.

    Raises:
        InputError: it is not a finite number of at most 100.
    """
    if not (isfinite(shift) and abs(shift) <= 100.0):
        raise InputError(f"shift must be in [-100, 100] sigma, got {shift}")
    return abs(float(shift))


def check_design(arl0: float, shift: float, dimension: int) -> None:
    """Check what a chart is designed for.

    Raises:
        InputError: the run length is not in [5, 1e8], the shift not in [0.1, 10] or the dimension not in [1, 50].
    """
    check_range("arl0", arl0, SHORTEST_DESIGN, LONGEST_DESIGN)
    check_range("shift", shift, 0.1, 10.0)
    check_range("dimension", dimension, 1, MOST_SHIFTED_SIGNALS)


def check_length(length: float) -> float:
    """Check a run length; returns it.

    Raises:
        InputError: it is beyond 1e12.
    """
    if not length < LONGEST:
        raise InputError(f"the run length must be below {LONGEST:g} samples to be computed; lower the limit")
    return float(length)


# --- the chain ---------------------------------------------------------------------------------------------------


def run_lengths(transitions: Array) -> Array:
    """Mean number of samples to the signal from each state, shape (states,); all inf if beyond 1e12.

    Args:
        transitions: K, shape (states, states), from row to column.
    """
    endless = np.full(len(transitions), np.inf)
    try:
        lengths = np.linalg.solve(np.eye(len(transitions)) - transitions, np.ones(len(transitions)))
    except np.linalg.LinAlgError:
        return endless
    return np.asarray(lengths if np.all((lengths > 0.0) & (lengths < LONGEST)) else endless)


def stationary_distribution(transitions: Array) -> Array:
    """Conditional stationary distribution of the states, without a signal, shape (states,), sum 1.

    The left eigenvector of the largest eigenvalue, by inverse iteration at 1: that eigenvalue is just below.
    """
    factors = linalg.lu_factor(np.eye(len(transitions)) - transitions)
    share = np.full(len(transitions), 1.0 / len(transitions))
    for _ in range(500):
        update = linalg.lu_solve(factors, share, trans=1)
        update /= update.sum()
        if np.max(np.abs(update - share)) < 1e-13:
            return np.asarray(update)
        share = update
    raise InputError("the chart must signal more seldom to have a steady state; raise its limit")


def nodes(lower: float, upper: float, count: int) -> tuple[Array, Array]:
    """Nodes and weights of Gauss-Legendre quadrature, each of shape (at least count,)."""
    at, weight = _unit_nodes(16 * ceil(count / 16))
    half = 0.5 * (upper - lower)
    return lower + half * (at + 1.0), half * weight


@lru_cache(maxsize=64)
def _unit_nodes(count: int) -> tuple[Array, Array]:
    at, weight = special.roots_legendre(count)
    return at, weight


# --- limits and the fastest chart --------------------------------------------------------------------------------


def limit_for(arl0: float, run_length: Callable[[float], float], step: float, largest: float) -> float:
    """Limit at which a run length that increases with the limit equals arl0.

    Args:
        arl0: run length without a shift.
        run_length: run length without a shift by the limit.
        step: step of the search for an upper bound.
        largest: largest limit.

    Raises:
        InputError: the limit would be beyond the largest.
    """
    from scipy import optimize  # imported here, as it takes a tenth of a start

    low, high = 1e-3, step
    while run_length(high) < arl0:
        low, high = high, high + step
        if high > largest:
            raise InputError(f"arl0 must be lower, or the shift larger: the limit would be beyond {largest:g}")
    return float(optimize.brentq(lambda limit: log(run_length(limit) / arl0), low, high, xtol=1e-9))


def fastest_parameter(
    run_length: Callable[[float], float], lowest: float, highest: float, accuracy: float = 2e-3
) -> float:
    """Parameter, to three digits, of the shortest run length; searched on a logarithmic scale."""
    from scipy import optimize  # imported here, as it takes a tenth of a start

    result = optimize.minimize_scalar(
        lambda x: run_length(exp(x)), bounds=(log(lowest), log(highest)), method="bounded", options={"xatol": accuracy}
    )
    best = min(max(float(f"{exp(float(result.x)):.3g}"), lowest), highest)
    return highest if run_length(highest) <= run_length(best) else best


# --- m out of n points beyond a limit ----------------------------------------------------------------------------


def check_rule(raise_count: int, window: int, clear_count: int) -> None:
    """Check that the numbers make a rule.

    Raises:
        ValueError: a number is outside its range; the text names it.
    """
    if not 1 <= raise_count <= window <= 12:
        raise ValueError(f"raise_count must be in [1, window] and window at most 12, got {raise_count} and {window}")
    if clear_count < 1:
        raise ValueError(f"clear_count must be at least 1, got {clear_count}")


def false_alarm_rate(raise_count: int, window: int, probability_out: float) -> float:
    """False alarm rate per point for one probability, see `false_alarm_rates`."""
    return float(false_alarm_rates(raise_count, window, np.array([probability_out]))[0])


def false_alarm_rates(raise_count: int, window: int, probabilities_out: Array) -> Array:
    """False alarm rate per point of the rule "m out of n points beyond a limit", for independent points, shape (n,).

    The inverse of the mean number of points from a clean start to the alarm, from the chain whose states are the last
    window - 1 points (Champ & Woodall 1987, Exact results for Shewhart control charts with supplementary runs rules,
    Technometrics 29(4)).

    >>> (1 / false_alarm_rates(1, 1, np.array([0.0027]))).round()
    array([370.])

    Args:
        raise_count: points beyond the limit, among the last `window`, that raise the alarm.
        window: number of points that count.
        probabilities_out: probabilities that a point is beyond the limit, shape (n,).
    """
    check_rule(raise_count, window, 1)
    after_in, after_out = _rule_transitions(raise_count, window)
    states = len(after_in)
    block, rates = max(1, (1 << 20) // states**2), []  # so many matrices are 8 MB
    for start in range(0, len(probabilities_out), block):
        p = probabilities_out[start : start + block, None, None]
        matrices = np.eye(states) - (after_in * (1 - p) + after_out * p)
        rates.append(1 / np.linalg.solve(matrices, np.ones((len(p), states, 1)))[:, 0, 0])
    return np.concatenate(rates)


@cache
def _rule_transitions(raise_count: int, window: int) -> tuple[Array, Array]:
    """Transitions without an alarm by a point within the limit, and by one beyond it, shape (states, states)."""
    states = 1 << (window - 1)
    history = np.arange(states)
    counts = np.array([int(state).bit_count() for state in history])
    after_in, after_out = np.zeros((2, states, states))
    after_in[history, (history << 1) & (states - 1)] = 1
    silent = history[counts + 1 < raise_count]
    after_out[silent, ((silent << 1) & (states - 1)) | (1 if window > 1 else 0)] = 1
    return after_in, after_out
