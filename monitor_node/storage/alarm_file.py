"""File of the alarms' state, for a restart of the monitor."""

from pathlib import Path

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.core import Monitor
from monitor_node.state.seal import ForeignFileError, Seal
from monitor_node.storage.kept_aside import DAMAGED, keep_aside, read_regular
from reactorwatch.errors import InputError
from reactorwatch.records.atomic import is_disk_full, write_durably

SEAL = Seal(b"reactorwatch alarms", 1, "alarm state")

_CURE = "move it away to begin with all alarms normal, or name another file"


class AlarmFile:
    """Stores the alarms' state in a file, atomically, and on the disk when `store` returns.

    The constructor only reads the file, so that a refused file ends the start before any file is renamed.

    Args:
        path: the file.
        monitor: monitor of the plant.

    Raises:
        InputError: the file cannot be read, or is no alarm state of this plant; it is left unchanged.
    """

    def __init__(self, path: Path, monitor: Monitor) -> None:
        self._path, self._monitor = path, monitor
        self._stored: tuple[Annunciator, int] | None = None
        self._body: bytes | None = None
        self._damage: InputError | None = None
        try:
            self._read()
        except InputError as error:
            raise InputError(f"alarm_state_file {path}: {error}; {_CURE}") from error
        except OSError as error:
            raise InputError(f"alarm_state_file {path}: cannot be read: {error.strerror}") from error

    def _read(self) -> None:
        data = read_regular(self._path)
        if data is None:
            return
        try:
            self._body = SEAL.open(data)
        except ForeignFileError:
            if data[0] >> 4 != 8:  # a MessagePack map: version 0.1 wrote it without a seal
                raise
            self._body = data
        except InputError as error:
            self._damage = error
            return
        Annunciator(self._monitor.config).from_bytes(self._body)

    def load(self, *, is_newest: bool) -> str | None:
        """Restore the alarms from the file, or create it; returns a line for the log, if there is something to report.

        Args:
            is_newest: True if the monitor has no other state of its alarms, or an older one.

        Raises:
            InputError: the file is damaged and there is no other state, or it cannot be written. A full disk is no
                error.
        """
        line = None
        if self._damage is not None:
            if is_newest:
                raise InputError(f"alarm_state_file {self._path}: {self._damage}; {_CURE}") from self._damage
            try:
                aside = keep_aside(self._path, DAMAGED)
            except OSError as error:
                raise InputError(f"alarm_state_file {self._path}: cannot be renamed: {error.strerror}") from error
            cure = f"it is kept as {aside.name}, and the alarms are those of state_file"
            line = f"alarm_state_file {self._path}: {self._damage}; {cure}"
        elif self._body is not None and is_newest:
            self._monitor.restore_alarms(self._body)
        try:
            self.store()
        except InputError as error:
            if not is_disk_full(error):
                raise
        return line

    def store(self) -> None:
        """Write the alarms, if they have changed.

        Raises:
            InputError: the file cannot be written; it is unchanged.
        """
        board = self._monitor.alarms
        if self._stored == (board, board.changes):
            return
        try:
            write_durably(self._path, SEAL.close(board.to_bytes()))
        except OSError as error:
            raise InputError(f"alarm_state_file {self._path}: cannot be written: {error.strerror}") from error
        self._stored = board, board.changes
