"""Stored states: the file of one plant, or a fleet's folder of them, which one monitor at a time uses.

A file is written under a temporary name and renamed, so that a kill leaves the file before or this one, intact. An
unusable state is kept aside under another name, never overwritten, and used again when it fits: one learned over months
may be wanted back with the settings it was learned with; a damaged one may be worth a look. A file that is no state is
left alone.

A monitor claims its file or folder. On a local file system a claim is a lock of the kernel (`flock`), which ends with
the process, by whatever means; a second monitor is refused. Locks of a network file system may be local to each
machine, or outlive a machine that is gone. So there, and for the shards on a cluster, a claim is a file with the token
of the last monitor that claimed. The previous one may be stalled at any instruction, and not know that it was replaced.
It reads the claim after it has evaluated messages and before it publishes an alarm or writes a state, and every second,
so after a stall of any length before the check it does neither, and ends.
"""

import contextlib
import fcntl
import os
import re
import secrets
import threading
import time
import weakref
from collections.abc import Callable, Iterable
from pathlib import Path

from monitor_node.core import Monitor
from monitor_node.monitor_state import ForeignFileError, OtherSettingsError
from reactorwatch.errors import InputError, is_passing
from reactorwatch.records.decode import read_regular
from reactorwatch.records.write import atomic_write, write_durably

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
        shared: True if other machines may use it, also where the file system seems to be local.

    Raises:
        InputError: another monitor uses it.

    Attributes:
        failure: reason why it could not be claimed; empty: it is. Then no other monitor is refused.
    """

    def __init__(self, path: Path, thing: str, *, shared: bool = False) -> None:
        self._path, self._thing, self.failure = path, thing, ""
        self._token: bytes | None = None
        self._close: Callable[[], object] = lambda: None
        try:
            file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_NONBLOCK, 0o644)  # a pipe is refused, not waited for
            self._close = weakref.finalize(self, os.close, file)
            if not shared and is_local(path.parent):
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            token = secrets.token_hex(8).encode()
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
        if len(owner) == 16 and owner != self._token:
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


DAMAGED, OTHER_SETTINGS = ".damaged", ".other-settings"

_NAME = re.compile(rf"(.+?)(?:{re.escape(DAMAGED)}|{re.escape(OTHER_SETTINGS)})(?:\.\d+)?")


def keep_aside(path: Path, ending: str) -> Path:
    """Rename a file to its name with the ending, and a number if that name is taken; returns the new path.

    Raises:
        OSError: the file cannot be renamed.
    """
    aside, number = path.with_name(path.name + ending), 1
    while True:
        try:
            aside.touch(exist_ok=False)  # takes the name, also where two processes keep files aside at once
        except FileExistsError:
            number += 1
            aside = path.with_name(f"{path.name}{ending}.{number}")
        else:
            try:
                return path.replace(aside)
            except OSError:
                aside.unlink()
                raise


def find_kept_aside(folder: Path) -> dict[str, list[Path]]:
    """Kept files of a folder by their original name, the newest first."""
    found: dict[str, list[tuple[int, Path]]] = {}
    for path in folder.iterdir() if folder.is_dir() else []:
        match = _NAME.fullmatch(path.name)
        if match is not None and path.is_file():
            with contextlib.suppress(FileNotFoundError):  # another monitor has just put it back
                found.setdefault(match[1], []).append((path.stat().st_mtime_ns, path))
    return {name: [path for _, path in sorted(dated, reverse=True)] for name, dated in found.items()}


ENDING, CLAIM = ".state", ".owner"

RESUMED = "the monitor resumes from it"


def restore(path: Path, monitor: Monitor, asides: Iterable[Path]) -> str:
    """Restore a monitor from its file, or from one that was kept aside and fits now; returns a text for the log.

    Raises:
        ForeignFileError: the file is no state; it is left as it is.
        InputError: the file can hold no state.
        OSError: a file cannot be read or renamed.
    """
    status, joint = "there is none yet", ";"
    if path.exists():
        data = read_regular(path, bounded=False)
        try:
            monitor.from_bytes(data)
        except ForeignFileError:
            raise
        except InputError as error:
            ending = OTHER_SETTINGS if isinstance(error, OtherSettingsError) else DAMAGED
            status, joint = f"{error}; it is kept as {keep_aside(path, ending).name}", ", and"
        else:
            return RESUMED
    for aside in asides:
        try:
            monitor.from_bytes(aside.read_bytes())
        except InputError:
            continue
        aside.replace(path)
        return f"{status}; {aside.name} fits and is in use again"
    return f"{status}{joint} the monitor learns again"


class StateStore:
    """States of plants, each in a file of its own.

    The state of one plant is on the disk when `put` returns. Those of a fleet are written by a thread, so that a slow
    disk delays no alarm.

    Args:
        path: folder of the states, `PLANT.state`; or the file of one plant.
        plant: the one plant; None: the path is a folder.
        shared: see `Claim`.

    Raises:
        InputError: the folder cannot be read or made, is no folder, or another monitor uses the file or the folder. One
            that cannot be written to at the moment is no error.
    """

    def __init__(self, path: Path, plant: str | None = None, *, shared: bool = False) -> None:
        self._path, self._only = path, plant
        folder = path if plant is None else path.parent
        self._name = f"state folder {path}" if plant is None else f"state_file {path}"
        self._queued: dict[str, bytes] = {}
        self._failed: list[tuple[str, str]] = []
        self._protected: set[str] = set()  # plants whose file is no state, or unreadable
        self._changed = threading.Condition()
        self._closed = False
        self._thread: threading.Thread | None = None
        if plant is None:
            self._prepare_folder()
        try:
            self._aside = find_kept_aside(folder)
        except OSError as error:
            raise InputError(f"{self._name}: cannot be read or renamed: {error.strerror}") from error
        claim = folder / CLAIM if plant is None else path.with_name(f".{path.name}{CLAIM}")
        self.claim = Claim(claim, self._name, shared=shared)

    @property
    def plants(self) -> list[str]:
        """Plants with a stored state in the folder, in use or kept aside."""
        names = {path.name for path in self._path.glob(f"[!.]*{ENDING}")} | set(self._aside)
        return sorted(name.removesuffix(ENDING) for name in names if name.endswith(ENDING))

    def load(self, monitor: Monitor) -> str:
        """Restore a plant's monitor; returns a line for the log.

        The file of one plant is then written, so that a file that cannot be is refused at the start.

        Raises:
            InputError: the file is no state, or cannot be read. It stays as it is, and nothing is stored of the plant.
        """
        plant = monitor.config.plant
        path = self._path_of(plant)
        name = f"state {path}" if self._only is None else self._name
        try:
            line = f"{name}: {restore(path, monitor, self._aside.get(path.name, []))}"
        except (InputError, OSError) as error:
            self._protected.add(plant)
            why = str(error) if isinstance(error, InputError) else f"cannot be read or renamed: {error.strerror}"
            if self._only is None:
                why += "; it is left as it is, and nothing is stored of the plant until it is moved away"
            elif isinstance(error, ForeignFileError):
                why += "; it is left as it is: name another file"
            raise InputError(f"{name}: {why}") from error
        if self._only is not None:
            try:
                self._write(plant, monitor.to_bytes())
            except InputError as error:
                if not is_passing(error):
                    raise
                monitor.stats.not_stored += 1
                return f"{line}; {error}"
        return line

    @property
    def has_room(self) -> bool:
        """True while the disk keeps up."""
        return len(self._queued) < 100

    def put(self, plant: str, state: bytes) -> None:
        """Write a state, or queue it in place of a queued one of the plant; see `pop_failures`."""
        if self._only is not None:
            self._try_write(plant, state)
            return
        with self._changed:
            self._queued[plant] = state
            self._changed.notify()
        if self._thread is None:  # a daemon: without `close` there is nothing to write
            self._thread = threading.Thread(target=self._write_pending, name="states", daemon=True)
            self._thread.start()

    def pop_failures(self) -> list[tuple[str, str]]:
        """Remove and return the failed writes: plant and reason."""
        failed, self._failed = self._failed, []
        return failed

    def close(self) -> None:
        """Write the queued states, and stop."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join()
        self.claim.close()

    def _path_of(self, plant: str) -> Path:
        return self._path / f"{plant}{ENDING}" if self._only is None else self._path

    def _prepare_folder(self) -> None:
        """Check the folder, and remove temporary files of killed writers."""
        try:
            list(self._path.iterdir())
            with atomic_write(self._path / f".{ENDING}") as probe:
                probe.write_bytes(b"")
            (self._path / f".{ENDING}").unlink()
        except OSError as error:
            raise InputError(f"{self._name}: cannot be read or written to: {error.strerror}") from error
        except InputError as error:
            if not is_passing(error):
                raise InputError(f"{self._name}: {error}") from error
        # a file this old was left by a writer that was killed
        oldest_s = time.time() - 600.0
        for path in self._path.glob(f".*{ENDING}.*.tmp"):
            with contextlib.suppress(OSError):
                if path.stat().st_mtime < oldest_s:
                    path.unlink()

    def _write_pending(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queued or self._closed)
                if not self._queued:
                    return
                plant, state = next(iter(self._queued.items()))
            self._try_write(plant, state)
            with self._changed:
                if self._queued.get(plant) is state:
                    del self._queued[plant]

    def _try_write(self, plant: str, state: bytes) -> None:
        try:
            self._write(plant, state)
        except InputError as error:
            self._failed.append((plant, str(error)))

    def _write(self, plant: str, state: bytes) -> None:
        """Write a state to the disk.

        Raises:
            InputError: it cannot be written, or another monitor has claimed it; the file is unchanged.
        """
        path = self._path_of(plant)
        if plant in self._protected:
            if path.exists():
                raise InputError(f"state {path}: cannot be used and is not overwritten; move it away")
            self._protected.discard(plant)
        try:
            write_durably(path, state, self.claim.check)  # just before the file is replaced: a slow disk comes before
        except OSError as error:
            raise InputError(f"state {path}: cannot be written: {error.strerror}") from error
