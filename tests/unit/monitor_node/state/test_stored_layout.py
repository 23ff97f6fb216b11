"""A stored state names the build that stored it."""

import msgspec
import pytest

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.monitor_state import (
    MonitorState,
    OtherSettingsError,
    learning_settings,
    open_seal,
    open_state,
    seal,
)
from reactorwatch.version import this_build

CONFIG = MonitorConfig(training_min=6.0, isolation=False)


def test_a_state_names_the_build_that_stored_it_and_its_refusal_names_another_build() -> None:
    monitor = Monitor(CONFIG, 0, points=False)
    settings = learning_settings(CONFIG, monitor.pipeline.model, points=False)
    data = monitor.to_bytes()
    assert MonitorState.from_bytes(open_seal(data)).build == this_build()
    other = msgspec.structs.replace(open_state(data, settings), build="0.2.0 (commit 0123456789ab)").to_bytes()
    assert open_state(seal(other), settings).settings == settings
    with pytest.raises(OtherSettingsError, match=r"learned by 0\.2\.0 \(commit 0123456789ab\) with other settings"):
        open_state(seal(other), settings | {"training_min": 7.0})
    with pytest.raises(OtherSettingsError, match=r"^was learned with other settings"):
        open_state(data, settings | {"training_min": 7.0})
