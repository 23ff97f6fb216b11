"""The folder in which a fleet's monitors keep what they remember, a file for each plant.

A file is written whole or not at all, by a thread of its own, so that a slow disk delays no alarm. Monitors that share
the fleet may share the folder: who takes a plant over goes on from what the one before stored.

Two may take themselves for in charge of a plant for a moment: one of them was cut off, or frozen. So nobody writes over
a file that is not the one that he has read or written last, by its time and size; he is told that another has (`lost`).

A state that cannot be used is kept aside, and used again when it fits (see `kept_aside`). A file that is no state is
left alone, and nothing is stored of its plant.
"""

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeAlias

from monitor_node.storage.kept_aside import find_kept_aside, keep_aside, put_back, read_regular
from reactorwatch.errors import InputError
from reactorwatch.records.atomic import atomic_write, is_disk_full

ENDING = ".state"

MOST_WAITING = 100
"""States that wait for the disk; with so many, only those of changed alarms and of plants that go are added."""


LEFT_S = 600.0
"""What was being written for so long was left by a writer that was killed."""


class _OfAnotherError(Exception):
    """Another has written the state meanwhile."""


_Mark: TypeAlias = tuple[int, int]  # by which a file is known: time and size


class FleetStates:
    """The states of plants, on the disk.

    Args:
        folder: where they are.

    Raises:
        InputError: it is no folder, or nothing can be written there; that the disk is full just now ends nothing.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._waiting: dict[str, bytes] = {}
        self._failed: list[tuple[str, str]] = []
        self._marks: dict[str, _Mark] = {}  # of the file of each plant that was read or written last
        self._lost: list[str] = []
        self._left_alone: set[str] = set()  # plants whose name has a file that is no state, or cannot be read
        self._changed = threading.Condition()
        self._closed = False
        try:
            with atomic_write(folder / f".{ENDING}") as probe:
                probe.write_bytes(b"")
            (folder / f".{ENDING}").unlink(missing_ok=True)  # another one that starts just now may have tried, too
        except OSError as error:
            raise InputError(f"state folder {folder}: cannot be written to: {error.strerror}") from error
        except InputError as error:
            if not is_disk_full(error):
                raise InputError(f"state folder {folder}: {error}") from error
        self._clear_up()
        self._aside = find_kept_aside(folder)
        # A daemon: who does not `close` has nothing to write.
        self._thread = threading.Thread(target=self._write_what_waits, name="states", daemon=True)
        self._thread.start()

    @property
    def plants(self) -> list[str]:
        """Those of which there is a state."""
        return sorted(path.name.removesuffix(ENDING) for path in self._folder.glob(f"[!.]*{ENDING}"))

    @property
    def plants_aside(self) -> list[str]:
        """Plants of which a state is kept aside."""
        return sorted(
            name.removesuffix(ENDING) for name, paths in self._aside.items() if paths and name.endswith(ENDING)
        )

    def read(self, plant: str) -> bytes | None:
        """The state of a plant; None if there is none.

        Raises:
            InputError: it cannot be read.
        """
        with self._changed:
            if plant in self._waiting and not self.is_of_another(plant):
                return self._waiting[plant]
            self._waiting.pop(plant, None)
        path = self._path(plant)
        try:
            self._note(plant)
            return read_regular(path)
        except (InputError, OSError) as error:
            self._left_alone.add(plant)
            why = f"cannot be read: {error.strerror}" if isinstance(error, OSError) else str(error)
            raise InputError(f"state {path}: {why}; nothing is stored of the plant") from error

    def keep_aside(self, plant: str, ending: str) -> str:
        """Rename the state of a plant that cannot be used; returns the name that it has then."""
        path = self._path(plant)
        try:
            aside = keep_aside(path, ending)
        except OSError as error:
            self._left_alone.add(plant)
            return f"{path.name}, as it cannot be renamed: {error.strerror}"
        self._aside[path.name] = [aside, *self._aside.get(path.name, [])]
        return aside.name

    def leave_alone(self, plant: str) -> str:
        """Store nothing of a plant while the file that is there now stays; returns the name of the file."""
        self._left_alone.add(plant)
        return self._path(plant).name

    def put_back(self, plant: str, use: Callable[[bytes], None]) -> str | None:
        """Use a state of a plant that was kept aside and fits now.

        Args:
            plant: its name; of its state nothing is in use.
            use: as for `kept_aside.put_back`.

        Returns:
            The name that the state was kept under; None: none fits.
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
        self._note(plant)
        return fitting.name

    @property
    def has_room(self) -> bool:
        """Whether the disk keeps up."""
        return len(self._waiting) < MOST_WAITING

    def put(self, plant: str, state: bytes) -> None:
        """Have a state written; one of the plant that still waits is out of date."""
        with self._changed:
            self._waiting[plant] = state
            self._changed.notify()

    def failures(self) -> list[tuple[str, str]]:
        """Plants whose state could not be written since the last time, and why."""
        failed, self._failed = self._failed, []
        return failed

    def lost(self) -> list[str]:
        """Plants whose state was not written since the last time, because another has written one."""
        lost, self._lost = self._lost, []
        return lost

    def is_of_another(self, plant: str) -> bool:
        """Whether another has written the state of a plant since it was read or written here."""
        known, found = self._marks.get(plant), _mark_of(self._path(plant))
        return found not in (None, known) and known is not None

    def of_others(self, plants: Iterable[str]) -> list[str]:
        """Those plants of which another has."""
        return [plant for plant in plants if self.is_of_another(plant)]

    def close(self) -> None:
        """Write what waits, and end."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def _path(self, plant: str) -> Path:
        return self._folder / f"{plant}{ENDING}"

    def _check_ours(self, plant: str) -> None:
        if self.is_of_another(plant):
            raise _OfAnotherError

    def _note(self, plant: str) -> None:
        """The state of a plant as it is now is known here."""
        mark = _mark_of(self._path(plant))
        self._marks[plant] = mark if mark is not None else (0, 0)

    def _clear_up(self) -> None:
        """Remove what writers that were killed have left."""
        oldest_s = time.time() - LEFT_S
        for path in self._folder.glob(f".*{ENDING}.*.tmp"):
            with contextlib.suppress(OSError):
                if path.stat().st_mtime < oldest_s:
                    path.unlink()

    def _write_what_waits(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if not self._waiting:
                    return
                plant, state = next(iter(self._waiting.items()))
            why = self._written(plant, state)
            with self._changed:
                if self._waiting.get(plant) is state:
                    del self._waiting[plant]
            if why is not None:
                self._failed.append((plant, why))

    def _written(self, plant: str, state: bytes) -> str | None:
        """Write a state; returns why that was not possible."""
        path = self._path(plant)
        if plant in self._left_alone:
            if path.exists():
                return f"state {path}: cannot be used and is not overwritten; move it away"
            self._left_alone.discard(plant)
        try:
            with atomic_write(path) as temporary:
                with temporary.open("wb") as file:
                    file.write(state)
                    file.flush()
                    os.fsync(file.fileno())
                self._check_ours(plant)  # only now: a disk takes its time, and who was frozen meanwhile more
            self._note(plant)
        except _OfAnotherError:
            self._lost.append(plant)
        except InputError as error:
            return str(error)
        except OSError as error:
            return f"state {path}: cannot be written: {error.strerror}"
        return None


def _mark_of(path: Path) -> _Mark | None:
    """By which a file is known; None: there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size
