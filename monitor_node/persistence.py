"""When points that are out become an alarm, and when the alarm is over.

One point beyond 3 sigma comes by chance every 370 samples: at ten samples a minute, every 37 minutes. Nobody could live
with that. So an alarm takes `raise_count` points out among the last `window` (the on-delay of ISA-18.2), and ends
after `clear_count` points in a row that are back in (its off-delay), where back in may ask for more than not out: a
dead band, so that a value which stays near its limit makes one alarm and not many. How often chance alone still
raises it is not a matter of taste but of a Markov chain over the last window - 1 points: `false_alarm_rate`, after
Champ & Woodall (1987), Exact results for Shewhart control charts with supplementary runs rules, Technometrics 29(4).
It holds for independent points.
"""

from dataclasses import dataclass

import numpy as np


@dataclass
class PersistenceState:
    """What is remembered: the last points, newest in the lowest bit (1: out), and how many in a row were back in."""

    recent: int = 0
    in_a_row: int = 0
    standing: bool = False


class Persistence:
    """The rule that raises and clears one alarm.

    Args:
        raise_count: points out among the last `window` that raise it.
        window: how many points are looked at.
        clear_count: points in a row that must be in to clear it.

    Raises:
        ValueError: numbers that make no rule.
    """

    def __init__(self, raise_count: int, window: int, clear_count: int) -> None:
        check_rule(raise_count, window, clear_count)
        self._raise_count, self._clear_count = raise_count, clear_count
        self._mask = (1 << window) - 1
        self.state = PersistenceState()

    def update(self, out: bool, back_in: bool | None = None) -> bool | None:
        """Take the next point in.

        Args:
            out: whether it is beyond a limit.
            back_in: whether it is within the limits by the dead band; not given, it is what is not out.

        Returns:
            True if the alarm is raised by it, False if it is cleared by it, None if nothing changes.
        """
        state = self.state
        state.recent = ((state.recent << 1) | out) & self._mask
        state.in_a_row = state.in_a_row + 1 if back_in or (back_in is None and not out) else 0
        if state.standing:
            if state.in_a_row >= self._clear_count:
                state.standing, state.recent = False, 0
                return False
        elif out and state.recent.bit_count() >= self._raise_count:
            state.standing = True
            return True
        return None


def check_rule(raise_count: int, window: int, clear_count: int) -> None:
    """Whether numbers make a rule.

    Raises:
        ValueError: they don't; the text names which and why.
    """
    if not 1 <= raise_count <= window <= 12:
        raise ValueError(f"raise_count must be in [1, window] and window at most 12, got {raise_count} and {window}")
    if clear_count < 1:
        raise ValueError(f"clear_count must be at least 1, got {clear_count}")


def false_alarm_rate(raise_count: int, window: int, probability_out: float) -> float:
    """How often chance raises an alarm, a point, in the long run and for independent points.

    The inverse of the mean number of points from a clean start to the alarm, from the absorbing Markov chain whose
    states are the last window - 1 points.

    Args:
        raise_count: see `Persistence`.
        window: see `Persistence`.
        probability_out: that a point is out.

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
