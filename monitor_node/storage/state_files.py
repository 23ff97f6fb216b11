"""Files of stored states: one for a monitor, a folder of them for a fleet.

A file is written under a temporary name and renamed, so that a kill leaves the file before or this one, intact. An
unusable state is kept aside under another name, never overwritten, and used again when it fits: one learned over months
may be wanted back with the settings it was learned with; a damaged one may be worth a look. A file that is no state is
left alone. Only one monitor at a time uses a file, and one fleet's monitor a folder (see `claims`).
"""

import contextlib
import re
import threading
import time
from collections.abc import Iterable
from pathlib import Path

from monitor_node.core import Monitor
from monitor_node.monitor_state import ForeignFileError, OtherSettingsError
from monitor_node.storage.claims import Claim
from reactorwatch.errors import InputError, is_passing
from reactorwatch.records.atomic import atomic_write, write_durably
from reactorwatch.records.input_file import read_regular

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

MOST_PENDING = 100
"""States of a fleet that wait for the disk; at this limit only those of changed alarms are added."""

RESUMED = "the monitor resumes from it"

LEFT_S = 600.0
"""A temporary file this old was left by a writer that was killed."""


def restore(path: Path, monitor: Monitor, asides: Iterable[Path]) -> str:
    """Restore a monitor from its file, or from one that was kept aside and fits now; returns a text for the log.

    Args:
        path: the file.
        monitor: the monitor.
        asides: files that were kept aside.

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


def write_state(path: Path, state: bytes, claim: Claim, kind: str) -> None:
    """Write a state to the disk; `kind` names its file in messages.

    Raises:
        InputError: the file cannot be written, or another monitor has claimed it; it is unchanged.
    """
    try:
        write_durably(path, state, claim.check)  # just before the file is replaced: a slow disk comes before
    except OSError as error:
        raise InputError(f"{kind} {path}: cannot be written: {error.strerror}") from error


class StateFile:
    """Stores a monitor's state in a file; it is on the disk when `store` returns.

    Args:
        path: the file.
        monitor: the monitor.
        every_s: storage interval in seconds.

    Raises:
        InputError: another monitor uses the file.
    """

    def __init__(self, path: Path, monitor: Monitor, every_s: float) -> None:
        self._path, self.monitor, self._every_ns = path, monitor, int(every_s * 1e9)
        self.claim = Claim(path.with_name(f".{path.name}{CLAIM}"), f"state_file {path}")
        self._changes_stored: int | None = None
        self._received_stored: int | None = None
        self._due_ns: int | None = None

    def load(self) -> str:
        """Restore the monitor from the file, or from a kept one that fits; returns a line for the log.

        Raises:
            InputError: the file cannot be read, or is no state. One that cannot be written at the moment is no error.
        """
        try:
            return self._load()
        except InputError:
            self.claim.close()
            raise

    def _load(self) -> str:
        try:
            asides = find_kept_aside(self._path.parent).get(self._path.name, [])
            restored = restore(self._path, self.monitor, asides)
        except ForeignFileError as error:
            raise InputError(f"state_file {self._path}: {error}; it is left as it is: name another file") from error
        except InputError as error:
            raise InputError(f"state_file {self._path}: {error}") from error
        except OSError as error:
            raise InputError(f"state_file {self._path}: cannot be read or renamed: {error.strerror}") from error
        line = f"state_file {self._path}: {restored}"
        try:
            self._write()
        except InputError as error:
            if not is_passing(error):
                raise
            line = f"{line}; {error}"
        return line

    def due_ns(self) -> int | None:
        """Time of the next storage; None: nothing has changed."""
        return None if self.monitor.memory.received == self._received_stored else self._due_ns

    def is_due(self, now_ns: int) -> bool:
        """True if an alarm or the baseline has changed, or messages were received and the interval is over."""
        if self._due_ns is None or now_ns < self._due_ns - self._every_ns:  # the first time, or the clock was set back
            self._due_ns = now_ns + self._every_ns
        if self.monitor.changes == self._changes_stored and now_ns < self._due_ns:
            return False
        self._due_ns = now_ns + self._every_ns
        return self.monitor.changes != self._changes_stored or self.monitor.memory.received != self._received_stored

    def store(self) -> None:
        """Write the present state.

        Raises:
            InputError: the file cannot be written; it is unchanged. The next try is after the interval.
        """
        self._changes_stored, self._received_stored = self.monitor.changes, None
        self._write()
        self._received_stored = self.monitor.memory.received

    def _write(self) -> None:
        try:
            write_state(self._path, self.monitor.to_bytes(), self.claim, "state_file")
        except InputError:
            self.monitor.stats.not_stored += 1
            raise


class StateFolder:
    """States of a fleet's plants, `PLANT.state`, written by a thread of its own: a slow disk delays no alarm.

    Args:
        folder: the folder.

    Raises:
        InputError: the folder cannot be read or made, is no folder, or another monitor uses it. One that cannot be
            written to at the moment is no error.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._queued: dict[str, bytes] = {}
        self._failed: list[tuple[str, str]] = []
        self._protected: set[str] = set()  # plants whose file is no state, or unreadable
        self._changed = threading.Condition()
        self._closed = False
        try:
            list(folder.iterdir())
            with atomic_write(folder / f".{ENDING}") as probe:
                probe.write_bytes(b"")
            (folder / f".{ENDING}").unlink()
        except OSError as error:
            raise InputError(f"state folder {folder}: cannot be read or written to: {error.strerror}") from error
        except InputError as error:
            if not is_passing(error):
                raise InputError(f"state folder {folder}: {error}") from error
        self._remove_leftovers()
        self._aside = find_kept_aside(folder)
        self.claim = Claim(folder / CLAIM, f"state folder {folder}")
        # A daemon: without `close` there is nothing to write.
        self._thread = threading.Thread(target=self._write_pending, name="states", daemon=True)
        self._thread.start()

    @property
    def plants(self) -> list[str]:
        """Plants with a stored state, in use or kept aside."""
        names = {path.name for path in self._folder.glob(f"[!.]*{ENDING}")} | set(self._aside)
        return sorted(name.removesuffix(ENDING) for name in names if name.endswith(ENDING))

    def load(self, plant: str, monitor: Monitor) -> str:
        """Restore a plant's monitor; returns a line for the log, or nothing if it resumes from its file.

        A file that is no state, or cannot be read, stays as it is, and nothing is stored of its plant.
        """
        path = self._path(plant)
        try:
            restored = restore(path, monitor, self._aside.get(path.name, []))
        except (InputError, OSError) as error:
            self._protected.add(plant)
            why = f"cannot be read or renamed: {error.strerror}" if isinstance(error, OSError) else str(error)
            return (
                f"state {path}: {why}; it is left as it is, and nothing is stored of the plant until it is moved away"
            )
        return "" if restored == RESUMED else f"state {path}: {restored}"

    @property
    def has_room(self) -> bool:
        """True while the disk keeps up."""
        return len(self._queued) < MOST_PENDING

    def put(self, plant: str, state: bytes) -> None:
        """Queue a state for writing; it replaces a queued one of the plant."""
        with self._changed:
            self._queued[plant] = state
            self._changed.notify()

    def pop_failures(self) -> list[tuple[str, str]]:
        """Remove and return the failed writes: plant and reason."""
        failed, self._failed = self._failed, []
        return failed

    def close(self) -> None:
        """Write the queued states, and stop."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        self.claim.close()

    def _path(self, plant: str) -> Path:
        return self._folder / f"{plant}{ENDING}"

    def _remove_leftovers(self) -> None:
        """Remove temporary files of killed writers."""
        oldest_s = time.time() - LEFT_S
        for path in self._folder.glob(f".*{ENDING}.*.tmp"):
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
            why = self._write(plant, state)
            with self._changed:
                if self._queued.get(plant) is state:
                    del self._queued[plant]
            if why is not None:
                self._failed.append((plant, why))

    def _write(self, plant: str, state: bytes) -> str | None:
        """Write a state; returns the reason if it cannot be written."""
        path = self._path(plant)
        if plant in self._protected:
            if path.exists():
                return f"state {path}: cannot be used and is not overwritten; move it away"
            self._protected.discard(plant)
        try:
            write_state(path, state, self.claim, "state")
        except InputError as error:
            return str(error)
        return None
