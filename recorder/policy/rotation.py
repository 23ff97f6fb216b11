"""When a recording is flushed and synced, and when it is time for a new file. Pure: it is told the time and the size.

A recorder that is killed loses what it had not handed to the operating system, so that is done twice a second; a
machine that loses its power loses what was not synced. How often that is done is a choice between safety and the disk's
patience.
"""

from typing import Literal

Fsync = Literal["never", "chunk", "second"]

SECOND_NS = 1_000_000_000
NEVER_NS = 2**63 - 1


class Filing:
    """The moments of one recording.

    A clock that is set back would put off what is due by as much, so all moments are then moved back with it.

    Args:
        flush_ns: between two flushes, as long as there is something to flush.
        fsync: sync never, after each flush, or once a second.
        rotate_ns: age of a file at which a new one is begun; infinite: never.
        rotate_bytes: its size, likewise.
        now_ns: when the first file is begun.
    """

    def __init__(self, flush_ns: int, fsync: Fsync, rotate_ns: float, rotate_bytes: float, now_ns: int) -> None:
        self._flush_ns, self._fsync = flush_ns, fsync
        self._rotate_ns, self._rotate_bytes = rotate_ns, rotate_bytes
        self._now_ns = now_ns
        self.began(now_ns)

    def began(self, now_ns: int) -> None:
        """A new file was begun."""
        self._began_ns = self._synced_ns = self._oldest_ns = now_ns
        self._written = self._unflushed = 0
        self._unsynced = False

    def wrote(self, now_ns: int) -> None:
        """A message was written."""
        if not self._unflushed:
            self._oldest_ns = now_ns
        self._unflushed += 1
        self._written += 1

    def flushed(self) -> None:
        """All that was written was handed over."""
        self._unsynced = self._unsynced or bool(self._unflushed)
        self._unflushed = 0

    def synced(self, now_ns: int) -> None:
        """All that was handed over is on the disk."""
        self._unsynced = False
        self._synced_ns = now_ns

    @property
    def unflushed(self) -> int:
        """Messages that a kill would lose now."""
        return self._unflushed

    def flush_is_due(self, now_ns: int) -> bool:
        """Whether there is something that has waited long enough."""
        self._see(now_ns)
        return bool(self._unflushed) and now_ns - self._oldest_ns >= self._flush_ns

    def sync_is_due(self, now_ns: int) -> bool:
        """Whether something was handed over that should be on the disk by now."""
        self._see(now_ns)
        if not self._unsynced or self._fsync == "never":
            return False
        return self._fsync == "chunk" or now_ns - self._synced_ns >= SECOND_NS

    def is_full(self, now_ns: int, size_bytes: int) -> bool:
        """Whether what comes next belongs into a new file; one without a message is never full."""
        self._see(now_ns)
        if not self._written:
            return False
        return now_ns - self._began_ns >= self._rotate_ns or size_bytes >= self._rotate_bytes

    def next_due_ns(self) -> int:
        """When something is due if nothing comes until then."""
        if self._unflushed:
            return self._oldest_ns + self._flush_ns
        if self._unsynced and self._fsync != "never":
            return self._synced_ns + SECOND_NS
        return NEVER_NS

    def _see(self, now_ns: int) -> None:
        back_ns = self._now_ns - now_ns
        if back_ns > 0:
            self._began_ns -= back_ns
            self._oldest_ns -= back_ns
            self._synced_ns -= back_ns
        self._now_ns = now_ns
