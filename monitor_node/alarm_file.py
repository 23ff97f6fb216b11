"""The file that the state of the alarms is kept in, so that it survives a restart of the monitor."""

import os
from pathlib import Path

from monitor_node.alarm_board import AlarmBoard
from reactorwatch.errors import InputError
from reactorwatch.records.atomic import is_full, replacing


class AlarmFile:
    """Keeps the state of the alarms in a file: whole or not at all, and on the disk when `store` returns.

    Args:
        path: the file.
        board: the alarms.
    """

    def __init__(self, path: Path, board: AlarmBoard) -> None:
        self._path = path
        self._board = board
        self._stored: int | None = None

    def load(self) -> None:
        """Let the alarms go on from the file; one that is not there yet is begun.

        Raises:
            InputError: the file cannot be read or will never be written, or is damaged; it is left as it is. That the
                disk is full just now ends nothing.
        """
        try:
            data = self._path.read_bytes() if self._path.exists() else None
        except OSError as error:
            raise InputError(f"alarm_state_file {self._path}: cannot be read: {error.strerror}") from error
        if data is not None:
            try:
                self._board.from_bytes(data)
            except InputError as error:
                raise InputError(
                    f"alarm_state_file {self._path}: {error}; move it away to begin with all alarms normal"
                ) from error
        try:
            self.store()
        except InputError as error:
            if not is_full(error):
                raise

    def store(self) -> None:
        """Write what has changed, if anything has.

        Raises:
            InputError: the file cannot be written; what was there is still there.
        """
        if self._stored == self._board.changes:
            return
        try:
            with replacing(self._path) as temporary, temporary.open("wb") as file:
                file.write(self._board.to_bytes())
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise InputError(f"alarm_state_file {self._path}: cannot be written: {error.strerror}") from error
        self._stored = self._board.changes
