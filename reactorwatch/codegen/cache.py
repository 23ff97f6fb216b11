"""An on-disk cache of machine code, shared by the processes of a user.

A diagnosis fits some sixty models, and compiling them takes a fifth of its time. An entry is named by a digest of the
function, the compiler and the processor, so it is never wrong, only no longer requested. Where the folder cannot be
written to, every process compiles for itself.
"""

import hashlib
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import platformdirs

CAPACITY, EVICTED = 4000, 1000
"""Number of entries, of some 30 kB each, and how many of the oldest are evicted when there are more."""

_DIGEST_BYTES = hashlib.sha256().digest_size


class CodeCache:
    """A folder of machine code.

    Args:
        folder: folder of the entries; made with the first one.
        capacity: largest number of entries.
        evicted: number of the oldest entries that are evicted when there are more.
    """

    def __init__(self, folder: Path, capacity: int = CAPACITY, evicted: int = EVICTED) -> None:
        self._folder, self._capacity, self._evicted = folder, capacity, evicted

    def get_or_make(self, name: str, make: Callable[[], bytes]) -> bytes:
        """Return the entry of a name; make and store it if it is missing or damaged.

        Args:
            name: a digest of everything that the code depends on.
            make: compiles the code.
        """
        path = self._folder / name
        try:
            entry = path.read_bytes()
        except OSError:  # missing or unreadable
            entry = b""
        digest, code = entry[:_DIGEST_BYTES], entry[_DIGEST_BYTES:]
        if digest != hashlib.sha256(code).digest():
            code = make()
            self._store(path, code)
        return code

    def _store(self, path: Path, code: bytes) -> None:
        """Write to a temporary file and rename it, as other processes read and write at the same time."""
        temporary = path.with_name(f"{path.name}.{os.getpid()}")
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(hashlib.sha256(code).digest() + code)
            temporary.replace(path)
            self._evict()
        except OSError:  # the disk is full or not writable: the code is compiled again next time
            with suppress(OSError):
                temporary.unlink()

    def _evict(self) -> None:
        entries = [item for item in os.scandir(self._folder) if item.is_file()]
        if len(entries) > self._capacity:
            for item in sorted(entries, key=lambda item: item.stat().st_mtime_ns)[: self._evicted]:
                Path(item.path).unlink(missing_ok=True)


def user_cache() -> CodeCache:
    """The cache of the current user."""
    return CodeCache(platformdirs.user_cache_path("reactorwatch") / "machine_code")
