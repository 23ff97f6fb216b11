"""Modes of a plant: each has its own reference, start-up has signal checks only, an unseen mode is reported."""

import msgspec
import numpy as np
import pytest

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode, encode_message
from reactorwatch.contract.messages_pb2 import Alarm, BaselineCommand, ChartPoint, Quality, Sample
from tests.exchanger import PLANT, config_of

from ..samples import feed_row

SECOND_NS, TRAINING = 10**9, 400
CONFIG = msgspec.structs.replace(
    config_of("arx"), training_rows=TRAINING, modes=("mode",), startup_modes={"mode": (0.0,)}
)
START, RUN, CLEAN, MANUAL = 0.0, 1.0, 2.0, 3.0
LEVEL = {START: 40.0, RUN: 0.0, CLEAN: -8.0, MANUAL: 15.0}
GAIN = {START: 0.0, RUN: 0.5, CLEAN: -1.0, MANUAL: 0.2}
"""Level and gain of the output by mode: a reference of one mode is wrong in another."""


def plan(*pieces: tuple[float, int]) -> list[tuple[float, float, float]]:
    """Rows of pieces of operation, each a mode and a number of rows: mode, flow and temperature of a linear plant."""
    rng = np.random.default_rng(3)
    modes = np.concatenate([np.full(count, mode) for mode, count in pieces])
    flow = np.repeat(rng.uniform(-1.0, 1.0, modes.size), 4)[: modes.size]
    rows, state = [], 0.0
    for mode, u, noise, shock in zip(
        modes.tolist(), flow.tolist(), *rng.normal(0.0, 0.05, (2, modes.size)), strict=True
    ):
        rows.append((mode, u, LEVEL[mode] + state + noise))
        state = 0.8 * state + GAIN[mode] * u + shock
    return rows


class Run:
    def __init__(self, rows: list[tuple[float, float, float]], config: MonitorConfig = CONFIG) -> None:
        self.rows, self.monitor, self.config = rows, Monitor(config, 0), config
        self.published: list[list[Publication]] = []

    def take_until(self, end: int) -> "Run":
        for k in range(len(self.published), end):
            mode, *values = self.rows[k]
            if k == 0 or mode != self.rows[k - 1][0]:
                sample = Sample(time_ns=k * SECOND_NS, value=mode, quality=Quality.QUALITY_GOOD)
                self.monitor.on_message(encode(Publication(keys.key(PLANT, keys.SAMPLE, "mode"), sample)), 0)
            self.published.append(feed_row(self.monitor, k, k * SECOND_NS, values))
        return self

    def resume(self) -> None:
        other = Monitor(self.config, 0)
        other.from_bytes(self.monitor.to_bytes())
        other.on_history_end()
        self.monitor = other

    def raised(self, first: int, last: int) -> list[str]:
        alarms = [item.message for row in self.published[first:last] for item in row if isinstance(item.message, Alarm)]
        return [item.alarm for item in alarms if item.event == "raised"]

    def is_judged(self, row: int) -> bool:
        return any(isinstance(item.message, ChartPoint) for item in self.published[row])


PIECES = ((START, 50), (RUN, 200), (CLEAN, 250), (RUN, 150), (START, 60), (CLEAN, 100), (MANUAL, 80), (RUN, 100))


def edges() -> list[int]:
    return [0, *np.cumsum([count for _, count in PIECES]).tolist()]


@pytest.fixture(scope="module")
def run() -> Run:
    rows = plan(*PIECES)
    return Run(rows).take_until(len(rows))


def test_each_mode_is_judged_by_its_own_reference_and_changes_of_the_mode_raise_no_alarm(run: Run) -> None:
    ends = edges()
    assert not any(run.is_judged(row) for row in range(ends[1] + TRAINING - 1))
    assert run.is_judged(ends[3] - 1)
    assert run.is_judged(ends[3] + 20)
    assert run.is_judged(ends[5] + 20)
    assert run.is_judged(ends[8] - 1)
    assert run.raised(0, ends[-1]) == []


def test_start_up_is_watched_by_signal_checks_only(run: Run) -> None:
    ends = edges()
    assert not any(run.is_judged(row) for row in range(ends[4], ends[5]))
    frozen = [*run.rows]
    for row in range(ends[4] + 5, ends[5]):
        frozen[row] = (START, frozen[row][1], 140.0)
    stuck = Run(frozen).take_until(ends[5])
    assert stuck.raised(ends[4], ends[5]) == ["stuck/th"]


def test_a_mode_not_seen_in_training_is_reported_instead_of_alarming_and_is_learned_on_command(run: Run) -> None:
    ends = edges()
    assert not any(run.is_judged(row) for row in range(ends[6], ends[7]))
    assert [note for note in run.monitor.notes if "mode 3 was not seen in the training" in note]
    rows = plan((RUN, 450), (MANUAL, 600))
    relearned = Run(rows).take_until(470)
    command = BaselineCommand(what="relearn", by="Anna", why="manual from now on")
    key = keys.key(PLANT, keys.COMMAND, "baseline")
    assert relearned.monitor.on_command(Encoded(key, *encode_message(command)), 0)[0].accepted
    relearned.take_until(1050)
    assert relearned.is_judged(1049)


def test_a_fault_in_a_mode_that_was_left_and_entered_again_is_seen(run: Run) -> None:
    ends = edges()
    rows = [*run.rows]
    for row in range(ends[5] + 30, ends[6]):
        rows[row] = (rows[row][0], rows[row][1], rows[row][2] + 6.0)
    assert Run(rows).take_until(ends[6]).raised(ends[5] + 30, ends[5] + 50)


def test_a_resumed_monitor_does_the_same_bit_for_bit(run: Run) -> None:
    again = Run(run.rows)
    for end in (30, 200, 300, 470, 520, 655, 760, 820, 900, len(run.rows)):
        again.take_until(end)
        again.resume()
    assert again.published == run.published
