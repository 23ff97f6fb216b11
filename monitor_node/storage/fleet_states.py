"""Folder of the stored states of a fleet's monitors, a file for each plant.

A file is written whole or not at all, by a thread of its own, so that a slow disk delays no alarm. Monitors that share
the fleet may share the folder: a monitor that takes a plant over resumes from the state that the last owner stored.

Two monitors may own a plant for a moment, after one of them was cut off or frozen. So a monitor does not overwrite a
file that changed, by its time and size, since the monitor itself read or wrote it; `pop_lost` returns such plants.

A state that cannot be used is kept aside, and used again when it fits (see `kept_aside`). A file that is no state is
left alone, and nothing is stored of its plant.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeAlias

from monitor_node.storage.claims import Claims
from monitor_node.storage.kept_aside import find_kept_aside, keep_aside, put_back, read_regular
from reactorwatch.errors import InputError
from reactorwatch.records.atomic import atomic_write, is_disk_full, write_durably

ENDING = ".state"

MOST_PENDING = 100
"""States that wait for the disk; at this limit only those of changed alarms and of released plants are added."""

LEFT_S = 600.0
"""A temporary file this old was left by a writer that was killed."""


class _WrittenElsewhereError(Exception):
    """Another monitor has written the state meanwhile."""


_Mark: TypeAlias = tuple[int, int]  # identifies a version of a file: time and size


class FleetStates:
    """States of plants on the disk.

    Args:
        folder: folder of the files.

    Raises:
        InputError: the folder cannot be written to. A full disk is no error.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._claims = folder, Claims(folder)
        self._queued: dict[str, bytes] = {}
        self._failed: list[tuple[str, str]] = []
        self._marks: dict[str, _Mark] = {}  # of each plant's file as last read or written
        self._lost: list[str] = []
        self._protected: set[str] = set()  # plants whose file is no state, or unreadable
        self._changed = threading.Condition()
        self._closed = False
        try:
            with atomic_write(folder / f".{ENDING}") as probe:
                probe.write_bytes(b"")
            (folder / f".{ENDING}").unlink(missing_ok=True)  # another monitor may probe at the same time
        except OSError as error:
            raise InputError(f"state folder {folder}: cannot be written to: {error.strerror}") from error
        except InputError as error:
            if not is_disk_full(error):
                raise InputError(f"state folder {folder}: {error}") from error
        self._remove_leftovers()
        self._aside = find_kept_aside(folder)
        # A daemon: without `close` there is nothing to write.
        self._thread = threading.Thread(target=self._write_pending, name="states", daemon=True)
        self._thread.start()

    @property
    def plants(self) -> list[str]:
        """Plants with a stored state."""
        return sorted(path.name.removesuffix(ENDING) for path in self._folder.glob(f"[!.]*{ENDING}"))

    @property
    def plants_aside(self) -> list[str]:
        """Plants with a state that is kept aside."""
        return sorted(
            name.removesuffix(ENDING) for name, paths in self._aside.items() if paths and name.endswith(ENDING)
        )

    def read(self, plant: str) -> bytes | None:
        """State of a plant; None if there is none.

        Raises:
            InputError: the file cannot be read.
        """
        with self._changed:
            if plant in self._queued and not self.is_written_elsewhere(plant):
                return self._queued[plant]
            self._queued.pop(plant, None)
        path = self._path(plant)
        try:
            self._update_mark(plant)
            return read_regular(path)
        except (InputError, OSError) as error:
            self._protected.add(plant)
            why = f"cannot be read: {error.strerror}" if isinstance(error, OSError) else str(error)
            raise InputError(f"state {path}: {why}; nothing is stored of the plant") from error

    def keep_aside(self, plant: str, ending: str) -> str:
        """Rename the unusable state of a plant; returns the new name."""
        path = self._path(plant)
        try:
            aside = keep_aside(path, ending)
        except OSError as error:
            self._protected.add(plant)
            return f"{path.name}, as it cannot be renamed: {error.strerror}"
        self._aside[path.name] = [aside, *self._aside.get(path.name, [])]
        return aside.name

    def protect(self, plant: str) -> str:
        """Store nothing of a plant as long as its present file exists; returns the name of the file."""
        self._protected.add(plant)
        return self._path(plant).name

    def put_back(self, plant: str, use: Callable[[bytes], None]) -> str | None:
        """Use a state of a plant that was kept aside and fits now; returns the name it was kept under, or None.

        Args:
            plant: name of a plant without a state in use.
            use: see `kept_aside.put_back`.
        """
        path = self._path(plant)
        asides = self._aside.get(path.name, [])
        if not asides or path.exists():
            return None
        try:
            fitting = put_back(path, asides, use)
        except OSError as error:
            self._failed.append((plant, f"state {path}: what is kept aside cannot be used: {error.strerror}"))
            return None
        if fitting is None:
            return None
        asides.remove(fitting)
        self._update_mark(plant)
        return fitting.name

    def claim(self, plant: str) -> bool:
        """Claim a plant that has a state, see `claims`; returns True if the previous owner may know it only later."""
        if not self._path(plant).exists():
            return False
        why = self._claims.claim(plant)
        if why is not None:
            self._failed.append((plant, why))
        return why is None

    def is_claimed_elsewhere(self, plant: str) -> bool:
        """True if another monitor has claimed a plant last."""
        return self._claims.is_claimed_elsewhere(plant)

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

    def pop_lost(self) -> list[str]:
        """Remove and return the plants whose state was not written because another monitor has written one."""
        lost, self._lost = self._lost, []
        return lost

    def is_written_elsewhere(self, plant: str) -> bool:
        """True if another monitor has written the state of a plant since it was read or written here."""
        own, present = self._marks.get(plant), _file_mark(self._path(plant))
        return present not in (None, own) and own is not None

    def adopted_elsewhere(self, plants: Iterable[str]) -> list[str]:
        """Select the plants that another monitor has claimed, or whose state it has written."""
        return [plant for plant in plants if self.is_claimed_elsewhere(plant) or self.is_written_elsewhere(plant)]

    def close(self) -> None:
        """Write the queued states, and stop."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def _path(self, plant: str) -> Path:
        return self._folder / f"{plant}{ENDING}"

    def _check_mark(self, plant: str) -> None:
        if self.is_written_elsewhere(plant):
            raise _WrittenElsewhereError

    def _update_mark(self, plant: str) -> None:
        """Record the present version of a plant's file."""
        mark = _file_mark(self._path(plant))
        self._marks[plant] = mark if mark is not None else (0, 0)

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
            # The mark is checked just before the file is replaced: a slow disk or a stall may come between.
            write_durably(path, state, lambda: self._check_mark(plant))
            self._update_mark(plant)
        except _WrittenElsewhereError:
            self._lost.append(plant)
        except InputError as error:
            return str(error)
        except OSError as error:
            return f"state {path}: cannot be written: {error.strerror}"
        return None


def _file_mark(path: Path) -> _Mark | None:
    """Time and size of a file; None: there is none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size
