"""File of a monitor's state, for a restart.

It is written under a temporary name and renamed, so that a kill leaves the file before or this one, intact. An unusable
state is kept aside, and used again when it fits (see `kept_aside`). A file that is no state is refused and left alone.
"""

from pathlib import Path

from monitor_node.core import Monitor
from monitor_node.state.monitor_state import OtherSettingsError
from monitor_node.state.seal import ForeignFileError
from monitor_node.storage.kept_aside import DAMAGED, OTHER_SETTINGS, find_kept_aside, keep_aside, put_back, read_regular
from reactorwatch.errors import InputError
from reactorwatch.records.atomic import is_disk_full, write_durably


class StateFile:
    """Stores a monitor's state in a file, atomically, and on the disk when `store` returns.

    Args:
        path: the file.
        monitor: the monitor.
        every_s: storage interval in seconds.

    Attributes:
        was_aside: True if the monitor was restored from a file that had been kept aside.
    """

    def __init__(self, path: Path, monitor: Monitor, every_s: float) -> None:
        self.was_aside = False
        self._path, self._monitor, self._every_ns = path, monitor, int(every_s * 1e9)
        self._alarms_stored: int | None = None
        self._heard_stored: int | None = None
        self._due_ns: int | None = None

    def load(self) -> str:
        """Restore the monitor from the file, or from a kept one that fits; returns a line for the log.

        Raises:
            InputError: the file cannot be read, is no state, or cannot be written. A full disk is no error.
        """
        try:
            line = self._restore(read_regular(self._path))
        except ForeignFileError as error:
            raise InputError(f"state_file {self._path}: {error}; it is left as it is: name another file") from error
        except InputError as error:
            raise InputError(f"state_file {self._path}: {error}") from error
        except OSError as error:
            raise InputError(f"state_file {self._path}: cannot be read or renamed: {error.strerror}") from error
        line = f"state_file {self._path}: {line}"
        try:
            self._write()
        except InputError as error:
            if not is_disk_full(error):
                raise
            line = f"{line}; {error}"
        return line

    def due_ns(self) -> int | None:
        """Time of the next storage; None: nothing has changed."""
        return None if self._monitor.memory.received == self._heard_stored else self._due_ns

    def is_due(self, now_ns: int) -> bool:
        """True if an alarm or the baseline has changed, or messages were received and the interval is over."""
        if self._due_ns is None or now_ns < self._due_ns - self._every_ns:  # the first time, or the clock was set back
            self._due_ns = now_ns + self._every_ns
        if self._monitor.changes == self._alarms_stored and now_ns < self._due_ns:
            return False
        self._due_ns = now_ns + self._every_ns
        return self._monitor.changes != self._alarms_stored or self._monitor.memory.received != self._heard_stored

    def store(self) -> None:
        """Write the present state.

        Raises:
            InputError: the file cannot be written; it is unchanged. The next try is after the interval.
        """
        self._alarms_stored, self._heard_stored = self._monitor.changes, None
        self._write()
        self._heard_stored = self._monitor.memory.received

    def _write(self) -> None:
        try:
            write_durably(self._path, self._monitor.to_bytes())
        except InputError:
            self._monitor.stats.not_stored += 1
            raise
        except OSError as error:
            self._monitor.stats.not_stored += 1
            raise InputError(f"state_file {self._path}: cannot be written: {error.strerror}") from error

    def _restore(self, data: bytes | None) -> str:
        status = "there is none yet"
        if data is not None:
            try:
                self._monitor.from_bytes(data)
            except ForeignFileError:
                raise
            except InputError as error:
                ending = OTHER_SETTINGS if isinstance(error, OtherSettingsError) else DAMAGED
                status = f"{error}; it is kept as {keep_aside(self._path, ending).name}"
            else:
                return "the monitor resumes from it"
        asides = find_kept_aside(self._path.parent).get(self._path.name, [])
        fitting = put_back(self._path, asides, self._monitor.from_bytes)
        self.was_aside = fitting is not None
        if fitting is not None:
            return f"{status}; {fitting.name} fits and is in use again"
        return f"{status}{';' if data is None else ', and'} the monitor learns again"
