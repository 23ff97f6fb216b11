"""Plant, monitor and recorder as processes: the training is diagnosed beside the watch, and the recording replays."""

import json
from pathlib import Path
from typing import Any

import msgspec
import pytest

from reactorwatch.cli.replay import run
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, decode
from reactorwatch.contract.messages_pb2 import Baseline
from recorder.files.recording import Recording

from .live_run import LiveRun

ENDLESS_MIN = 100_000.0
DIAGNOSED: dict[str, Any] = {"training_min": 25.0, "diagnose_training": True}


class WarmRun(LiveRun):
    """A plant whose feed was 3 K warmer all along."""

    faults = ("feed_temperature:constant:3",)


def test_a_live_training_is_diagnosed_and_the_change_of_the_model_is_recorded_and_verified(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changes: list[Encoded] = []
    with WarmRun(tmp_path, ENDLESS_MIN, 600.0, **DIAGNOSED) as live:
        live.bus.subscribe(keys.key("cstr", keys.BASELINE, "monitor"), changes.append)
        _, plant = live.start_all()
        live.wait(lambda: bool(changes))
        live.wait_until(live.now_min + 10.0)
        plant.terminate()
        plant.wait()
        assert live.nodes.stop(["monitor", "recorder"]) == {"monitor": 0, "recorder": 0}
    (recorded,) = [decode(item.payload, item.encoding) for item in Recording(live.recording).messages({keys.BASELINE})]
    assert isinstance(recorded, Baseline)
    assert recorded == decode(changes[0].payload, changes[0].encoding)
    (effect,) = msgspec.json.decode(recorded.model)["effects"]
    assert effect.startswith(("feed_temperature:constant:3.", "feed_temperature:constant:2.9"))
    assert run(live.recording, tmp_path / "settings.toml", None, as_json=True) == 0
    report = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert {"kind": "baseline", "recorded": 1, "equal": 1} in report["kinds"]


@pytest.mark.slow
def test_a_monitor_that_was_stopped_before_the_diagnosis_was_done_makes_it_after_its_restart(tmp_path: Path) -> None:
    changes: list[Encoded] = []
    with WarmRun(tmp_path, ENDLESS_MIN, 600.0, state_file=str(tmp_path / "monitor.state"), **DIAGNOSED) as live:
        live.bus.subscribe(keys.key("cstr", keys.BASELINE, "monitor"), changes.append)
        live.start_all()
        live.wait(lambda: live.health.phase == "watching")
        assert live.nodes.stop(["monitor"]) == {"monitor": 0}
        assert not changes, "the diagnosis was done before the stop"
        live.start("monitor")
        live.wait(lambda: bool(changes))
        assert live.nodes.stop(["plant", "monitor", "recorder"]) == dict.fromkeys(("plant", "monitor", "recorder"), 0)
    log = (tmp_path / "monitor.log").read_text()
    assert "Traceback" not in log
