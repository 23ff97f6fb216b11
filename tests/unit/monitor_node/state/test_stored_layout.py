"""A state that an earlier version stored is resumed: an upgrade costs no training.

`state_2.bin` was stored by the version before the compiled step, `state_3.bin` by the last one with a single input,
both after 391 samples of the run below. A change of the layout raises the version of the seal; the state in the layout
before has to be read all the same.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.state.monitor_state import MAGIC, SEAL, MonitorState, learning_settings
from reactorwatch.contract.codec import Encoded
from reactorwatch.contract.messages_pb2 import Alarm

from ..samples import leaking_run, samples

CONFIG = MonitorConfig(training_min=6.0, isolation=False)
PROCESSED = 391


def alarms(monitor: Monitor, messages: list[Encoded]) -> Iterator[tuple[str, str, int, float]]:
    """Name, event, time and value of each change of an alarm."""
    for message in messages:
        for item in monitor.on_message(message, 0):
            if isinstance(item.message, Alarm):
                yield item.message.alarm, item.message.event, item.message.time_ns, item.message.value


@pytest.mark.parametrize("version", [2, 3])
def test_a_state_of_a_version_before_is_resumed_without_a_training(version: int) -> None:
    """The alarms are those of a monitor that has processed the samples before as well; numbers to 1e-9."""
    data = (Path(__file__).parent / f"state_{version}.bin").read_bytes()
    assert data.startswith(MAGIC + version.to_bytes(2, "big"))
    state = MonitorState.from_bytes(SEAL.open(data))
    resumed, whole = Monitor(CONFIG, 0, points=False), Monitor(CONFIG, 0, points=False)
    settings = learning_settings(CONFIG, whole.model, points=False)
    assert state.settings | {"equations": ""} == settings | {"equations": ""}  # CasADi writes them in its own way
    resumed.restore(state)
    resumed.on_history_end()
    assert resumed.phase == "watching"
    messages = list(samples(*leaking_run(-0.1, 14.0, 20.0, seed=3)))
    for message in messages[:PROCESSED]:
        whole.on_message(message, 0)
    raised, expected = (list(alarms(monitor, messages[PROCESSED:])) for monitor in (resumed, whole))
    assert len(expected) > 3
    assert [item[:3] for item in raised] == [item[:3] for item in expected]
    assert [item[3] for item in raised] == pytest.approx([item[3] for item in expected], rel=1e-9)
