"""The training lasts as long as stated; where nothing is stated, 100 minutes of the reactor, else 1,000 rows."""

import re

import msgspec
import pytest

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.state.monitor_state import OtherSettingsError
from reactorwatch.errors import InputError
from reactorwatch.runtime.config import section

from .test_many_outputs import ROW_NS, config_of, plant, watch


def stated(**length: object) -> MonitorConfig:
    return msgspec.structs.replace(config_of(1, 100), training_min=None, **length)


@pytest.mark.parametrize("rows", [90, 150])
def test_a_training_of_so_many_rows_ends_with_them(rows: int) -> None:
    monitor = Monitor(stated(training_rows=rows), 0, points=False)
    watch(monitor, plant(1, rows))
    assert (monitor.phase, monitor.pipeline.trained_share(monitor.memory.last_ns)) == ("training", 1.0)
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
