"""Schedule of flushes, syncs and file rotation. Pure: time and size are arguments.

A recorder that is killed loses what it had not handed to the operating system, so it flushes twice a second. A machine
that loses its power loses what was not synced. The sync period trades safety against disk load.
"""

from typing import Literal

from reactorwatch.records.record import NEVER_NS

Fsync = Literal["never", "chunk", "second"]

SECOND_NS = 1_000_000_000


class FlushAndRotation:
    """Schedule of one recording.

    A clock that is set back would delay everything by as much, so all stored times are moved back with it.

    Args:
        flush_ns: time between two flushes while there is something to flush.
        fsync: sync never, after each flush, or once a second.
        rotate_ns: age of a file at which a new one is started; inf never starts one.
        rotate_bytes: size of a file at which a new one is started; inf never starts one.
        now_ns: start time of the first file.
    """

    def __init__(self, flush_ns: int, fsync: Fsync, rotate_ns: float, rotate_bytes: float, now_ns: int) -> None:
        self._flush_ns, self._fsync = flush_ns, fsync
        self._rotate_ns, self._rotate_bytes = rotate_ns, rotate_bytes
        self._now_ns = now_ns
        self.start_file(now_ns)

    def start_file(self, now_ns: int) -> None:
        """Restart all times for a new file."""
        self._start_ns = self._synced_ns = self._oldest_ns = now_ns
        self._is_empty = True
        self.unflushed = 0  # messages that a kill would lose now
        self._unsynced = False

    def count_message(self, now_ns: int) -> None:
        """Count a message that was written."""
        if not self.unflushed:
            self._oldest_ns = now_ns
        self.unflushed += 1
        self._is_empty = False

    def mark_flushed(self) -> None:
        """Note that everything written was flushed."""
        self._unsynced = self._unsynced or bool(self.unflushed)
        self.unflushed = 0

    def mark_synced(self, now_ns: int) -> None:
        """Note that everything flushed is on the disk."""
        self._unsynced = False
        self._synced_ns = now_ns

    def flush_is_due(self, now_ns: int) -> bool:
        """True if the oldest unflushed message has waited for the flush period."""
        self._follow_clock(now_ns)
        return bool(self.unflushed) and now_ns - self._oldest_ns >= self._flush_ns

    def sync_is_due(self, now_ns: int) -> bool:
        """True if something was flushed and the policy asks for a sync now."""
        if not self._unsynced or self._fsync == "never":
            return False
        self._follow_clock(now_ns)
        return self._fsync == "chunk" or now_ns - self._synced_ns >= SECOND_NS

    def is_full(self, now_ns: int, size_bytes: int) -> bool:
        """True if the next message belongs into a new file; a file without messages is never full."""
        self._follow_clock(now_ns)
        if self._is_empty:
            return False
        return now_ns - self._start_ns >= self._rotate_ns or size_bytes >= self._rotate_bytes

    def next_due_ns(self) -> int:
        """Time of the next flush or sync if no message arrives until then."""
        if self.unflushed:
            return self._oldest_ns + self._flush_ns
        if self._unsynced and self._fsync != "never":
            return self._synced_ns + SECOND_NS
        return NEVER_NS

    def _follow_clock(self, now_ns: int) -> None:
        back_ns = self._now_ns - now_ns
        if back_ns > 0:
            self._start_ns -= back_ns
            self._oldest_ns -= back_ns
            self._synced_ns -= back_ns
        self._now_ns = now_ns
