"""File of an incomplete recording, locked so that no other process takes it for an orphan.

Bytes are buffered in memory and handed to the operating system by `flush`, which is where a full disk shows. Flushed
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

from reactorwatch.errors import InputError

PART = ".part"
"""Ending of an incomplete recording."""
DELETED = "its file was deleted"
LARGEST_PENDING = 1 << 18  # buffered bytes that force a flush


class PartFile:
    """New append-only file, with a lock.

    Args:
        path: the file; it must not exist.

    Raises:
        OSError: it cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._raw = path.open("xb", buffering=0)
        fcntl.flock(self._raw, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._pending = bytearray()
        self._flushed = 0

    def write(self, data: bytes) -> int:
        """Buffer bytes, and flush a full buffer.

        Raises:
            OSError: as `flush`.
        """
        self._pending += data
        if len(self._pending) >= LARGEST_PENDING:
            self.flush()
        return len(data)

    def tell(self) -> int:
        """Number of bytes written, buffered ones included."""
        return self._flushed + len(self._pending)

    @property
    def flushed_bytes(self) -> int:
        """Number of bytes handed to the operating system."""
        return self._flushed

    def flush(self) -> None:
        """Hand the buffer to the operating system.

        Raises:
            OSError: the write failed, for example on a full disk, perhaps after part of the buffer; or the file was
                deleted, so that writes would succeed and be lost.
        """
        while self._pending:
            taken = self._append(self._pending)
            self._flushed += taken
            del self._pending[:taken]
        if self._is_deleted:
            raise OSError(errno.ENOENT, DELETED)

    def sync(self) -> None:
        """Flush, and wait until all bytes are on the disk.

        Raises:
            OSError: as `flush`, or the sync failed.
        """
        self.flush()
        os.fsync(self._raw.fileno())

    def finish(self, path: Path) -> None:
        """Flush, rename to `path` while the lock is held, and close.

        Raises:
            OSError: as `flush`, or it cannot be renamed; it is closed under its old name.
        """
        try:
            self.flush()
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
