"""Ages of recordings by a clock that cannot be set.

The wall clock may be wrong at boot and may be set by years; that must not delete a recording. So the age of a recording
is the time confirmed by the clock since boot: the time in which the machine ran, with or without a recorder. It counts
from the time at which a recorder completed or found the file. A small file beside the recordings carries it over a
restart.
"""

import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import msgspec
import structlog

from reactorwatch.errors import InputError
from reactorwatch.limits import parse_json
from reactorwatch.records.write import atomic_write

log = structlog.get_logger()

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class BootClock(NamedTuple):
    """Reading of the clock since boot.

    Attributes:
        boot: identifier of the boot; empty if unknown: readings of two processes then cannot be compared.
        since_ns: time since boot, suspended or not.
    """

    boot: str
    since_ns: int


def read_boot_clock() -> BootClock:
    """Read the clock since boot."""
    try:
        boot = _BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return BootClock("", time.monotonic_ns())
    return BootClock(boot, time.clock_gettime_ns(time.CLOCK_BOOTTIME))


class _FirstSeen(msgspec.Struct, frozen=True):
    """A reused name with another modification time is another file."""

    modified_ns: int
    seen_ns: int


class _StoredAges(msgspec.Struct, frozen=True):
    boot: str
    since_ns: int
    now_ns: int
    seen: dict[str, _FirstSeen]


class Ages:
    """Confirmed times at which recordings were first seen complete.

    Args:
        path: file in which they are stored.
        read_clock: reads the clock since boot.
    """

    def __init__(self, path: Path, read_clock: Callable[[], BootClock] = read_boot_clock) -> None:
        self._path = path
        self._read_clock = read_clock
        self._start = read_clock()
        self._start_ns = 0
        self._seen: dict[str, _FirstSeen] = {}
        self._noted: dict[str, _FirstSeen] = {}
        try:
            stored = msgspec.convert(parse_json(path.read_bytes()), _StoredAges)
        except FileNotFoundError:
            return
        except (OSError, InputError, msgspec.ValidationError) as error:
            log.warning("ages of recordings count from now", file=str(path), why=str(error))
            return
        same = stored.boot == self._start.boot != "" and stored.since_ns <= self._start.since_ns
        self._start_ns = stored.now_ns + (self._start.since_ns - stored.since_ns if same else 0)
        self._seen = stored.seen

    def now_ns(self) -> int:
        """Confirmed time."""
        return self._start_ns + self._read_clock().since_ns - self._start.since_ns

    def add(self, name: str, modified_ns: int) -> None:
        """Add a recording that was completed now; thread-safe."""
        self._noted[name] = _FirstSeen(modified_ns, self.now_ns())

    def update(self, modified_ns: Iterable[tuple[str, int]]) -> dict[str, int]:
        """Replace the set of existing recordings.

        Args:
            modified_ns: name and modification time of each recording.

        Returns:
            Confirmed time at which each was first seen, by name.
        """
        now_ns = self.now_ns()
        before, self._seen = self._seen, {}
        for name, modified in modified_ns:
            seen = self._noted.pop(name, before.get(name))
            if seen is None or seen.modified_ns != modified:
                seen = _FirstSeen(modified, now_ns)
            self._seen[name] = seen
        return {name: seen.seen_ns for name, seen in self._seen.items()}

    def store(self) -> None:
        """Write the file, so that the next recorder resumes from it.

        Raises:
            OSError: it cannot be written.
            InputError: the folder was deleted.
        """
        since_ns = self._read_clock().since_ns
        now_ns = self._start_ns + since_ns - self._start.since_ns
        stored = _StoredAges(self._start.boot, since_ns, now_ns, self._seen)
        with atomic_write(self._path) as temporary:
            temporary.write_bytes(msgspec.json.encode(stored))
