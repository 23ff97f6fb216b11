"""File of an incomplete recording, locked so that no other process takes it for an orphan.

Bytes are buffered in memory, and `drain` hands them to the operating system: only there a full disk shows. Drained
bytes survive the process, synced bytes the machine. The lock ends with the process, so a file without a lock is an
orphan.
"""

import contextlib
import errno
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode

from reactorwatch.errors import InputError

PART = ".part"
"""Ending of an incomplete recording."""
DELETED = "its file was deleted"


class PartFile:
    """New append-only file, with a lock; the stream of the library's writer.

    Args:
        path: the file; it must not exist.

    Attributes:
        chunk_end: end of the last chunk that was written, from the start of the file.
        drained: number of bytes handed to the operating system.

    Raises:
        OSError: it cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.chunk_end = self.drained = 0
        self._raw = path.open("xb", buffering=0)
        fcntl.flock(self._raw, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._pending = bytearray()

    def write(self, data: bytes) -> int:
        """Buffer bytes; the library writes a chunk record in one call."""
        self._pending += data
        if data[:1] == _CHUNK:
            self.chunk_end = self.tell()
        return len(data)

    def tell(self) -> int:
        """Number of bytes written, buffered ones included."""
        return self.drained + len(self._pending)

    def flush(self) -> None:
        """Do nothing: the library's writer calls it, and must never meet a full disk."""

    def drain(self) -> None:
        """Hand the buffer to the operating system; after an error it may be called again.

        Raises:
            OSError: the write failed, for example on a full disk, perhaps after part of the buffer; or the file was
                deleted, so that writes would succeed and be lost.
        """
        while self._pending:
            taken = self._append(self._pending)
            self.drained += taken
            del self._pending[:taken]
        if self._is_deleted:
            raise OSError(errno.ENOENT, DELETED)

    def sync(self) -> None:
        """Drain, and wait until all bytes are on the disk.

        Raises:
            OSError: as `drain`, or the sync failed.
        """
        self.drain()
        os.fsync(self._raw.fileno())

    def finish(self, path: Path) -> None:
        """Sync, rename to `path` while the lock is held, and close: a complete file is on the disk.

        Raises:
            OSError: as `sync`, or it cannot be renamed; it is closed under its old name.
        """
        try:
            self.sync()
            self.path.rename(path)
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close and drop the buffer; a second call does nothing."""
        self._pending.clear()
        self._raw.close()

    @property
    def closed(self) -> bool:
        """True after `finish` or `abandon`."""
        return self._raw.closed

    @property
    def _is_deleted(self) -> bool:
        """True if no file or another file has its name."""
        try:
            return not os.path.samestat(os.fstat(self._raw.fileno()), self.path.stat())
        except (FileNotFoundError, NotADirectoryError):
            return True

    def _append(self, data: bytearray) -> int:
        return self._raw.write(data)


_CHUNK = bytes([Opcode.CHUNK])


def open_recording(path: Path) -> BinaryIO:
    """Open a file of a recording to read it; if its recorder completed it meanwhile, under its complete name.

    Raises:
        OSError: it cannot be opened.
    """
    try:
        return path.open("rb")
    except FileNotFoundError:
        if path.suffix != PART:
            raise
        return path.with_suffix("").open("rb")


def is_locked(path: Path) -> bool:
    """True if a running process writes the file; False if it does not exist."""
    try:
        with lock_orphan(path):
            return False
    except InputError:
        return True
    except FileNotFoundError:
        return False


@contextlib.contextmanager
def lock_orphan(path: Path) -> Iterator[BinaryIO]:
    """Open and lock an orphan within the context.

    Raises:
        InputError: a process writes it.
        OSError: it cannot be opened, or was replaced since.
    """
    with path.open("rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(f"{path}: is still being written; stop its recorder first") from error
        if not os.path.samestat(os.fstat(stream.fileno()), path.stat()):
            raise FileNotFoundError(f"{path}: is another file by now")
        yield stream
