"""Claims: one monitor at a time uses a state file, or a fleet's folder of states.

On a local file system a claim is a lock of the kernel (`flock`), which ends with the process, by whatever means. A
second monitor is refused.

Locks of a network file system may be local to each machine, or outlive a machine that is gone. So there a claim is a
file with the token of the last monitor that claimed. The previous one may be stalled at any instruction, and not know
that it was replaced. It reads the claim after it has evaluated messages and before it publishes an alarm or writes a
state, so after a stall of any length before the check it does neither, and ends.
"""

import fcntl
import os
import secrets
import weakref
from collections.abc import Callable
from pathlib import Path

from reactorwatch.errors import InputError
from reactorwatch.records.decode import read_regular

TOKEN_BYTES = 16

MOUNTS = Path("/proc/self/mountinfo")

LOCAL = frozenset(
    ("bcachefs", "btrfs", "ext2", "ext3", "ext4", "f2fs", "jfs", "overlay", "ramfs", "reiserfs", "tmpfs", "xfs", "zfs")
)
"""Linux's file systems on disks of the machine and in its memory, whose locks every process of the machine sees."""


class Claim:
    """Claim on a state file or a folder of states, until it is closed or the process ends.

    Args:
        path: file of the claim.
        thing: what is claimed, as the errors name it.

    Raises:
        InputError: another monitor uses it.

    Attributes:
        failure: reason why it could not be claimed; empty: it is. Then no other monitor is refused.
    """

    def __init__(self, path: Path, thing: str) -> None:
        self._path, self._thing, self.failure = path, thing, ""
        self._token: bytes | None = None
        self._close: Callable[[], object] = lambda: None
        try:
            file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_NONBLOCK, 0o644)  # a pipe is refused, not waited for
            self._close = weakref.finalize(self, os.close, file)
            if is_local(path.parent):
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            token = secrets.token_hex(TOKEN_BYTES // 2).encode()
            os.write(file, token)
            self._token = token
        except BlockingIOError:
            self._close()
            raise InputError(f"{thing} is in use by another monitor; stop that, or name another") from None
        except OSError as error:
            self.failure = f"{thing}: cannot be claimed in {path}: {error.strerror}; another monitor may use it"
        self._close()

    def close(self) -> None:
        """Give the claim up: the state is stored for the last time."""
        self._close()

    def check(self) -> None:
        """Check that no other monitor has claimed it since.

        Raises:
            InputError: another monitor has.
        """
        if self._token is None:  # locked, or never claimed: a check would find the previous owner's for ever
            return
        try:
            owner = read_regular(self._path, bounded=False)
        except (InputError, OSError):
            return
        if len(owner) == TOKEN_BYTES and owner != self._token:
            raise InputError(f"{self._thing} was claimed by another monitor, which uses it from now on")


def is_local(folder: Path) -> bool:
    """True if a folder is certainly on a local file system."""
    try:
        lines = MOUNTS.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return False
    resolved, kind, longest = str(folder.resolve()), "", -1
    for line in lines:
        mount, _, source = line.partition(" - ")
        point = mount.split()[4].encode().decode("unicode_escape")  # blanks in names are \040
        if len(point) >= longest and (resolved == point or resolved.startswith(point.rstrip("/") + "/")):
            kind, longest = source.split()[0], len(point)
    return kind in LOCAL
