"""Ages of recordings by a clock that cannot be set.

The wall clock may be wrong when the machine starts, and may be set by years; it must not delete anything. So the age of
a recording counts only the time that the clock since the machine's start confirms: the time in which the machine runs,
with or without a recorder. It counts from the moment at which a recorder completed the file or found it, and goes on
after a restart, by a small file beside the recordings.
"""

import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import msgspec
import structlog

from reactorwatch.records.atomic import atomic_write

log = structlog.get_logger()

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class BootClock(NamedTuple):
    """A reading of the clock since the machine's start.

    Attributes:
        boot: names that start; empty: it has no name, and readings of two processes cannot be compared.
        since_ns: the time since then, suspended or not.
    """

    boot: str
    since_ns: int


def read_boot_clock() -> BootClock:
    """Read the clock since the machine's start."""
    try:
        boot = _BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return BootClock("", time.monotonic_ns())
    return BootClock(boot, time.clock_gettime_ns(time.CLOCK_BOOTTIME))


class _Seen(msgspec.Struct, frozen=True):
    modified_ns: int  # by which a new file of an old name is another file
    seen_ns: int


class _Stored(msgspec.Struct, frozen=True):
    boot: str
    since_ns: int
    now_ns: int
    seen: dict[str, _Seen]


class Ages:
    """When recordings were first seen complete, on a time that only the clock since the machine's start moves on.

    Args:
        path: the file beside the recordings.
        read_clock: reads that clock.
    """

    def __init__(self, path: Path, read_clock: Callable[[], BootClock] = read_boot_clock) -> None:
        self._path = path
        self._read_clock = read_clock
        self._start = read_clock()
        self._start_ns = 0
        self._seen: dict[str, _Seen] = {}
        self._noted: dict[str, _Seen] = {}
        try:
            stored = msgspec.json.decode(path.read_bytes(), type=_Stored)
        except FileNotFoundError:
            return
        except (OSError, msgspec.MsgspecError) as error:
            log.warning("ages of recordings count from now", file=str(path), why=str(error))
            return
        same = stored.boot == self._start.boot != "" and stored.since_ns <= self._start.since_ns
        self._start_ns = stored.now_ns + (self._start.since_ns - stored.since_ns if same else 0)
        self._seen = stored.seen

    def now_ns(self) -> int:
        """The confirmed time."""
        return self._start_ns + self._read_clock().since_ns - self._start.since_ns

    def note(self, name: str, modified_ns: int) -> None:
        """Note that a recording was completed now; from any thread."""
        self._noted[name] = _Seen(modified_ns, self.now_ns())

    def see(self, modified_ns: Iterable[tuple[str, int]]) -> dict[str, int]:
        """Note which recordings are there.

        Args:
            modified_ns: the name of each, and when its file says that it was modified.

        Returns:
            The confirmed time at which each was first seen, by name.
        """
        now_ns = self.now_ns()
        before, self._seen = self._seen, {}
        for name, modified in modified_ns:
            seen = self._noted.pop(name, before.get(name))
            if seen is None or seen.modified_ns != modified:
                seen = _Seen(modified, now_ns)
            self._seen[name] = seen
        return {name: seen.seen_ns for name, seen in self._seen.items()}

    def store(self) -> None:
        """Write the file, so that the next recorder goes on from here.

        Raises:
            OSError: it cannot be written.
            InputError: the folder is gone.
        """
        since_ns = self._read_clock().since_ns
        now_ns = self._start_ns + since_ns - self._start.since_ns
        stored = _Stored(self._start.boot, since_ns, now_ns, self._seen)
        with atomic_write(self._path) as temporary:
            temporary.write_bytes(msgspec.json.encode(stored))
