"""On-delay and off-delay of an alarm (ISA-18.2) as an m-out-of-n rule.

One point beyond 3 sigma comes by chance every 370 samples: at ten samples a minute, every 37 minutes. No operator could
work with that. So an alarm is raised by `raise_count` violating points among the last `window` (on-delay), and cleared
by `clear_count` normal points in a row (off-delay). With a dead band a point near the limit is neither violating nor
normal, so that a value near its limit gives one alarm and not many. The remaining rate of false alarms is
`spc.m_of_n.false_alarm_rate`.
"""

from dataclasses import dataclass

from reactorwatch.spc.m_of_n import check_rule


@dataclass
class OnOffDelayState:
    """The last points, newest in the lowest bit (1: violating); the number of normal points in a row; the condition."""

    recent: int = 0
    in_a_row: int = 0
    standing: bool = False


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
        state.recent = ((state.recent << 1) | violating) & self._mask
        state.in_a_row = state.in_a_row + 1 if normal or (normal is None and not violating) else 0
        if state.standing:
            if state.in_a_row >= self._clear_count:
                state.standing, state.recent = False, 0
                return False
        elif violating and state.recent.bit_count() >= self._raise_count:
            state.standing = True
            return True
        return None
