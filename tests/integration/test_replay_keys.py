"""A replay in a terminal shows its position, and takes keys."""

import fcntl
import os
import re
import select
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.records.write import write_table
from reactorwatch.runtime.config import BusConfig

PATIENCE_S = 60.0
ROWS = 300


class Terminal:
    """A terminal of its own for a process: what it shows, and keys for it."""

    def __init__(self, arguments: list[str]) -> None:
        self._screen, theirs = os.openpty()
        self._shown = ""

        def take_terminal() -> None:
            fcntl.ioctl(0, termios.TIOCSCTTY, 0)

        self.process = subprocess.Popen(
            arguments, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True, preexec_fn=take_terminal
        )
        os.close(theirs)

    def press(self, keys: str) -> None:
        os.write(self._screen, keys.encode())

    def wait_for(self, pattern: str) -> str:
        """Return what matches next on the screen; what came before it is forgotten."""
        deadline = time.monotonic() + PATIENCE_S
        while (found := re.search(pattern, self._shown)) is None:
            ready, _, _ = select.select([self._screen], [], [], max(deadline - time.monotonic(), 0.0))
            assert ready, f"{pattern!r} was not shown, but {self._shown[-500:]!r}"
            self._shown += os.read(self._screen, 65536).decode()
        self._shown = self._shown[found.end() :]
        return found[1] if found.re.groups else found[0]

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        os.close(self._screen)


@pytest.fixture
def terminal(tmp_path: Path, bus_config: BusConfig) -> Iterator[Terminal]:
    record = tmp_path / "record.csv"
    write_table(record, simulate_record(PlantConfig(seed=3), ROWS))
    command = [sys.executable, "-m", "reactorwatch", "replay", str(record), "--rate", "60"]
    shown = Terminal([*command, "--endpoint", bus_config.endpoint])
    yield shown
    shown.close()


def test_keys_pause_step_and_change_the_rate_of_a_replay(terminal: Terminal) -> None:
    terminal.wait_for(r"playing at 60 times")
    terminal.press(" ")
    paused_at = float(terminal.wait_for(r"([\d.]+) min, paused at 60 times"))
    assert float(terminal.wait_for(r"([\d.]+) min, paused")) == paused_at
    terminal.press("\x1b[C" * 10)
    stepped_to = float(terminal.wait_for(r"([\d.]+) min, paused at 60 times"))
    while stepped_to == paused_at:  # the line before the keys
        stepped_to = float(terminal.wait_for(r"([\d.]+) min, paused at 60 times"))
    assert paused_at + 0.8 <= stepped_to <= paused_at + 1.1
    terminal.press("\x1b[A")
    terminal.wait_for(r"paused at 120 times")
    terminal.press("\x1b[B\x1b[B")
    terminal.wait_for(r"paused at 30 times")
    terminal.press(" ")
    terminal.wait_for(r"playing at 30 times")


def test_ctrl_c_ends_a_replay_and_leaves_the_terminal_as_it_was(terminal: Terminal) -> None:
    terminal.wait_for(r"playing at 60 times")
    terminal.press("\x03")
    assert terminal.process.wait(PATIENCE_S) == 0
    echo = termios.tcgetattr(terminal._screen)[3] & termios.ECHO
    assert echo
