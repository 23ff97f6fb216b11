"""Run length of the rule "m out of n points beyond a limit", for independent points.

From the Markov chain over the last n - 1 points, after Champ & Woodall (1987), Exact results for Shewhart control
charts with supplementary runs rules, Technometrics 29(4).
"""

from functools import cache

import numpy as np

from reactorwatch.arrays import Array

MOST_CELLS = 1 << 20
"""Most cells of matrices that are solved at once."""


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
    """False alarm rate per point, for independent points.

    The inverse of the mean number of points from a clean start to the alarm, from the absorbing Markov chain whose
    states are the last window - 1 points.

    Args:
        raise_count: points beyond the limit, among the last `window`, that raise the alarm.
        window: number of points that count.
        probability_out: probability that a point is beyond the limit.

    >>> round(1 / false_alarm_rate(1, 1, 0.0027))
    370
    """
    return float(false_alarm_rates(raise_count, window, np.array([probability_out]))[0])


def false_alarm_rates(raise_count: int, window: int, probabilities_out: Array) -> Array:
    """False alarm rate per point for several probabilities, shape (n,), see `false_alarm_rate`."""
    check_rule(raise_count, window, 1)
    after_in, after_out = _transitions(raise_count, window)
    states = len(after_in)
    block, rates = max(1, MOST_CELLS // states**2), []
    for start in range(0, len(probabilities_out), block):
        p = probabilities_out[start : start + block, None, None]
        matrices = np.eye(states) - (after_in * (1 - p) + after_out * p)
        rates.append(1 / np.linalg.solve(matrices, np.ones((len(p), states, 1)))[:, 0, 0])
    return np.concatenate(rates)


@cache
def _transitions(raise_count: int, window: int) -> tuple[Array, Array]:
    """Transitions without an alarm by a point within the limit, and by one beyond it, shape (states, states)."""
    states = 1 << (window - 1)
    history = np.arange(states)
    counts = np.array([int(state).bit_count() for state in history])
    after_in, after_out = np.zeros((2, states, states))
    after_in[history, (history << 1) & (states - 1)] = 1
    silent = history[counts + 1 < raise_count]
    after_out[silent, ((silent << 1) & (states - 1)) | (1 if window > 1 else 0)] = 1
    return after_in, after_out
