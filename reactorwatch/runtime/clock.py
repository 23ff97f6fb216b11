"""The clock that the loop of a node goes by: that of the machine, but it never runs backwards and never stands still.

Pace, health, flushing and patience are all due at times of this clock. If the machine's clock is set forward, it
follows at once: what is due is done. If it is set back, it goes on from where it was, somewhat slower than time, until
the machine's has caught up; a node that followed would do nothing for as long as the clock was set back.
"""

import threading
import time
from collections.abc import Callable

CATCHING_UP = 0.9
"""Of the speed of time, while it is ahead of the machine's clock."""


class SteadyClock:
    """May be read from any thread.

    Args:
        wall_ns: reads the machine's clock.
        monotonic_ns: reads one that nobody sets.
    """

    def __init__(
        self, wall_ns: Callable[[], int] = time.time_ns, monotonic_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._wall_ns, self._monotonic_ns = wall_ns, monotonic_ns
        self._lock = threading.Lock()
        self._read_ns, self._told_ns = monotonic_ns(), wall_ns()

    def now_ns(self) -> int:
        """Nanoseconds since 1970-01-01 UTC."""
        with self._lock:
            read_ns = self._monotonic_ns()
            slow_ns = self._told_ns + int(CATCHING_UP * (read_ns - self._read_ns))
            self._read_ns, self._told_ns = read_ns, max(self._wall_ns(), slow_ns)
            return self._told_ns
