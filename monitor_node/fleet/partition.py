"""Detect that our lease may have expired while we were partitioned, so that others may own our plants.

Each monitor of a fleet shows a liveliness token, and sees its own by way of the router. When its link breaks the token
is withdrawn, here and soon for the others. When it is connected again the others release its plants and store their
states, which takes a moment. A stalled process receives that only after its delayed messages, so its clock decides
first.

>>> second, linked = 1_000_000_000, [True]
>>> lease = LeaseMonitor(lambda: linked[-1])
>>> [lease.is_expired(time_s * second) for time_s in (0, 1)]
[False, False]
>>> lease.expire(now_ns=second)
>>> linked.append(False)
>>> [lease.is_expired(time_s * second) for time_s in (2, 6)]
[True, True]
>>> linked.append(True)
>>> [lease.is_expired(time_s * second) for time_s in (7, 8, 20)]  # twelve seconds after its last check
[True, False, True]
"""

from collections.abc import Callable

RETURN_NS = 2_000_000_000
"""Time after reconnection in which the others store their states."""

STALLED_NS = 5_000_000_000
"""A monitor without a check for this long was stalled or overloaded. The others wait twice as long."""


class LeaseMonitor:
    """Lease on the own plants; while it may have expired, nothing is evaluated.

    Args:
        is_connected: returns True while there is a router.
    """

    def __init__(self, is_connected: Callable[[], bool]) -> None:
        self._is_connected = is_connected
        self._until_ns = 0  # 0: not expired
        self._checked_ns: int | None = None

    def expire(self, now_ns: int) -> None:
        """Expire the lease: the own token or the link is gone."""
        self._until_ns = now_ns + RETURN_NS

    def is_expired(self, now_ns: int) -> bool:
        """True if others may own our plants; to be called at every event."""
        stalled = self._checked_ns is not None and now_ns - self._checked_ns > STALLED_NS
        self._checked_ns = now_ns
        if stalled or (self._until_ns and not self._is_connected()):
            self.expire(now_ns)
        if now_ns >= self._until_ns:
            self._until_ns = 0
        return self._until_ns > 0
