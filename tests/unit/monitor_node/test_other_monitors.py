"""Monitors of the same plant notice each other, whether each watches one plant or a fleet."""

from itertools import combinations_with_replacement

import pytest

from monitor_node.config import MonitorConfig
from monitor_node.fleet import FleetConfig, shard_of
from monitor_node.health import GONE, MOST_GROUPS, NOTICED, OtherMonitors
from monitor_node.node import MonitorNode
from reactorwatch.contract import keys
from tests.memory_bus import Exchange, MemoryBus

from .fleets import QUICK, SECOND_NS

PLANT = "cstr"
SINGLE = "one plant"
SHARD = f"{shard_of(PLANT, 2)}/2"
KINDS = (SINGLE, "reactor/* 1/1", f"reactor/* {SHARD}", "reactor/c*r 1/1", "reactor/cstr 1/1")
"""Monitors by plants and shard; each watches the plant."""


class Process:
    """A monitor on a bus, wired as its process wires it."""

    def __init__(self, kind: str, exchange: Exchange, start_ns: int) -> None:
        self.bus = MemoryBus(exchange)
        if kind == SINGLE:
            self.node = MonitorNode(MonitorConfig(plant=PLANT), start_ns)
        else:
            plants, _, shard = kind.partition(" ")
            self.node = MonitorNode(QUICK, start_ns, FleetConfig(plants=plants, shard=shard))
        for expression in self.node.tokens:
            self.bus.subscribe_liveliness(expression, lambda token, is_alive: self.on_token(token, is_alive=is_alive))
        self.node.declare_tokens(self.bus)
        self.bus.declare_token(self.node.token)

    def on_token(self, token: str, *, is_alive: bool) -> None:
        self.node.on_alive(token, is_alive, SECOND_NS)

    def watches(self) -> bool:
        """True if it watches the plant."""
        return PLANT in self.node.plants


def start(*kinds: str) -> tuple[list[Process], MemoryBus]:
    """Start a plant and monitors."""
    exchange = Exchange()
    plant, processes = MemoryBus(exchange), [Process(kind, exchange, at) for at, kind in enumerate(kinds)]
    plant.declare_token(keys.key(PLANT, keys.ALIVE, "plant"))
    return processes, plant


def lines(capsys: pytest.CaptureFixture[str], text: str) -> list[str]:
    """The lines of the log that hold a text; what was logged so far is not read again."""
    return [line for line in capsys.readouterr().out.splitlines() if text in line]


@pytest.mark.parametrize("kinds", tuple(combinations_with_replacement(KINDS, 2)), ids=" and ".join)
def test_each_of_two_monitors_of_a_plant_reports_the_other_once(
    kinds: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Two with the same plants and the same shard never run together: the second is refused when it joins the bus."""
    (first, second), plant = start(*kinds)
    plant.declare_token(keys.key(PLANT, keys.ALIVE, "replay"))
    plant.declare_token(keys.key("other", keys.ALIVE, "plant"))
    is_same = kinds[0] == kinds[1] != SINGLE
    assert first.watches()
    assert second.watches()
    reported = lines(capsys, NOTICED)
    assert len(reported) == (0 if is_same else 2)
    assert all(f"plant={PLANT}" in line for line in reported)
    second.bus.close()
    assert len(lines(capsys, GONE)) == (0 if is_same else 1)


def test_shards_of_one_fleet_do_not_report_each_other(capsys: pytest.CaptureFixture[str]) -> None:
    (first, second, other), _ = start("reactor/* 1/2", "reactor/* 2/2", "reactor/c* 1/1")
    assert sorted(item.watches() for item in (first, second)) == [False, True]
    assert sorted(line.partition("other=")[2].partition(" plant=")[0] for line in lines(capsys, NOTICED)) == [
        "'fleet reactor/* (2 shards)'",
        "'fleet reactor/c* (1 shard)'",
    ]
    other.bus.close()
    assert len(lines(capsys, GONE)) == 1


@pytest.mark.parametrize("kind", ["reactor/north_* 1/1", "reactor/*x 1/1", "reactor/cst 1/2"])
@pytest.mark.parametrize("beside", [SINGLE, "reactor/c* 1/1"])
def test_monitors_of_other_plants_are_not_reported(kind: str, beside: str, capsys: pytest.CaptureFixture[str]) -> None:
    start(kind, beside)
    assert lines(capsys, NOTICED) == []


@pytest.mark.parametrize("name", ["", "+/x", "a b", "++", "\n"])
def test_a_fleet_s_token_that_names_no_plants_is_ignored(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    others = OtherMonitors("", lambda: (PLANT,))
    others.on_token(keys.fleet_token(name, "1", "1", "01"), is_alive=True)
    others.check(PLANT)
    assert lines(capsys, NOTICED) == []
    assert others.count(PLANT) == 0


def test_there_is_room_for_so_many_groups_and_for_more_when_some_have_gone(
    capsys: pytest.CaptureFixture[str],
) -> None:
    others = OtherMonitors("", lambda: (PLANT,))
    for number in range(MOST_GROUPS):
        others.on_token(keys.monitor_token(f"p{number}", "a"), is_alive=True)
    last = keys.monitor_token(PLANT, "a")
    others.on_token(last, is_alive=True)
    assert lines(capsys, NOTICED) == []
    others.on_token(keys.monitor_token("p7", "a"), is_alive=False)
    others.on_token(last, is_alive=True)
    assert len(lines(capsys, NOTICED)) == 1
    assert others.count(PLANT) == 1
