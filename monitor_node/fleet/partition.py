"""Whether others may have taken us for gone, so that our plants may be theirs.

Whoever shares a fleet shows a token, and sees his own as well, by way of the router. When our link breaks it goes: the
others do not see it any more either, or will not soon. When we are connected again they give our plants back, and store
what they know of them; that takes a moment. Who was frozen for long learns of it only after what had waited for him, so
the clock tells him first.

>>> second, linked = 1_000_000_000, [True]
>>> absence = Absence(lambda: linked[-1])
>>> [absence.lasts(time_s * second) for time_s in (0, 1)]
[False, False]
>>> absence.begins(now_ns=second)
>>> linked.append(False)
>>> [absence.lasts(time_s * second) for time_s in (2, 6)]
[True, True]
>>> linked.append(True)
>>> [absence.lasts(time_s * second) for time_s in (7, 8, 20)]  # twelve seconds after it looked last
[True, False, True]
"""

from collections.abc import Callable

RETURN_NS = 2_000_000_000
"""After we are connected again: by then the others have stored what they know."""

FROZEN_NS = 5_000_000_000
"""Who has not looked for so long was frozen, or has too much to do. The others wait twice as long."""


class Absence:
    """Tells how long nothing is to be judged.

    Args:
        is_connected: whether we are.
    """

    def __init__(self, is_connected: Callable[[], bool]) -> None:
        self._is_connected = is_connected
        self._until_ns = 0  # 0: others have no reason to
        self._looked_ns: int | None = None

    def begins(self, now_ns: int) -> None:
        """Our token went, or our link."""
        self._until_ns = now_ns + RETURN_NS

    def lasts(self, now_ns: int) -> bool:
        """Look whether others may have our plants; to be called all the time."""
        frozen = self._looked_ns is not None and now_ns - self._looked_ns > FROZEN_NS
        self._looked_ns = now_ns
        if frozen or (self._until_ns and not self._is_connected()):
            self.begins(now_ns)
        if now_ns >= self._until_ns:
            self._until_ns = 0
        return self._until_ns > 0
