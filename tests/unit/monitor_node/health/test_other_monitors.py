"""Monitors of the same plant notice each other, whether each watches one plant or a fleet."""

from itertools import combinations_with_replacement

import pytest

from monitor_node.__main__ import MonitorNode, declare_tokens
from monitor_node.config import MonitorConfig
from monitor_node.fleet.config import FleetConfig
from monitor_node.fleet.monitor import PRESUME_GONE_NS
from monitor_node.fleet.node import FleetNode
from monitor_node.health.other_monitors import GONE, MOST_GROUPS, NOTICED, OtherMonitors
from reactorwatch.contract import keys
from tests.memory_bus import Exchange, MemoryBus

from ..fleets import QUICK, SECOND_NS

PLANT = "cstr"
SINGLE = "one plant"
KINDS = (SINGLE, "reactor/* 1/1", "reactor/* 1/2", "reactor/c*r 1/1", "reactor/cstr 1/1")
"""Monitors by plants and shard; each watches the plant when it is the only one of its crew."""


class Process:
    """A monitor on a bus, wired as its process wires it."""

    def __init__(self, kind: str, exchange: Exchange, start_ns: int) -> None:
        self.bus = MemoryBus(exchange)
        self.node: MonitorNode | FleetNode
        if kind == SINGLE:
            self.node = MonitorNode(MonitorConfig(plant=PLANT), start_ns)
        else:
            plants, _, shard = kind.partition(" ")
            self.node = FleetNode(QUICK, FleetConfig(plants=plants, shard=shard), self.bus, start_ns)
        for expression in self.node.tokens:
            self.bus.subscribe_liveliness(expression, lambda token, is_alive: self.on_token(token, is_alive=is_alive))
        if isinstance(self.node, MonitorNode):
            declare_tokens(self.node, self.bus)
        else:
            self.bus.declare_token(self.node.shards.token)

    def on_token(self, token: str, *, is_alive: bool) -> None:
        self.node.on_alive(token, is_alive, SECOND_NS)

    def watches(self) -> bool:
        """True if it watches the plant."""
        return isinstance(self.node, MonitorNode) or self.node.is_watched(PLANT)


def start(*kinds: str) -> tuple[list[Process], MemoryBus]:
    """Start a plant and monitors, and let the time pass after which a shard without a monitor counts as gone."""
    exchange = Exchange()
    plant, processes = MemoryBus(exchange), [Process(kind, exchange, at) for at, kind in enumerate(kinds)]
    plant.declare_token(keys.key(PLANT, keys.ALIVE, "plant"))
    for process in processes:
        process.node.on_tick(PRESUME_GONE_NS)
    return processes, plant


def lines(capsys: pytest.CaptureFixture[str], text: str) -> list[str]:
    """The lines of the log that hold a text; what was logged so far is not read again."""
    return [line for line in capsys.readouterr().out.splitlines() if text in line]


@pytest.mark.parametrize("kinds", tuple(combinations_with_replacement(KINDS, 2)), ids=" and ".join)
def test_each_of_two_monitors_of_a_plant_reports_the_other_once(
    kinds: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Two with the same plants and the same shard are one crew instead, of which one stands by."""
    (first, second), plant = start(*kinds)
    plant.declare_token(keys.key(PLANT, keys.ALIVE, "replay"))
    plant.declare_token(keys.key("other", keys.ALIVE, "plant"))
    is_crew = kinds[0] == kinds[1] != SINGLE
    assert (first.watches(), second.watches()) == (True, not is_crew)
    told = lines(capsys, NOTICED)
    assert len(told) == (0 if is_crew else 2)
    assert all(f"plant={PLANT}" in line for line in told)
    second.bus.close()
    assert len(lines(capsys, GONE)) == (0 if is_crew else 1)
    assert first.watches()


def test_a_crew_whose_members_take_over_from_each_other_reports_others_alone(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The monitor that takes the plant over reports the other crew when it does, and not the member that is gone."""
    (first, second, other), _ = start("reactor/* 1/2", "reactor/* 2/2", "reactor/c* 1/1")
    owner, rest = (first, second) if first.watches() else (second, first)
    assert owner.watches()
    assert not rest.watches()
    assert sorted(line.partition("other=")[2].partition(" plant=")[0] for line in lines(capsys, NOTICED)) == [
        "'fleet reactor/* (2 shards)'",
        "'fleet reactor/c* (1 shard)'",
    ]
    owner.bus.close()
    rest.node.adopt(PLANT, None, PRESUME_GONE_NS)  # type: ignore[union-attr] # as when its past has been found
    (line,) = lines(capsys, NOTICED)
    assert "fleet reactor/c* (1 shard)" in line
    other.bus.close()
    assert len(lines(capsys, GONE)) == 1


@pytest.mark.parametrize("kind", ["reactor/north_* 1/1", "reactor/*x 1/1", "reactor/cst 1/2"])
@pytest.mark.parametrize("beside", [SINGLE, "reactor/c* 1/1"])
def test_monitors_of_other_plants_are_not_reported(kind: str, beside: str, capsys: pytest.CaptureFixture[str]) -> None:
    start(kind, beside)
    assert lines(capsys, NOTICED) == []


@pytest.mark.parametrize("name", ["01", "01@", "01@+/x", "01@a b", "01@++", "01@\n"])
def test_a_fleet_s_token_that_names_no_plants_is_ignored(name: str) -> None:
    others = OtherMonitors("", lambda: (PLANT,))
    assert others.on_token(keys.fleet_token("0f", "1", "1", name), is_alive=True) is None
    assert list(others.check(PLANT)) == []


def test_there_is_room_for_so_many_groups_and_for_more_when_some_have_gone() -> None:
    others = OtherMonitors("", lambda: (PLANT,))
    for number in range(MOST_GROUPS):
        assert others.on_token(keys.monitor_token(f"p{number}", "a"), is_alive=True) is None
    last = keys.monitor_token(PLANT, "a")
    assert others.on_token(last, is_alive=True) is None
    others.on_token(keys.monitor_token("p7", "a"), is_alive=False)
    assert others.on_token(last, is_alive=True) is not None
    assert others.count(PLANT) == 1
