"""Plant, monitor and recorder on a real router; the recorder's link is cut, and its recording still replays."""

import contextlib
import json
import threading
import time
from pathlib import Path

import pytest

from benchmarks.harness.site import Heard, Proxy, Router, connect_client
from monitor_node.alarms.commands import COMMANDS
from monitor_node.config import MonitorConfig
from monitor_node.node import MonitorNode
from plant_node.__main__ import serve_plant
from plant_node.config import PlantConfig
from plant_node.node import PlantNode
from plant_node.record import plant_from
from reactorwatch.cli.processes import settings_text
from reactorwatch.cli.replay import run
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import EventLoop, StopSignal
from reactorwatch.runtime.http_pages import free_endpoint
from recorder.__main__ import record
from recorder.config import RecorderConfig
from tests.running import WITHIN_S, running

PLANT = PlantConfig(
    seed=5, speed=600.0, duration_min=60.0, faults=("coolant_flow:step:-0.08@30min",), wait_for=("monitor", "recorder")
)
MONITOR = MonitorConfig(training_min=15.0)
ROWS = 600
FIRST_JUDGED = 53
"""Fifty rows give the scaling, three more the first regressor."""
OF_RECORDER = keys.key("cstr", keys.HEALTH, "recorder")


def watch(bus_config: BusConfig, stop: StopSignal) -> None:
    with contextlib.closing(connect_client(bus_config)) as bus:
        loop = EventLoop(MonitorNode(MONITOR, time.time_ns()), bus, stop, drain_timeout_s=0.5)
        loop.subscribe(keys.all_keys("cstr", keys.SAMPLE))
        loop.accept_commands(*(keys.key("cstr", keys.COMMAND, name) for name in COMMANDS))
        bus.declare_token(keys.key("cstr", keys.ALIVE, "monitor"))
        loop.run()


class Counter:
    """How many messages came."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self.count = 0

    def add(self, _: object) -> None:
        with self._changed:
            self.count += 1
            self._changed.notify_all()

    def wait(self, count: int) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: self.count >= count, WITHIN_S), f"{self.count} of {count}"


@pytest.mark.slow
def test_a_run_that_was_recorded_over_a_cut_link_is_exact(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, published, judged, said = tmp_path / "run.mcap", Counter(), Counter(), Counter()
    about = {"settings": settings_text({"monitor": MONITOR})}
    config = RecorderConfig(out=str(path), about=about, black_box_min=0.0, health_period_s=0.2)
    endpoint = free_endpoint()
    direct = BusConfig(endpoint=endpoint)
    with contextlib.closing(Router(endpoint)), contextlib.closing(connect_client(direct)) as bus:
        proxy = Proxy(endpoint)
        watching, recording = StopSignal(), StopSignal()
        heard = Heard(bus)
        bus.subscribe(keys.key("cstr", keys.SAMPLE, "T"), published.add)
        bus.subscribe(keys.key("cstr", keys.ESTIMATE, "T"), judged.add)
        bus.subscribe("reactor/cstr/**", lambda message: None if message.key == OF_RECORDER else said.add(message))
        with (
            contextlib.closing(proxy),
            running(lambda: record(config, BusConfig(endpoint=proxy.endpoint), recording), recording),
        ):
            with (
                running(lambda: watch(direct, watching), watching),
                contextlib.closing(connect_client(direct)) as plant_bus,
            ):
                plant = PlantNode(plant_from(PLANT), PLANT, lambda _: None)
                with running(lambda: serve_plant(plant, PLANT, plant_bus, StopSignal()), StopSignal()):
                    published.wait(250)
                    with proxy.cut("closed"):
                        published.wait(400)
                    published.wait(ROWS)
                judged.wait(ROWS - FIRST_JUDGED)
            bus.query(Encoded(keys.key("cstr", keys.COMMAND, "nothing"), b"", ""), WITHIN_S)  # then all of it is here
            assert heard.wait(said.count)
    assert run(path, None, None, as_json=True) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (told["exact"], told["rows"], told["notes"]) == (True, ROWS, [])
