"""Claims: in a folder that monitors of a fleet share, which of them has adopted a plant last.

A monitor claims a plant before it reads the plant's state. The previous owner may be stalled at any instruction, and
not know that it was replaced. It checks the claim after it has evaluated messages and before it publishes an alarm, so
after a stall of any length before the check it publishes nothing. Clocks and liveliness tokens, which arrive late, are
not needed.

A claim is a file `.PLANT.owner` with the name of the monitor. It is overwritten in place, always with as many bytes.
"""

import os
import secrets
from pathlib import Path

from monitor_node.storage.kept_aside import read_regular
from reactorwatch.errors import InputError

ENDING = ".owner"

NAME_BYTES = 16


class Claims:
    """Claims of one monitor.

    Args:
        folder: folder of the files.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._name = folder, secrets.token_hex(NAME_BYTES // 2).encode()
        self._failed: set[str] = set()  # plants without a claim: a check would find the previous owner's for ever

    def claim(self, plant: str) -> str | None:
        """Claim a plant; returns the reason if that fails. Then the plant counts as claimed."""
        path = self._path(plant)
        try:
            file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_NONBLOCK, 0o644)  # a pipe is refused, not waited for
            try:
                os.write(file, self._name)
            finally:
                os.close(file)
        except OSError as error:
            self._failed.add(plant)
            return f"claim {path}: cannot be written: {error.strerror}; an alarm may be published twice"
        self._failed.discard(plant)
        return None

    def is_claimed_elsewhere(self, plant: str) -> bool:
        """True if another monitor has claimed a plant last."""
        if plant in self._failed:
            return False
        try:
            owner = read_regular(self._path(plant))
        except (InputError, OSError):
            return False
        return owner is not None and len(owner) == NAME_BYTES and owner != self._name

    def _path(self, plant: str) -> Path:
        return self._folder / f".{plant}{ENDING}"
