"""The file that a recording is written to until it is whole, held so that nobody else takes it for one left behind.

Writing is in two steps: what is written is gathered in memory, and handed to the operating system by `flush`, which is
where a full disk shows. What was handed over outlives the process, whatever kills it; what was also synced outlives the
machine. The lock is the operating system's and ends with the process, so a file that nobody holds was left behind.
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
"""The ending that a name has until the recording is whole."""
DELETED = "its file was deleted"
LARGEST_PENDING = 1 << 18  # bytes gathered before they are handed over anyway


class PartFile:
    """A new file that grows at its end. It is a stream, as far as the MCAP library needs one.

    Args:
        path: the file; there must be none of that name.

    Raises:
        OSError: it cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._raw = path.open("xb", buffering=0)
        fcntl.flock(self._raw, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._pending = bytearray()
        self._handed_over = 0

    def write(self, data: bytes) -> int:
        """Gather bytes; as many as come together are handed over.

        Raises:
            OSError: as `flush`.
        """
        self._pending += data
        if len(self._pending) >= LARGEST_PENDING:
            self.flush()
        return len(data)

    def tell(self) -> int:
        """The bytes written so far, handed over or not."""
        return self._handed_over + len(self._pending)

    def flush(self) -> None:
        """Hand all that was written to the operating system.

        Raises:
            OSError: it does not take it, for lack of room perhaps; part of it may be in the file. Or the file was
                deleted, with its folder perhaps: the system would take what is written, and keep nothing of it.
        """
        while self._pending:
            taken = self._append(self._pending)
            self._handed_over += taken
            del self._pending[:taken]
        if self._is_deleted:
            raise OSError(errno.ENOENT, DELETED)

    def sync(self) -> None:
        """Wait until all that was written is on the disk.

        Raises:
            OSError: as `flush`, or the disk fails.
        """
        self.flush()
        os.fsync(self._raw.fileno())

    def finish(self, path: Path) -> None:
        """Hand over the rest, and give the file its name while it is still held.

        Raises:
            OSError: as `flush`, or it cannot be renamed; it then keeps its name, and is closed.
        """
        try:
            self.flush()
            self.path.rename(path)
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close it as it is: what was not handed over is gone. A second call does nothing."""
        self._pending.clear()
        self._raw.close()

    @property
    def closed(self) -> bool:
        """Whether it was finished or abandoned."""
        return self._raw.closed

    @property
    def _is_deleted(self) -> bool:
        """True if the file has lost its name, or another file has it."""
        try:
            return not os.path.samestat(os.fstat(self._raw.fileno()), self.path.stat())
        except (FileNotFoundError, NotADirectoryError):
            return True

    def _append(self, data: bytearray) -> int:
        return self._raw.write(data)


def is_held(path: Path) -> bool:
    """Whether a process that lives is writing the file; False if there is no such file."""
    try:
        with left_behind(path):
            return False
    except InputError:
        return True
    except FileNotFoundError:
        return False


@contextlib.contextmanager
def left_behind(path: Path) -> Iterator[BinaryIO]:
    """A file that nobody writes any more, held while the context lasts.

    Raises:
        InputError: somebody writes it.
        OSError: it cannot be opened, or was just given its name by who wrote it.
    """
    with path.open("rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(f"{path}: is still being written; stop its recorder first") from error
        if not os.path.samestat(os.fstat(stream.fileno()), path.stat()):
            raise FileNotFoundError(f"{path}: is another file by now")
        yield stream
