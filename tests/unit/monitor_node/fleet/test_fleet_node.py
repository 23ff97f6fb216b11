"""A fleet's monitor with a folder of states, beside another one: who has a plant last, has it."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import SimpleQueue

import msgspec
import pytest

from monitor_node.core import Monitor
from monitor_node.fleet import node as fleet_node
from monitor_node.fleet.config import FleetConfig
from monitor_node.fleet.node import POLL_NS, FleetNode
from monitor_node.fleet.sharding import Shard, ShardGroup, home_shard
from monitor_node.storage import state_recovery
from monitor_node.storage.fleet_states import FleetStates
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode_message
from reactorwatch.contract.messages_pb2 import Alarm, AlarmCommand, AlarmKpis
from reactorwatch.runtime.metrics import Metrics
from reactorwatch.runtime.security.command_rate import PER_NAME
from tests.memory_bus import Exchange, MemoryBus
from tests.running import WITHIN_S

from ..fleets import PLANTS, QUICK, fleet, row_by_row, run_of


class Linked(MemoryBus):
    """A bus whose router can be gone."""

    has_router = True


class Bench:
    """A monitor, and the clock that it is told."""

    def __init__(self, folder: Path, shard: str) -> None:
        self.bus, self.states, self.now_ns = Linked(Exchange()), FleetStates(folder), 0
        config = msgspec.structs.replace(QUICK, state_every_s=0.1)
        self.node = FleetNode(config, FleetConfig(plants="reactor/*", shard=shard), self.bus, 0, self.states)
        self.calls: SimpleQueue[Callable[[int], list[Publication]]] = SimpleQueue()
        for _ in self.node.subscriptions:
            self.node.on_subscribed(self.calls.put)

    def tick(self) -> None:
        """A moment later."""
        self.now_ns += POLL_NS
        self.node.on_tick(self.now_ns)
        while not self.calls.empty():
            self.calls.get()(self.now_ns)

    def tick_until_watched(self, plant: str) -> None:
        """Its past is found by a thread."""
        until_s = time.monotonic() + WITHIN_S
        while plant not in self.node.plants:
            assert time.monotonic() < until_s
            self.tick()


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[Bench]:
    """One of two monitors, both of whose shards it has, or a single one."""
    for name in ("HANDOVER_S", "RETURN_S", "POLL_S"):
        monkeypatch.setattr(state_recovery, name, 0.0)
    bench = Bench(tmp_path, getattr(request, "param", "1/2"))
    for _ in range(101):  # the other was never seen
        bench.tick()
    bench.node.on_alive("reactor/a/alive/plant", True, bench.now_ns)
    bench.tick_until_watched("a")
    yield bench
    bench.node.on_stop(bench.now_ns)


def test_who_finds_a_newer_state_than_his_own_where_he_wants_to_store_goes_on_from_it(
    bench: Bench, tmp_path: Path
) -> None:
    run = run_of("a", 1, span_min=5.0)
    other = fleet()
    other.on_messages(run[:60], 0)
    (tmp_path / "a.state").write_bytes(other.state_of("a"))
    bench.node.on_messages(run[:30], bench.now_ns)
    assert bench.node.monitor("a").rows == 10
    bench.states.put("a", bench.node.state_of("a"))
    until_s = time.monotonic() + WITHIN_S
    while "a" not in bench.node.plants or bench.node.monitor("a").rows == 10:
        assert time.monotonic() < until_s
        bench.tick()
    assert bench.node.monitor("a").rows == 20


def test_while_the_router_is_gone_and_until_the_others_had_their_time_nothing_is_judged(bench: Bench) -> None:
    run, returned_at = run_of("a", 1, span_min=5.0), 0
    bench.bus.has_router = False
    bench.tick()
    for place in range(0, 60, 3):
        bench.tick()
        bench.node.on_messages(run[place : place + 3], bench.now_ns)
    assert bench.node.monitor("a").rows == 0
    bench.bus.has_router = True
    while bench.node.paused:
        assert bench.node.monitor("a").rows == 0
        bench.tick()
        returned_at += 1
    assert returned_at * POLL_NS == 2_000_000_000
    assert bench.node.monitor("a").rows == 20


def test_while_the_router_is_gone_for_long_more_than_can_be_held_is_judged(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("monitor_node.fleet.monitor.MOST_HELD", 60)
    run = run_of("a", 1, span_min=10.0)
    bench.bus.has_router = False
    bench.tick()
    for place in range(0, 240, 3):
        bench.tick()
        bench.node.on_messages(run[place : place + 3], bench.now_ns)
    assert bench.node.monitor("a").rows == 80


def test_an_alarm_that_is_found_in_what_was_held_back_is_logged_once(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    logged: list[str] = []
    monkeypatch.setattr(fleet_node.log, "info", lambda event, **_: logged.append(event))
    run = run_of("a", 1, leak_min=30.0)
    bench.bus.has_router = False
    bench.tick()
    bench.tick()
    bench.node.on_messages(run, bench.now_ns)
    bench.bus.has_router = True
    said: list[Publication] = []
    while bench.node.paused:
        bench.now_ns += POLL_NS
        said += bench.node.on_tick(bench.now_ns)
    told = sum(isinstance(item.message, Alarm) for item in said)
    assert told > 0
    assert logged.count("alarm") == told


@pytest.mark.parametrize("bench", ["1/1"], indirect=True)
def test_who_is_alone_goes_on_while_the_router_is_gone(bench: Bench) -> None:
    bench.bus.has_router = False
    bench.tick()
    bench.tick()
    assert not bench.node.paused


def test_commands_are_left_to_the_others_while_they_may_have_the_plant(bench: Bench) -> None:
    bench.bus.has_router = False
    bench.tick()
    bench.tick()
    assert bench.node.on_command(run_of("a", 1, span_min=1.0)[0], bench.now_ns) == (None, [])


def test_a_flood_of_commands_is_refused_and_leaves_quiet_plants_quiet(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    """A plant that a command reaches has a monitor of its own for a while, which is ten times slower."""
    command = AlarmCommand(alarm="shewhart/T", by="Anna", comment="x")
    question = Encoded("reactor/a/command/comment", *encode_message(command))
    replies = [bench.node.on_command(question, bench.now_ns)[0] for _ in range(3000)]
    refused = [reply for reply in replies if reply is not None and "too many commands" in reply.text]
    assert len(refused) == 3000 - PER_NAME.at_once
    assert bench.node.monitor("a").rejects.by_reason["too_many_commands"] == len(refused)
    for _ in range(101):
        bench.tick()
    assert f"too_many_commands ({len(refused)} so far)" in capsys.readouterr().out
    assert bench.node.on_command(question._replace(key="reactor/b/command/comment"), bench.now_ns) == (None, [])


def test_the_counts_and_alarms_of_each_plant_are_on_the_page_as_long_as_it_is_watched(bench: Bench) -> None:
    pytest.importorskip("prometheus_client", reason="prometheus-client (reactorwatch[metrics]) is not installed")
    metrics = bench.node.metrics = Metrics("monitor")
    plant = next(name for name in map(str, range(99)) if home_shard(name, 2) == 2)
    bench.node.on_alive(f"reactor/{plant}/alive/plant", True, bench.now_ns)
    bench.tick_until_watched(plant)
    run = run_of(plant, 1, span_min=1.0)
    bench.node.on_messages(run, bench.now_ns)
    bench.now_ns += int(QUICK.health_period_s * 1e9)
    for publication in bench.node.on_tick(bench.now_ns):
        metrics.on_publish(publication)
    shown = {metric.name: metric.samples for metric in metrics.collect()}
    (rows,) = shown["reactorwatch_rows"]
    assert (rows.labels, rows.value) == ({"plant": plant, "node": "monitor"}, len(run) // 3)
    normal = [sample.value for sample in shown["reactorwatch_alarms"] if sample.labels["state"] == "normal"]
    assert normal == [len(bench.node.monitor(plant).alarms.all_alarms())]
    bench.node.on_alive(ShardGroup(bench.node.expression, Shard(2, 2), "other").token, True, bench.now_ns)
    assert list(metrics.collect()) == []


def test_there_is_no_file_of_a_plant_of_which_nothing_is_known(bench: Bench, tmp_path: Path) -> None:
    bench.node.on_messages(run_of("made-up", 1, span_min=1.0), bench.now_ns)
    bench.tick_until_watched("made-up")
    for _ in range(10):
        bench.tick()
    bench.node.on_messages(run_of("a", 1, span_min=1.0), bench.now_ns)
    bench.node.on_stop(bench.now_ns)
    assert [path.name for path in tmp_path.iterdir()] == ["a.state"]


def test_figures_of_alarms_are_told_from_the_first_alarm_of_a_plant_on() -> None:
    node = FleetNode(QUICK, FleetConfig(plants=PLANTS), MemoryBus(Exchange()), 0)
    runs = {"sound": run_of("sound", 21), "leaking": run_of("leaking", 22, leak_min=30.0)}
    said = list[Publication]()
    messages = row_by_row(runs.values())
    for begin in range(0, len(messages), 60):
        said += node.on_messages(messages[begin : begin + 60], 10**9 * begin)
    own = Monitor(msgspec.structs.replace(QUICK, plant="leaking"), 0, points=False)
    expected = [item for message in runs["leaking"] for item in own.on_message(message, 0)]
    first = next(place for place, item in enumerate(expected) if isinstance(item.message, Alarm))
    figures = [item for item in expected[first:] if isinstance(item.message, AlarmKpis)]
    assert len(figures) > 1
    assert [item for item in said if isinstance(item.message, AlarmKpis)] == figures


def test_a_monitor_of_a_plant_alone_is_reported(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    bench.node.on_alive(keys.monitor_token("a", "00-0f"), True, bench.now_ns)
    assert "another monitor watches this plant" in capsys.readouterr().out
    bench.node.on_alive("reactor/a/alive/monitor", True, bench.now_ns)
    bench.node.on_alive(keys.monitor_token("a", "00-0f"), False, bench.now_ns)
    assert "another monitor" not in capsys.readouterr().out
