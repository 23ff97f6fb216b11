"""Clock of a node's loop: the machine's clock, but it never runs backwards and never stops.

All deadlines are times of this clock. If the machine's clock is set forward, this one follows at once. If it is set
back, this one slews: it runs somewhat slower than time until the machine's clock has caught up; a node that followed
would be idle for as long as the clock was set back.
"""

import threading
import time
from collections.abc import Callable

SLEW_RATE = 0.9
"""Speed, relative to time, while this clock is ahead of the machine's."""


class SteadyClock:
    """A clock that may be read from any thread.

    Args:
        wall_ns: reads the machine's clock.
        monotonic_ns: reads a clock that cannot be set.
    """

    def __init__(
        self, wall_ns: Callable[[], int] = time.time_ns, monotonic_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._wall_ns, self._monotonic_ns = wall_ns, monotonic_ns
        self._lock = threading.Lock()
        self._monotonic, self._now_ns = monotonic_ns(), wall_ns()

    def now_ns(self) -> int:
        """Nanoseconds since 1970-01-01 UTC."""
        with self._lock:
            monotonic = self._monotonic_ns()
            slewed_ns = self._now_ns + int(SLEW_RATE * (monotonic - self._monotonic))
            self._monotonic, self._now_ns = monotonic, max(self._wall_ns(), slewed_ns)
            return self._now_ns
