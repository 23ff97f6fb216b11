"""Run length of the rule "m out of n points beyond a limit", for independent points.

From the Markov chain over the last n - 1 points, after Champ & Woodall (1987), Exact results for Shewhart control
charts with supplementary runs rules, Technometrics 29(4).
"""

import numpy as np


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
    check_rule(raise_count, window, 1)
    states = 1 << (window - 1)
    history = np.arange(states)
    counts = np.array([int(state).bit_count() for state in history])
    transition = np.zeros((states, states))
    after_in = (history << 1) & (states - 1)
    after_out = after_in | (1 if window > 1 else 0)
    transition[history, after_in] += 1 - probability_out
    silent = counts + 1 < raise_count
    transition[history[silent], after_out[silent]] += probability_out
    run_length = np.linalg.solve(np.eye(states) - transition, np.ones(states))
    return float(1 / run_length[0])
