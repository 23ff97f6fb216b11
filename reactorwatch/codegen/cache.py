"""Machine code that is kept on disk, so that the next program need not make it again.

A diagnosis looks at some sixty models, and to make their machine code takes a fifth of its time. What is kept is named
by a digest of the function, of the compiler and of the processor, so it is never wrong, only no longer asked for.
Without a folder that can be written to all goes on, only slower.
"""

import hashlib
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import platformdirs

KEPT, REMOVED = 4000, 1000
"""How many functions are kept, of some 30 kB each; beyond that so many of the oldest go."""

_DIGEST_BYTES = hashlib.sha256().digest_size


class MachineStore:
    """A folder of machine code.

    Args:
        folder: it; made when something is kept.
        kept: how many functions at most.
        removed: how many of the oldest go where there are more.
    """

    def __init__(self, folder: Path, kept: int = KEPT, removed: int = REMOVED) -> None:
        self._folder, self._kept, self._removed = folder, kept, removed

    def code(self, name: str, make: Callable[[], bytes]) -> bytes:
        """What is kept under a name; if there is nothing, or it is damaged, it is made and kept.

        Args:
            name: a digest of all that it depends on.
            make: makes it.
        """
        path = self._folder / name
        try:
            digest, code = _parted(path.read_bytes())
        except OSError:  # it is not there, or not to be had
            digest, code = b"", b""
        if digest != hashlib.sha256(code).digest():
            code = make()
            self._keep(path, code)
        return code

    def _keep(self, path: Path, code: bytes) -> None:
        """Written beside and renamed, for others read and write at the same time."""
        beside = path.with_name(f"{path.name}.{os.getpid()}")
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            beside.write_bytes(hashlib.sha256(code).digest() + code)
            beside.replace(path)
            self._tidied()
        except OSError:  # no room, or not ours: it will be made again the next time
            with suppress(OSError):
                beside.unlink()

    def _tidied(self) -> None:
        found = [item for item in os.scandir(self._folder) if item.is_file()]
        if len(found) > self._kept:
            for item in sorted(found, key=lambda item: item.stat().st_mtime_ns)[: self._removed]:
                Path(item.path).unlink(missing_ok=True)


def users_store() -> MachineStore:
    """That of the user who runs the program."""
    return MachineStore(platformdirs.user_cache_path("reactorwatch") / "machine_code")


def _parted(whole: bytes) -> tuple[bytes, bytes]:
    return whole[:_DIGEST_BYTES], whole[_DIGEST_BYTES:]
