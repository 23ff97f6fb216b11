"""Monitors of a fleet on a real router: plants are discovered, shards divide them, and a killed monitor resumes."""

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import NamedTuple
from urllib.request import urlopen

import msgspec
import pytest

from monitor_node.fleet import FleetConfig
from reactorwatch.cli.processes import write_settings
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, decode, encode_message
from reactorwatch.contract.messages_pb2 import Alarm, CommandReply, Health, ListAlarms
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.bus_zenoh import ZenohBus
from reactorwatch.runtime.config import BusConfig, MetricsConfig
from reactorwatch.runtime.event_loop import StopSignal
from reactorwatch.runtime.http_pages import LOOPBACK, PORT_OFFSET
from tests.ports import three_free_ports
from tests.running import WITHIN_S
from tests.unit.monitor_node.fleets import QUICK, alone, run_of

from .client import client

pytestmark = pytest.mark.usefixtures("plain_log")

PLANTS = ("alpha", "beta", "gamma", "delta")
START_WITHIN_S = 180.0
"""Where no monitor of a fleet ever ran, the first one compiles before it joins."""


class Watchers:
    """Who watches which plant, by the tokens."""

    def __init__(self) -> None:
        self._alive: list[str] = []
        self._changed = threading.Condition()

    def on_token(self, key: str, is_alive: bool) -> None:
        topic = keys.parse(key)
        assert topic is not None
        with self._changed:
            self._alive.append(topic.plant) if is_alive else self._alive.remove(topic.plant)
            self._changed.notify_all()

    def wait_for(self, plants: set[str]) -> None:
        """Wait until just these are watched."""
        with self._changed:
            assert self._changed.wait_for(lambda: set(self._alive) == plants, WITHIN_S), self._alive


@contextmanager
def monitor(
    config: BusConfig, folder: Path, shard: str, state: Path | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """A monitor of a shard, as a process of its own, which is killed at the end if it still runs."""
    with started(config, folder, shard, state) as process:
        try:
            yield process
        finally:
            process.kill()


def started(config: BusConfig, folder: Path, shard: str, state: Path | None) -> subprocess.Popen[bytes]:
    settings = folder / f"{shard.replace('/', '-')}.toml"
    fleet = FleetConfig(plants="reactor/*", shard=shard, state=str(state) if state is not None else None)
    watched = msgspec.structs.replace(QUICK, state_every_s=0.3, health_period_s=0.2)
    write_settings(settings, {"bus": config, "monitor": watched, "fleet": fleet})
    command = [sys.executable, "-m", "reactorwatch", "monitor", "--config", str(settings)]
    with (folder / f"{settings.stem}.log").open("ab") as said:
        return subprocess.Popen(command, stderr=said)


def crew_of(bus: ZenohBus) -> Callable[[int], None]:
    """Waits until so many monitors of the fleet are there."""
    there, changed = set[str](), threading.Condition()

    def on_token(key: str, is_alive: bool) -> None:
        with changed:
            (there.add if is_alive else there.discard)(key)
            changed.notify_all()

    bus.subscribe_liveliness(f"{keys.ROOT}/{keys.FLEET}/**", on_token)

    def wait(count: int) -> None:
        with changed:
            assert changed.wait_for(lambda: len(there) == count, START_WITHIN_S), there

    return wait


def test_plants_are_discovered_by_their_tokens_and_by_their_samples(bus_config: BusConfig, tmp_path: Path) -> None:
    with client(bus_config) as bus, monitor(bus_config, tmp_path, "1/1"):
        watchers, health = Watchers(), SimpleQueue[str]()
        bus.subscribe_liveliness("reactor/*/alive/monitor", watchers.on_token)
        bus.subscribe("reactor/*/health/monitor", lambda message: health.put(message.key))
        crew_of(bus)(1)
        bus.declare_token("reactor/alpha/alive/plant")
        watchers.wait_for({"alpha"})
        bus.publish(run_of("beta", 1, span_min=1.0)[0])
        watchers.wait_for({"alpha", "beta"})
        heard = set[str]()
        while len(heard) < 2:
            heard.add(health.get(timeout=WITHIN_S))
        assert heard == {"reactor/alpha/health/monitor", "reactor/beta/health/monitor"}


def test_what_is_counted_of_each_plant_is_on_the_monitor_s_page(bus_config: BusConfig, tmp_path: Path) -> None:
    pytest.importorskip("prometheus_client", reason="prometheus-client (reactorwatch[metrics]) is not installed")
    port, settings = three_free_ports(), tmp_path / "settings.toml"
    fleet, metrics = FleetConfig(plants="reactor/*"), MetricsConfig(port=port)
    write_settings(settings, {"bus": bus_config, "monitor": QUICK, "fleet": fleet, "metrics": metrics})
    command = [sys.executable, "-m", "reactorwatch", "monitor", "--config", str(settings)]
    with client(bus_config) as bus, (tmp_path / "log").open("wb") as said:
        health, process = SimpleQueue[str](), subprocess.Popen(command, stderr=said)
        bus.subscribe("reactor/*/health/monitor", lambda message: health.put(message.key))
        try:
            crew_of(bus)(1)
            for plant in PLANTS:
                bus.declare_token(f"reactor/{plant}/alive/plant")
            told = set[str]()
            while len(told) < len(PLANTS):
                told.add(health.get(timeout=WITHIN_S))
            with urlopen(f"http://{LOOPBACK}:{port + PORT_OFFSET['monitor']}/metrics", timeout=WITHIN_S) as answer:
                page = answer.read().decode()
        finally:
            process.kill()
            process.wait()
    for plant in PLANTS:
        assert f'reactorwatch_messages_received_total{{node="monitor",plant="{plant}"}} 0.0' in page


def test_each_plant_is_watched_by_the_monitor_of_its_shard_which_answers_its_commands(
    bus_config: BusConfig, tmp_path: Path
) -> None:
    payload, encoding = encode_message(ListAlarms())
    with client(bus_config) as bus, monitor(bus_config, tmp_path, "1/2"), monitor(bus_config, tmp_path, "2/2"):
        watchers = Watchers()
        bus.subscribe_liveliness("reactor/*/alive/monitor", watchers.on_token)
        crew_of(bus)(2)
        for plant in PLANTS:
            bus.declare_token(f"reactor/{plant}/alive/plant")
        watchers.wait_for(set(PLANTS))
        for plant in PLANTS:
            (answer,) = bus.query(Encoded(f"reactor/{plant}/command/list_alarms", payload, encoding), WITHIN_S)
            reply = decode(answer.payload, answer.encoding)
            assert isinstance(reply, CommandReply)
            assert "ewma/T" in [alarm.alarm for alarm in reply.alarms]


class AlarmLog:
    """The alarms of plants, and how many rows were judged, as monitors publish it."""

    def __init__(self, bus: ZenohBus) -> None:
        self.changes: dict[str, list[Change]] = {plant: [] for plant in PLANTS}
        self._rows = dict.fromkeys(PLANTS, 0)
        self._changed = threading.Condition()
        bus.subscribe("reactor/*/alarm/**", self._on_message)
        bus.subscribe("reactor/*/health/monitor", self._on_message)

    def _on_message(self, encoded: Encoded) -> None:
        message, topic = decode(encoded.payload, encoded.encoding), keys.parse(encoded.key)
        assert topic is not None
        with self._changed:
            if isinstance(message, Alarm):
                self.changes[topic.plant].append(change(message))
            elif isinstance(message, Health):
                self._rows[topic.plant] = message.rows
            self._changed.notify_all()

    def wait_for(self, rows: int, changes: int = 0) -> None:
        """Wait until so many rows of each plant were judged, and so many changes of alarms were published in all."""
        with self._changed:
            assert self._changed.wait_for(
                lambda: min(self._rows.values()) >= rows and sum(map(len, self.changes.values())) >= changes, WITHIN_S
            ), (self._rows, self.changes)


class Change(NamedTuple):
    """What happens to an alarm."""

    alarm: str
    event: str
    time_ns: int


def change(alarm: Alarm) -> Change:
    return Change(alarm.alarm, alarm.event, alarm.time_ns)


def test_repeated_messages_wait_on_new_keys_if_there_were_many_lately(
    bus_config: BusConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("reactorwatch.runtime.bus_zenoh.bus.MAX_NEW_KEYS", 2)
    monkeypatch.setattr("reactorwatch.runtime.bus_zenoh.bus.NEW_KEYS_PER_S", 0)
    heard: SimpleQueue[tuple[str, bytes]] = SimpleQueue()
    bus = bus_zenoh.connect(bus_config, "test", StopSignal(), uncached=("health",))
    with client(bus_config) as listener:
        assert bus is not None
        listener.subscribe("reactor/*/*/monitor", lambda message: heard.put((message.key, message.payload)))
        while heard.empty():  # what is not cached is lost as long as the subscription is on its way
            bus.publish(Encoded("reactor/a/health/monitor", b"", ""))
            with contextlib.suppress(Empty):
                heard.put(heard.get(timeout=0.1))
        for _ in range(2):
            for plant in "abc":
                bus.publish(Encoded(f"reactor/{plant}/health/monitor", b"", ""))
        last = "reactor/a/health/monitor", b"the last"  # an alarm would overtake what has a lower priority
        bus.publish(Encoded(*last, ""))
        keys_heard = [key for key, _ in iter(partial(heard.get, timeout=WITHIN_S), last)]
        bus.close()
    assert keys_heard[-4:] == ["reactor/a/health/monitor", "reactor/b/health/monitor"] * 2
    assert set(keys_heard[:-4]) == {"reactor/a/health/monitor"}


LARGE, MOST_MORE = 10_000_000, 200_000_000
"""Bytes: of a payload, and that a monitor may take more when fifty such come as fast as they can."""


def test_payloads_of_ten_megabytes_are_all_counted_and_take_no_room(bus_config: BusConfig, tmp_path: Path) -> None:
    with client(bus_config) as bus, monitor(bus_config, tmp_path, "1/1") as process:
        refused: SimpleQueue[int] = SimpleQueue()

        def on_health(message: Encoded) -> None:
            health = decode(message.payload, message.encoding)
            assert isinstance(health, Health)
            refused.put(health.refused_by_reason["too_large"])

        bus.subscribe("reactor/*/health/monitor", on_health)
        crew_of(bus)(1)
        for sample in run_of("alpha", 1):  # the first may come before the router knows who subscribes
            bus.publish(sample)
            with contextlib.suppress(Empty):
                assert refused.get(timeout=1.0) == 0
                break
        before, most = memory_bytes(process), 0
        for number in range(50):
            bus.publish(Encoded("reactor/alpha/sample/T", bytes(LARGE), f"x{number}"))
            most = max(most, memory_bytes(process))
        while refused.get(timeout=WITHIN_S) < 50:
            most = max(most, memory_bytes(process))
        assert most - before < MOST_MORE


def memory_bytes(process: subprocess.Popen[bytes]) -> int:
    return int(Path(f"/proc/{process.pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


KILLED_AT = (120, 280, 330)
"""Rows: in training, watching, and while the alarms of the leak stand."""


@pytest.mark.slow
def test_kills_of_monitors_neither_lose_an_alarm_nor_publish_one_twice(bus_config: BusConfig, tmp_path: Path) -> None:
    runs = {plant: run_of(plant, seed, leak_min=30.0, span_min=40.0) for seed, plant in enumerate(PLANTS, start=40)}
    expected = {
        plant: [change(item.message) for item in alone(plant, run) if isinstance(item.message, Alarm)]
        for plant, run in runs.items()
    }
    processes = {shard: started(bus_config, tmp_path, f"{shard}/2", tmp_path / f"states{shard}") for shard in (1, 2)}
    with client(bus_config) as bus:
        alarm_log, crew_are, watchers = AlarmLog(bus), crew_of(bus), Watchers()
        bus.subscribe_liveliness("reactor/*/alive/monitor", watchers.on_token)
        for plant in PLANTS:
            bus.declare_token(f"reactor/{plant}/alive/plant")
        watchers.wait_for(set(PLANTS))  # both have subscribed
        try:
            for row in range(len(runs["alpha"]) // 3):
                for run in runs.values():
                    for message in run[3 * row : 3 * row + 3]:
                        bus.publish(message)
                if row in KILLED_AT:
                    alarm_log.wait_for(row)
                    shard = 1 + KILLED_AT.index(row) % 2
                    processes[shard].kill()
                    processes[shard].wait()
                    crew_are(1)
                    processes[shard] = started(bus_config, tmp_path, f"{shard}/2", tmp_path / f"states{shard}")
                    crew_are(2)
            alarm_log.wait_for(len(runs["alpha"]) // 3, sum(map(len, expected.values())))
            for process in processes.values():
                process.terminate()
                assert process.wait(WITHIN_S) == 0
        finally:
            for process in processes.values():
                process.kill()
                process.wait()
        assert all(expected.values())
        assert alarm_log.changes == expected
