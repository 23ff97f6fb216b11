"""The training lasts as long as stated; where nothing is stated, 100 minutes of the reactor, else 1,000 rows."""

import re

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monitor_node.config import MonitorConfig, TrainingLength
from monitor_node.core import Monitor
from monitor_node.learn.training_diagnosis import _shorten_gaps
from monitor_node.learn.training_rows import MOST_ROWS, TrainingRows
from monitor_node.monitor_state import OtherSettingsError
from reactorwatch.contract.messages_pb2 import Quality, Sample
from reactorwatch.errors import InputError
from reactorwatch.runtime.config import section
from reactorwatch.stored_state import copy_of

from .test_many_outputs import ROW_NS, config_of, plant, watch


def stated(**length: object) -> MonitorConfig:
    return msgspec.structs.replace(config_of(1, 100), **({"training_min": None} | length))


@pytest.mark.parametrize("rows", [90, 150])
def test_a_training_of_so_many_rows_ends_with_them(rows: int) -> None:
    monitor = Monitor(stated(training_rows=rows), 0, points=False)
    watch(monitor, plant(1, rows))
    assert (monitor.phase, monitor.pipeline.trained_share) == ("training", 1.0)
    watch(monitor, plant(1, rows + 1), first=rows)
    assert monitor.memory.watching_since_ns == rows * ROW_NS


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, (100.0, 0)),
        ({"outputs": ("T",)}, (100.0, 0)),
        ({"input": "u", "outputs": ("y",)}, (None, 1000)),
        ({"training_min": 20.0}, (20.0, 0)),
        ({"training_rows": 300}, (None, 300)),
    ],
)
def test_the_length_where_nothing_is_stated_is_that_of_the_process(
    settings: dict[str, object], expected: tuple[float | None, int]
) -> None:
    assert section(MonitorConfig, "monitor", {"monitor": settings}, {}).training_length == expected


def test_minutes_and_rows_together_are_refused() -> None:
    both = {"monitor": {"training_min": 20.0, "training_rows": 300}}
    with pytest.raises(InputError, match="both state the training, got 20 and 300; leave one out"):
        section(MonitorConfig, "monitor", both, {})


def test_a_state_learned_with_another_length_is_resumed_unless_a_length_is_stated() -> None:
    learned = Monitor(stated(training_rows=100), 0, points=False)
    watch(learned, plant(1, 130))
    state = learned.to_bytes()
    resumed = Monitor(stated(), 0, points=False)
    resumed.from_bytes(state)
    assert resumed.phase == "watching"
    with pytest.raises(OtherSettingsError, match=re.escape("training_rows was 100 and is 200")):
        Monitor(stated(training_rows=200), 0, points=False).from_bytes(state)


@pytest.mark.parametrize(
    ("word", "meant"),
    [("process", "equations"), ("equations", "equations"), ("black-box", "black-box"), ("arx", "arx")],
)
def test_the_words_for_references_are_the_same_everywhere_and_the_older_one_is_read(word: str, meant: str) -> None:
    assert section(MonitorConfig, "monitor", {"monitor": {"reference": word}}, {}).reference == meant


ROWS = 150
"""Rows of a training of 15 minutes."""

CLOCKS = {
    "eight hours without rows": [(60, 8 * 600)],
    "the clock is set from 1970 to today": [(60, 300_000_000)],
    "short gaps": [(20, 3), (60, 7), (100, 4)],
    "single rows are missing": [(row, 1) for row in range(40, 90, 5)],
    "gaps before the sampling period is known": [(3, 600), (10, 6000)],
    "the clock steps back": [(70, -50)],
    "a gap, then a step back behind it": [(40, 600), (70, -900)],
}
"""Rows after which the clock jumps, by so many sampling periods."""


def watched_from(jumps: list[tuple[int, int]], **length: float) -> tuple[int, int]:
    """Index of the first judged row, and the number of rows of the training."""
    monitor = Monitor(stated(**length), 0, points=False)
    values, time_ns = plant(1, 3 * ROWS), 10**15
    for row in range(values.shape[1]):
        time_ns += ROW_NS * (1 + sum(periods for after, periods in jumps if after == row))
        for name, value in zip(monitor.config.signals, values[:, row].tolist(), strict=True):
            quality = Quality.QUALITY_GOOD
            monitor.on_sample(name, Sample(time_ns=time_ns, sequence=row, value=value, quality=quality), 0)
        if monitor.phase == "watching":
            return monitor.rows - 1, monitor.pipeline.training.trained_rows
    raise AssertionError("the training never ended")


@pytest.mark.parametrize("clock", CLOCKS)
def test_time_without_rows_is_no_training(clock: str) -> None:
    in_minutes = watched_from(CLOCKS[clock], training_min=15.0)
    in_rows = watched_from(CLOCKS[clock], training_rows=ROWS)
    assert in_minutes == in_rows
    assert in_minutes[1] == ROWS
    steps_back = [row for row, periods in CLOCKS[clock] if periods < 0]
    assert in_minutes[0] == ROWS + sum(steps_back)  # rows before a step back are of another run


@settings(max_examples=100)
@given(period_ms=st.integers(1, 10**7), rows=st.integers(1, 10**6))
def test_minutes_of_rows_are_as_many_rows_at_any_period(period_ms: int, rows: int) -> None:
    length = TrainingLength(rows * period_ms / 60_000)
    assert length.count_rows(period_ms / 60_000) == rows


def test_rows_that_are_not_kept_count_and_are_stored() -> None:
    rows = TrainingRows([0])
    for row in range(MOST_ROWS + 7):
        rows.add(row, (), [1.0])
    again = copy_of(rows)
    assert (len(again.times), again.dropped) == (MOST_ROWS, 7)
    again.add(0, (), [1.0])
    assert (len(again.times), again.dropped) == (1, 0)


def test_a_jump_of_the_clock_does_not_last_for_years_in_the_diagnosis_of_the_training() -> None:
    time_min = np.arange(300) / 10
    assert (_shorten_gaps(time_min) == time_min).all()
    jumped = np.where(np.arange(300) < 100, time_min, time_min + 29_600_000.0)
    shortened = _shorten_gaps(jumped)
    assert (shortened[100:] == jumped[100:]).all()
    assert np.diff(shortened)[99] == pytest.approx(60.0)
    assert np.delete(np.diff(shortened), 99) == pytest.approx(0.1, abs=1e-6)
