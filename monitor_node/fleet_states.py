"""The folder in which a fleet's monitors keep what they remember, a file for each plant.

A file is written whole or not at all, by a thread of its own, so that a slow disk delays no alarm. Monitors that share
the fleet may share the folder: who takes a plant over goes on from what the one before stored.
"""

import os
import threading
from pathlib import Path

from reactorwatch.errors import InputError
from reactorwatch.records.atomic import is_full, replacing

ENDING = ".state"

MOST_WAITING = 100
"""States that wait for the disk; with so many, only those of changed alarms and of plants that go are added."""


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
        self._changed = threading.Condition()
        self._closed = False
        try:
            with replacing(folder / f".{ENDING}") as probe:
                probe.write_bytes(b"")
            (folder / f".{ENDING}").unlink()
        except OSError as error:
            raise InputError(f"state folder {folder}: cannot be written to: {error.strerror}") from error
        except InputError as error:
            if not is_full(error):
                raise InputError(f"state folder {folder}: {error}") from error
        # A daemon: who does not `close` has nothing to write.
        self._thread = threading.Thread(target=self._write_what_waits, name="states", daemon=True)
        self._thread.start()

    @property
    def plants(self) -> list[str]:
        """Those of which there is a state."""
        return sorted(path.name.removesuffix(ENDING) for path in self._folder.glob(f"[!.]*{ENDING}"))

    def read(self, plant: str) -> bytes | None:
        """The state of a plant; None if there is none.

        Raises:
            InputError: it cannot be read.
        """
        with self._changed:
            if plant in self._waiting:
                return self._waiting[plant]
        path = self._path(plant)
        try:
            return path.read_bytes() if path.exists() else None
        except OSError as error:
            raise InputError(f"state {path}: cannot be read: {error.strerror}") from error

    def keep_aside(self, plant: str, ending: str) -> str:
        """Rename the state of a plant that cannot be gone on from; returns the name that it has then."""
        path = self._path(plant)
        aside = path.with_name(path.name + ending)
        try:
            path.replace(aside)
        except OSError as error:
            return f"{path.name}, as it cannot be renamed: {error.strerror}"
        return aside.name

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

    def close(self) -> None:
        """Write what waits, and end."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def _path(self, plant: str) -> Path:
        return self._folder / f"{plant}{ENDING}"

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
        try:
            with replacing(path) as temporary, temporary.open("wb") as file:
                file.write(state)
                file.flush()
                os.fsync(file.fileno())
        except InputError as error:
            return str(error)
        except OSError as error:
            return f"state {path}: cannot be written: {error.strerror}"
        return None
