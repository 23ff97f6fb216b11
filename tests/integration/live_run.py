"""Plant, monitor and recorder as processes on a router, and the messages that they publish."""

import subprocess
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from google.protobuf.message import Message

from benchmarks.harness.site import Router, connect_client
from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.cli.processes import MODULES, Processes, write_settings
from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, decode, encode
from reactorwatch.contract.messages_pb2 import Alarm, Estimate, Health, Incident, Sample
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.http_pages import free_endpoint
from recorder.config import RecorderConfig
from recorder.files.recording import Recording
from recorder.tools.player import samples_of

WITHIN_S = 120.0
PLANT = "cstr"
PERIOD_MIN = 0.1

SILENCE = "silence/plant"
USUAL: dict[str, Any] = {"training_min": 15.0, "health_period_s": 0.5, "diagnose_training": False}
"""Settings of the monitor. A diagnosis takes as long as the rest of the run, and once more for the expected alarms."""


class Change(NamedTuple):
    """What happens to an alarm."""

    time_ns: int
    alarm: str
    event: str
    raised_ns: int


class LiveRun:
    """A plant whose coolant leaks, watched and recorded; a context.

    The plant runs until the test ends it: on a busy machine a node may take longer to start, or to recover what it
    missed, than a plant of a given duration lasts.

    Args:
        folder: for the recording, the state and what the nodes say.
        duration_min: minutes of the plant that are awaited; the leak sets in after three fifths of them.
        speed: of the plant.
        monitor: settings of the monitor beside the usual.

    Attributes:
        faults: deviations of the plant beside the leak.
    """

    faults: tuple[str, ...] = ()

    def __init__(self, folder: Path, duration_min: float, speed: float, **monitor: Any) -> None:
        self.folder, self.recording = folder, folder / "run.mcap"
        self._duration_min = duration_min
        self.config = BusConfig(endpoint=free_endpoint())
        self.monitor = MonitorConfig(**USUAL | monitor)
        self.plant = PlantConfig(
            period_min=PERIOD_MIN,
            speed=speed,
            seed=4,
            faults=(*self.faults, f"coolant_flow:step:-0.08@{0.6 * duration_min}min"),
            wait_for=("monitor", "recorder"),
        )
        recorder = RecorderConfig(out=str(self.recording), linger_s=2.0, black_box_min=0.0)
        settings = folder / "settings.toml"
        tables = {"bus": self.config, "plant": self.plant, "monitor": self.monitor, "recorder": recorder}
        write_settings(settings, tables)
        self.router = Router(self.config.endpoint)
        self.bus = connect_client(self.config)
        self.nodes = Processes(dict.fromkeys(MODULES, settings), folder)
        self.alarms: list[Alarm] = []
        """As heard, like the incidents."""
        self.incidents: list[Incident] = []
        self.health = Health()
        """The monitor's last."""
        self._changed = threading.Condition()
        self._first_ns: int | None = None
        self.now_min = self._judged_min = 0.0
        self._alive: set[str] = set()
        self.bus.subscribe_liveliness(f"reactor/{PLANT}/alive/*", self._on_alive)
        for kind in (keys.SAMPLE, keys.ESTIMATE, keys.ALARM, keys.INCIDENT, keys.HEALTH):
            self.bus.subscribe(keys.all_keys(PLANT, kind), self._on_message)

    def start(self, node: str) -> "subprocess.Popen[bytes]":
        """Start a node, and wait until it is alive."""
        process = self.nodes.start(node)
        self.wait(lambda: node in self._alive)
        return process

    def start_all(self) -> "tuple[subprocess.Popen[bytes], subprocess.Popen[bytes]]":
        """Start the recorder, the monitor and the plant, one after the other; the last two of them."""
        self.start("recorder")
        return self.start("monitor"), self.start("plant")

    def kill(self, node: str, process: "subprocess.Popen[bytes]") -> None:
        """End it without a last word."""
        process.kill()
        process.wait()
        self.wait(lambda: node not in self._alive)

    def wait_until(self, minute: float) -> None:
        """Wait until the plant has come so far."""
        self.wait(lambda: self.now_min >= minute)

    def wait(self, condition: Callable[[], bool]) -> None:
        """Wait until what was heard makes it so."""
        with self._changed:
            assert self._changed.wait_for(condition, WITHIN_S), f"not within {WITHIN_S:g} s"

    def wait_until_recorded(self) -> None:
        """Wait until the recorder has written the alarms received here; it can recover what it missed from a live node.

        The recording is read with each report of the monitor's health.
        """
        with self._changed:
            received, health = _changes(self.alarms), self.health

        def is_recorded() -> bool:
            nonlocal health
            if health is self.health:
                return False
            health = self.health
            return set(received) <= set(self._alarms_in(self.folder))

        self.wait(is_recorded)

    def end(self, plant: "subprocess.Popen[bytes]") -> None:
        """End the plant, wait until the monitor has judged its last row, and end the others."""
        self.wait_until(self._duration_min)
        plant.terminate()
        assert plant.wait(WITHIN_S) == 0
        self.wait(lambda: self._judged_min > self.now_min - 0.5 * PERIOD_MIN)
        assert self.nodes.stop(["monitor", "recorder"]) == {"monitor": 0, "recorder": 0}

    def recorded_alarms(self) -> list[Change]:
        """Changes of alarms in the recording; messages repeated after a restart count once."""
        return self._alarms_in(self.recording)

    def _alarms_in(self, path: Path) -> list[Change]:
        recorded = [decode(item.payload, item.encoding) for item in Recording(path).messages({keys.ALARM})]
        return list(dict.fromkeys(_changes(item for item in recorded if isinstance(item, Alarm))))

    def expected_alarms(self) -> list[Change]:
        """Publications of a monitor that hears all of the plant, and nothing else, without a stop.

        The plant is simulated once more, as a recorder, too, may miss samples.
        """
        assert self._first_ns is not None, "the plant has published nothing"
        record = simulate_record(self.plant, round(self._judged_min / PERIOD_MIN) + 1)
        published = map(encode, samples_of(record, PLANT, self._first_ns))
        changes = _changes(backtest.run(published, self.monitor).alarm_messages)
        assert changes, "the leak raises no alarm"
        return changes

    def _on_message(self, message: Encoded) -> None:
        body = _read(message)
        with self._changed:
            if isinstance(body, Sample) and is_of_plant(body) and message.key.endswith("/T"):
                self._first_ns = self._first_ns or body.time_ns
                self.now_min = (body.time_ns - self._first_ns) / MINUTE_NS
            elif isinstance(body, Estimate) and self._first_ns is not None:
                self._judged_min = max(self._judged_min, (body.time_ns - self._first_ns) / MINUTE_NS)
            elif isinstance(body, Alarm):
                self.alarms.append(body)
            elif isinstance(body, Incident):
                self.incidents.append(body)
            elif isinstance(body, Health) and body.node == "monitor":
                self.health = body
            self._changed.notify_all()

    def _on_alive(self, key: str, alive: bool) -> None:
        with self._changed:
            (self._alive.add if alive else self._alive.discard)(key.rsplit("/", 1)[1])
            self._changed.notify_all()

    def __enter__(self) -> "LiveRun":
        """The run itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """End all of it."""
        with self.nodes:
            pass
        self.bus.close()
        self.router.close()


def _read(message: Encoded) -> Message | None:
    try:
        return decode(message.payload, message.encoding)
    except DecodeError:
        return None


def is_of_plant(body: Message | None) -> bool:
    """Whether it is a sample of this run's plant: strangers' clocks are at another time."""
    return isinstance(body, Sample) and abs(body.time_ns / 1e9 - time.time()) < 36_000.0


def _changes(alarms: Iterable[Alarm]) -> list[Change]:
    """Without silences of the plant: on a machine that is busy with other things there are real ones."""
    return [Change(item.time_ns, item.alarm, item.event, item.raised_ns) for item in alarms if item.alarm != SILENCE]
