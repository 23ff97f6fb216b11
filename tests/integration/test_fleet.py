"""Monitors of a fleet on a real router: plants are discovered, and a monitor that dies is replaced."""

import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue

import pytest
import structlog

from monitor_node.fleet_config import FleetConfig
from reactorwatch.cli.processes import write_settings
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, decode, encode_message
from reactorwatch.contract.messages_pb2 import Alarm, CommandReply, ListAlarms
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.bus_zenoh import ZenohBus
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.loopback import free_endpoint
from reactorwatch.runtime.serve import StopSignal
from tests.unit.monitor_node.fleets import QUICK, run_of

WITHIN_S = 30.0
PLANTS = ("alpha", "beta", "gamma", "delta")


@pytest.fixture(autouse=True)
def plain_log() -> None:
    """An earlier test may have sent the log to a stream that is closed by now."""
    structlog.reset_defaults()


@pytest.fixture
def bus_config() -> Iterator[BusConfig]:
    """A router of its own for each test."""
    config = BusConfig(endpoint=free_endpoint())
    router = bus_zenoh.router(config)
    yield config
    router.close()


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
def client(config: BusConfig) -> Iterator[ZenohBus]:
    bus = bus_zenoh.connect(config, "test", StopSignal())
    assert bus is not None
    yield bus
    bus.close()


@contextmanager
def monitor(config: BusConfig, folder: Path, shard: str) -> Iterator[subprocess.Popen[bytes]]:
    """A monitor of a shard, as a process of its own, which is killed at the end if it still runs."""
    settings = folder / f"{shard.replace('/', '-')}.toml"
    write_settings(settings, {"bus": config, "monitor": QUICK, "fleet": FleetConfig(plants="reactor/*", shard=shard)})
    command = [sys.executable, "-m", "reactorwatch", "monitor", "--config", str(settings)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            yield process
        finally:
            process.kill()


def crew_is(bus: ZenohBus, count: int) -> Callable[[], None]:
    """Wait until so many monitors of the fleet are there."""
    there, changed = set[str](), threading.Condition()

    def on_token(key: str, is_alive: bool) -> None:
        with changed:
            (there.add if is_alive else there.discard)(key)
            changed.notify_all()

    bus.watch_alive(f"{keys.ROOT}/{keys.FLEET}/**", on_token)

    def wait() -> None:
        with changed:
            assert changed.wait_for(lambda: len(there) == count, WITHIN_S), there

    return wait


def test_plants_are_discovered_by_their_tokens_and_by_their_samples(bus_config: BusConfig, tmp_path: Path) -> None:
    with client(bus_config) as bus, monitor(bus_config, tmp_path, "1/1"):
        watchers, health = Watchers(), SimpleQueue[str]()
        bus.watch_alive("reactor/*/alive/monitor", watchers.on_token)
        bus.subscribe("reactor/*/health/monitor", lambda message: health.put(message.key))
        crew_is(bus, 1)()
        bus.announce("reactor/alpha/alive/plant")
        watchers.wait_for({"alpha"})
        bus.publish(run_of("beta", 1, span_min=1.0)[0])
        watchers.wait_for({"alpha", "beta"})
        heard = {health.get(timeout=WITHIN_S) for _ in range(4)}
        assert heard == {"reactor/alpha/health/monitor", "reactor/beta/health/monitor"}


def test_one_monitor_answers_a_command_and_that_of_the_plant(bus_config: BusConfig, tmp_path: Path) -> None:
    payload, encoding = encode_message(ListAlarms())
    with client(bus_config) as bus, monitor(bus_config, tmp_path, "1/2"), monitor(bus_config, tmp_path, "2/2"):
        watchers = Watchers()
        bus.watch_alive("reactor/*/alive/monitor", watchers.on_token)
        crew_is(bus, 2)()
        for plant in PLANTS:
            bus.announce(f"reactor/{plant}/alive/plant")
        watchers.wait_for(set(PLANTS))
        for plant in PLANTS:
            (answer,) = bus.ask(Encoded(f"reactor/{plant}/command/list_alarms", payload, encoding), WITHIN_S)
            reply = decode(answer.payload, answer.encoding)
            assert isinstance(reply, CommandReply)
            assert "ewma/T" in [alarm.alarm for alarm in reply.alarms]


def test_the_plants_of_a_monitor_that_is_killed_are_taken_over(bus_config: BusConfig, tmp_path: Path) -> None:
    with (
        client(bus_config) as bus,
        monitor(bus_config, tmp_path, "1/2"),
        monitor(bus_config, tmp_path, "2/2") as second,
    ):
        watchers = Watchers()
        bus.watch_alive("reactor/*/alive/monitor", watchers.on_token)
        crew_is(bus, 2)()
        for plant in PLANTS:
            bus.announce(f"reactor/{plant}/alive/plant")
        watchers.wait_for(set(PLANTS))
        alarms: SimpleQueue[str] = SimpleQueue()
        bus.subscribe("reactor/*/alarm/**", lambda message: alarms.put(_raised(message)))
        second.send_signal(signal.SIGKILL)
        second.wait()
        crew_is(bus, 1)()
        watchers.wait_for(set(PLANTS))
        for plant in PLANTS:
            for message in run_of(plant, 2, leak_min=30.0, span_min=35.0):
                bus.publish(message)
        raised = set[str]()
        while len({name.split("/")[1] for name in raised if name}) < len(PLANTS):
            raised.add(alarms.get(timeout=WITHIN_S))


def _raised(message: Encoded) -> str:
    alarm = decode(message.payload, message.encoding)
    return message.key if isinstance(alarm, Alarm) and alarm.event == "raised" else ""
