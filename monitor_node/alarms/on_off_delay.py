"""When points that are out become an alarm, and when the alarm is over.

One point beyond 3 sigma comes by chance every 370 samples: at ten samples a minute, every 37 minutes. Nobody could live
with that. So an alarm takes `raise_count` points out among the last `window` (the on-delay of ISA-18.2), and ends
after `clear_count` points in a row that are back in (its off-delay), where back in may ask for more than not out: a
dead band, so that a value which stays near its limit makes one alarm and not many. The rate of false alarms that is
left is `spc.m_of_n.false_alarm_rate`.
"""

from dataclasses import dataclass

from reactorwatch.spc.m_of_n import check_rule


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
