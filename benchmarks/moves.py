"""Moves between files of the project for one sample of a watched plant.

    python benchmarks/moves.py

A move is a call or a return that leads from one file to another. The sample is the last of a row: once of an ordinary
row, once of the row that raises the first alarm of a leak; as a live monitor does it, with points published and causes
searched, and as a back-test does it, without either.
"""

import sys
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract.codec import Encoded, encode
from reactorwatch.contract.messages_pb2 import Alarm
from recorder.tools.player import samples_of

ROOT = Path(__file__).parents[1]
TRAINING_MIN, ONSET_MIN, SPAN_MIN = 20.0, 30.0, 60.0
SIGNALS = 3


class Walk:
    """Count of moves between the files of the project while a function runs; a context."""

    def __init__(self) -> None:
        self.moves = 0
        self._file = ""

    def __enter__(self) -> "Walk":
        """Start to count."""
        sys.setprofile(self._note)
        return self

    def __exit__(self, *_: object) -> None:
        """Stop counting."""
        sys.setprofile(None)

    def _note(self, frame: FrameType, event: str, _argument: Any) -> None:
        at = frame if event == "call" else frame.f_back if event == "return" else None
        file = at.f_code.co_filename if at is not None else ""
        if file.startswith(str(ROOT)) and file != __file__ and ".venv" not in file:
            self.moves += file != self._file
            self._file = file


def count_moves(*, live: bool) -> tuple[int, int]:
    """Moves of an ordinary row's last sample, the median of those before the onset, and of the first alarm's.

    Counted in a second run: in the first one kernels are compiled.
    """
    _count_moves_once(live=live)
    return _count_moves_once(live=live)


def _count_moves_once(*, live: bool) -> tuple[int, int]:
    fault = f"coolant_flow:step:-0.08@{ONSET_MIN:g}min"
    measured = simulate_record(PlantConfig(duration_min=SPAN_MIN, seed=1, faults=(fault,)))
    messages: list[Encoded] = [encode(item) for item in samples_of(measured, "cstr", 0)]
    monitor = Monitor(MonitorConfig(training_min=TRAINING_MIN, isolation=live), 0, points=live, power=False)
    ordinary: list[int] = []
    for number, message in enumerate(messages):
        with Walk() as walk:
            published = monitor.on_message(message, 0)
        if any(isinstance(item.message, Alarm) for item in published):
            return int(np.median(ordinary)), walk.moves
        last_of_row = number % SIGNALS == SIGNALS - 1
        if last_of_row and TRAINING_MIN + 1.0 < number / SIGNALS * 0.1 < ONSET_MIN:
            ordinary.append(walk.moves)
    raise RuntimeError("the leak raised no alarm")


def main() -> None:
    """Print the table."""
    for live, how in ((True, "with points and causes"), (False, "without either")):
        ordinary, alarm = count_moves(live=live)
        print(f"moves between files {how}: {ordinary} for an ordinary sample, {alarm} for one with an alarm")


if __name__ == "__main__":
    main()
