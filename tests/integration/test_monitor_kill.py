"""A monitor that is killed goes on where it was: the alarms are those of one that was never stopped."""

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from monitor_node import backtest
from monitor_node.config import MonitorConfig
from monitor_node.verification import verify
from plant_node.config import PlantConfig
from reactorwatch.cli.processes import Processes, write_settings
from reactorwatch.cli.sources import messages
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, decode
from reactorwatch.contract.messages_pb2 import Alarm, Sample
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.runtime.bus_zenoh import ZenohBus, router
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.loopback import free_endpoint
from recorder.config import RecorderConfig
from recorder.mcap_file import read_messages

WITHIN_S = 120.0
PLANT = "cstr"
DURATION_MIN, SPEED = 50.0, 150.0
KILLS_MIN = (8.0, 20.0, 33.0)
"""In training, watching, and while the alarms of the leak stand."""


class Run:
    """Plant, monitor and recorder as processes on a router of the test's own.

    Args:
        folder: for the recording, the state and what the nodes say.
        monitor: settings of the monitor beside the usual.
    """

    def __init__(self, folder: Path, **monitor: Any) -> None:
        self.recording = folder / "run.mcap"
        self.state = folder / "monitor.state"
        self.folder = folder
        bus = BusConfig(endpoint=free_endpoint())
        self.monitor = MonitorConfig(training_min=15.0, state_file=str(self.state), state_every_s=0.5, **monitor)
        settings = folder / "settings.toml"
        plant = PlantConfig(
            speed=SPEED,
            duration_min=DURATION_MIN,
            seed=4,
            faults=("coolant_flow:step:-0.08@30min",),
            wait_for=("monitor", "recorder"),
        )
        recorder = RecorderConfig(out=str(self.recording), linger_s=1.0, black_box_min=0.0)
        write_settings(settings, {"bus": bus, "plant": plant, "monitor": self.monitor, "recorder": recorder})
        self.bus: ZenohBus = router(bus)
        self.nodes = Processes(settings, folder)
        self._changed = threading.Condition()
        self._first_ns: int | None = None
        self._now_min = 0.0
        self._alive: set[str] = set()
        self.bus.watch_alive(f"reactor/{PLANT}/alive/*", self._on_alive)
        self.bus.subscribe(keys.key(PLANT, keys.SAMPLE, "T"), self._on_sample)

    def start_monitor(self) -> Any:
        """Start one, and wait until it listens."""
        process = self.nodes.start("monitor")
        self.wait(lambda: "monitor" in self._alive)
        return process

    def kill(self, monitor: Any) -> None:
        """End one without a last word."""
        monitor.kill()
        monitor.wait()
        self.wait(lambda: "monitor" not in self._alive)

    def wait_until(self, minute: float) -> None:
        """Wait until the plant has come so far."""
        self.wait(lambda: self._now_min >= minute)

    def wait(self, condition: Any) -> None:
        with self._changed:
            assert self._changed.wait_for(condition, WITHIN_S)

    def _on_sample(self, message: Encoded) -> None:
        sample = decode(message.payload, message.encoding)
        assert isinstance(sample, Sample)
        with self._changed:
            self._first_ns = self._first_ns or sample.time_ns
            self._now_min = (sample.time_ns - self._first_ns) / MINUTE_NS
            self._changed.notify_all()

    def _on_alive(self, key: str, alive: bool) -> None:
        with self._changed:
            (self._alive.add if alive else self._alive.discard)(key.rsplit("/", 1)[1])
            self._changed.notify_all()


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    going = Run(tmp_path)
    with going.nodes:
        yield going
    going.bus.close()


def test_three_kills_change_no_alarm(run: Run) -> None:
    """What was published while it was down, and since it was stored, the plant tells it once more.

    The recording replays, value for value, as that of a monitor that was never stopped.
    """
    run.nodes.start("recorder")
    monitor = run.start_monitor()
    plant = run.nodes.start("plant")
    for minute in KILLS_MIN:
        run.wait_until(minute)
        run.kill(monitor)
        monitor = run.start_monitor()
        assert "the monitor goes on from it" in (run.folder / "monitor.log").read_text(encoding="utf-8")
    assert plant.wait(WITHIN_S) == 0
    assert run.nodes.stop(["monitor", "recorder"]) == {"monitor": 0, "recorder": 0}

    recorded = [decode(item.payload, item.encoding) for item in read_messages(run.recording, {keys.ALARM})]
    alarms = [item for item in recorded if isinstance(item, Alarm)]
    uninterrupted = backtest.run(messages(run.recording, PLANT), run.monitor)
    assert uninterrupted.alarm_messages
    assert alarms == uninterrupted.alarm_messages
    assert verify(lambda: messages(run.recording, PLANT), run.monitor).exact
