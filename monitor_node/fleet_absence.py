"""Whether the others may have taken us for gone, so that our plants may be theirs.

Whoever shares a fleet shows a token, and sees his own as well. When our link breaks it goes, as do those of all others:
then they do not see ours any more either, or will not soon. When it is there again the others give our plants back, and
store what they remember of them; that takes a moment. Who was frozen for long learns of it only after what had waited
for him, so the clock tells him first.

>>> absence = Absence()
>>> second = 1_000_000_000
>>> [absence.lasts(time_s * second) for time_s in (0, 1)]
[False, False]
>>> absence.seen(is_seen=False, now_ns=second)
>>> absence.lasts(2 * second)
True
>>> absence.seen(is_seen=True, now_ns=3 * second)
>>> [absence.lasts(time_s * second) for time_s in (3, 4, 5, 15)]  # the last is ten seconds later
[True, True, False, True]
"""

RETURN_NS = 2_000_000_000
"""After our token is seen again: by then the others have stored what they remember."""

FROZEN_NS = 5_000_000_000
"""Who has not looked for so long was frozen, or has too much to do; half the lease after which others take over."""


class Absence:
    """Tells how long nothing is to be judged."""

    def __init__(self) -> None:
        self._is_seen = True
        self._until_ns = 0
        self._looked_ns: int | None = None

    def seen(self, *, is_seen: bool, now_ns: int) -> None:
        """Our own token came or went."""
        if is_seen and not self._is_seen:
            self._until_ns = now_ns + RETURN_NS
        self._is_seen = is_seen

    def lasts(self, now_ns: int) -> bool:
        """Look whether the others may have our plants; to be called all the time."""
        if self._looked_ns is not None and now_ns - self._looked_ns > FROZEN_NS:
            self._until_ns = now_ns + RETURN_NS
        self._looked_ns = now_ns
        return not self._is_seen or now_ns < self._until_ns
