"""On-delay and off-delay of an alarm (ISA-18.2) as an m-out-of-n rule.

One point beyond 3 sigma comes by chance every 370 samples: at ten samples a minute, every 37 minutes. No operator could
work with that. So an alarm is raised by `raise_count` violating points among the last `window` (on-delay), and cleared
by `clear_count` normal points in a row (off-delay). With a dead band a point near the limit is neither violating nor
normal, so that a value near its limit gives one alarm and not many. The remaining rate of false alarms is
`spc.m_of_n.false_alarm_rate`.
"""

from dataclasses import dataclass

import numpy as np

from reactorwatch.codegen.numba_kernel import Entry, jit
from reactorwatch.spc.m_of_n import check_rule


@dataclass
class OnOffDelayState:
    """The last points, newest in the lowest bit (1: violating); the number of normal points in a row; the condition."""

    recent: int = 0
    in_a_row: int = 0
    standing: bool = False


DELAY = np.dtype([("recent", "i4"), ("in_a_row", "i4"), ("above", "i4")], align=True)
"""Numbers of an alarm that is not active: last points, normal points in a row, 1 if its last limit was the upper."""


@jit
def add_point(recent: int, in_a_row: int, mask: int, violating: bool, normal: bool) -> tuple[int, int]:
    """Last points and number of normal points in a row, with the next point."""
    return ((recent << 1) | (1 if violating else 0)) & mask, in_a_row + 1 if normal else 0


@jit
def raises(recent: int, raise_count: int, violating: bool) -> bool:
    """True if the last points raise an alarm that is not active."""
    count = 0
    while recent:
        count += recent & 1
        recent >>= 1
    return violating and count >= raise_count


@jit
def is_normal(statistic: float, centre: float, lower: float, upper: float, above: bool, reach: float) -> bool:
    """True if a point is within the limit that was crossed, by the dead band.

    Args:
        statistic: statistic of the point.
        centre: centre of the chart.
        lower: lower limit.
        upper: upper limit.
        above: True if the upper limit was crossed.
        reach: share of the way from the centre to the limit that is normal.
    """
    deviation = statistic - centre
    return deviation <= reach * (upper - centre) if above else deviation >= reach * (lower - centre)


_ADD_POINT, _RAISES, IS_NORMAL = Entry(add_point), Entry(raises), Entry(is_normal)


class OnOffDelay:
    """Delays of one alarm.

    Args:
        raise_count: number of violating points among the last `window` that raises the alarm.
        window: number of points in the window.
        clear_count: number of normal points in a row that clears the alarm.

    Raises:
        ValueError: the numbers make no rule.
    """

    def __init__(self, raise_count: int, window: int, clear_count: int) -> None:
        check_rule(raise_count, window, clear_count)
        self._raise_count, self._clear_count = raise_count, clear_count
        self._mask = (1 << window) - 1
        self.state = OnOffDelayState()

    def update(self, violating: bool, normal: bool | None = None) -> bool | None:
        """Update the rule with the next point.

        Args:
            violating: True if the point is beyond a limit.
            normal: True if the point is within the limits by the dead band; None: if it is not violating.

        Returns:
            True if the alarm is raised, False if it is cleared, None if nothing changes.
        """
        state = self.state
        if normal is None:
            normal = not violating
        state.recent, state.in_a_row = _ADD_POINT.call(state.recent, state.in_a_row, self._mask, violating, normal)
        if state.standing:
            if state.in_a_row >= self._clear_count:
                state.standing, state.recent = False, 0
                return False
        elif _RAISES.call(state.recent, self._raise_count, violating):
            state.standing = True
            return True
        return None
