"""The file that all a monitor remembers is kept in, so that it goes on where it was after a restart.

It is written beside its place and renamed into it, so a kill at any moment leaves the one before or this one, whole. A
file that cannot be gone on from is kept aside: it may be worth a look, or what was learned over months may be wanted
back with the settings that it was learned with.
"""

import os
from pathlib import Path

from monitor_node.core import Monitor
from monitor_node.monitor_state import OtherSettingsError
from reactorwatch.errors import InputError
from reactorwatch.records.atomic import is_full, replacing

DAMAGED, OTHER_SETTINGS = ".damaged", ".other-settings"
"""What is added to the name of a file that is kept aside; one of each is kept."""


class StateFile:
    """Keeps what a monitor remembers: whole or not at all, and on the disk when `store` returns.

    Args:
        path: the file.
        monitor: its memory.
        every_s: how often it is stored.
    """

    def __init__(self, path: Path, monitor: Monitor, every_s: float) -> None:
        self._path, self._monitor, self._every_ns = path, monitor, int(every_s * 1e9)
        self._alarms_stored: int | None = None
        self._heard_stored: int | None = None
        self._due_ns: int | None = None

    def load(self) -> str:
        """Let the monitor go on from the file, if there is one; returns what people are to be told.

        Raises:
            InputError: the file cannot be read, or will never be written: its folder is not there, for instance. That
                the disk is full just now ends nothing.
        """
        try:
            data = self._path.read_bytes() if self._path.exists() else None
        except OSError as error:
            raise InputError(f"state_file {self._path}: cannot be read: {error.strerror}") from error
        told = f"state_file {self._path}: there is none yet; the monitor learns anew"
        if data is not None:
            try:
                self._monitor.from_bytes(data)
                told = f"state_file {self._path}: the monitor goes on from it"
            except OtherSettingsError as error:
                told = self._keep_aside(OTHER_SETTINGS, error)
            except InputError as error:
                told = self._keep_aside(DAMAGED, error)
        try:
            self._write()
        except InputError as error:
            if not is_full(error):
                raise
            told = f"{told}; {error}"
        return told

    def due_ns(self) -> int | None:
        """When to store what was heard; None: there is nothing to store."""
        return None if self._monitor.received == self._heard_stored else self._due_ns

    def is_due(self, now_ns: int) -> bool:
        """Whether to store: an alarm has changed, or it is time and something was heard since."""
        if self._due_ns is None or now_ns < self._due_ns - self._every_ns:  # the first time, or the clock was set back
            self._due_ns = now_ns + self._every_ns
        if self._monitor.alarms.changes == self._alarms_stored and now_ns < self._due_ns:
            return False
        self._due_ns = now_ns + self._every_ns
        return self._monitor.alarms.changes != self._alarms_stored or self._monitor.received != self._heard_stored

    def store(self) -> None:
        """Write all that is remembered now.

        Raises:
            InputError: the file cannot be written; what was there is still there. It is due again in its time.
        """
        self._alarms_stored, self._heard_stored = self._monitor.alarms.changes, None
        self._write()
        self._heard_stored = self._monitor.received

    def _write(self) -> None:
        try:
            with replacing(self._path) as temporary, temporary.open("wb") as file:
                file.write(self._monitor.to_bytes())
                file.flush()
                os.fsync(file.fileno())
        except InputError:
            self._monitor.not_stored += 1
            raise
        except OSError as error:
            self._monitor.not_stored += 1
            raise InputError(f"state_file {self._path}: cannot be written: {error.strerror}") from error

    def _keep_aside(self, ending: str, why: InputError) -> str:
        aside = self._path.with_name(self._path.name + ending)
        try:
            self._path.replace(aside)
        except OSError as error:
            raise InputError(f"state_file {self._path}: cannot be renamed: {error.strerror}") from error
        return f"state_file {self._path}: {why}; it is kept as {aside.name}, and the monitor learns anew"
