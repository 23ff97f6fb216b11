"""A fleet of plants of several processes: each plant is monitored as by a monitor of its own process."""

from collections.abc import Iterable, Iterator
from itertools import islice
from typing import TypeVar

import msgspec
import pytest

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.fleet import FleetConfig, FleetMonitor, load_kinds
from monitor_node.watched_process import load_process
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.errors import InputError
from recorder.tools.player import samples_of

from ..fleets import PLANTS, SECOND_NS, alarms, of

ROWS = 400
CONFIG = MonitorConfig(training_rows=200, isolation=False, diagnose_training=False)
FLEET = FleetConfig(plants=PLANTS, processes={"north_*": "three_tanks", "north_2": "cstr"})
PROCESSES = {"north_1": "three_tanks", "north_2": "cstr", "north_3": "three_tanks", "south": None}
FAULTS = {"north_1": "pump1:step:-4@30min", "south": "coolant_flow:step:-0.2@30min"}


@pytest.fixture(scope="module")
def runs() -> dict[str, list[Encoded]]:
    """Samples of each plant; one of them has no fault."""
    found = {}
    for seed, (plant, process) in enumerate(PROCESSES.items()):
        faults = (FAULTS[plant],) if plant in FAULTS else ()
        record = simulate_record(PlantConfig(process=process, seed=seed, faults=faults), ROWS)
        found[plant] = [encode(item) for item in samples_of(record, plant)]
    return found


@pytest.fixture(scope="module")
def expected(runs: dict[str, list[Encoded]]) -> dict[str, list[Publication]]:
    """Publications of a monitor of each plant alone."""
    found = {}
    for plant, messages in runs.items():
        config, model = load_process(msgspec.structs.replace(CONFIG, process=PROCESSES[plant]))
        monitor = Monitor(msgspec.structs.replace(config, plant=plant), 0, points=False, model=model)
        found[plant] = of(plant, [item for message in messages for item in monitor.on_message(message, 0)])
    return found


Item = TypeVar("Item")


def batched(items: Iterable[Item], count: int) -> Iterator[list[Item]]:
    """The items, so many at a time."""
    rest = iter(items)
    while batch := list(islice(rest, count)):
        yield batch


def several_kinds() -> FleetMonitor:
    return FleetMonitor(load_kinds(CONFIG, FLEET), 0)


def test_each_plant_is_watched_as_by_a_monitor_of_its_own_process(
    runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    monitor = several_kinds()
    rows = [[run[at : at + len(run) // ROWS] for at in range(0, len(run), len(run) // ROWS)] for run in runs.values()]
    found: list[Publication] = []
    for number, several in enumerate(batched(zip(*rows, strict=True), 10)):
        messages = [message for row in several for part in row for message in part]
        found += monitor.on_messages(messages, (number + 1) * SECOND_NS)
    assert set(monitor.plants) == set(runs)
    for plant in runs:
        assert of(plant, found) == expected[plant], plant
        assert bool(alarms(expected[plant])) == (plant in FAULTS)


def test_a_restored_plant_resumes_with_the_process_of_its_name(runs: dict[str, list[Encoded]]) -> None:
    first, second = several_kinds(), several_kinds()
    cut = 3 * len(runs["north_1"]) // 4
    first.on_messages(runs["north_1"][:cut], 0)
    state = first.monitor("north_1").to_bytes()
    second.register("north_1", 0, verified=True, restore=lambda monitor: monitor.from_bytes(state))
    after, again = (of("north_1", fleet.on_messages(runs["north_1"][cut:], 0)) for fleet in (first, second))
    assert alarms(after)
    assert after == again


def test_an_unknown_process_is_refused_with_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"^unknown process 'tank'; did you mean 'tanks'\?"):
        load_kinds(CONFIG, FleetConfig(plants=PLANTS, processes={"*": "tank"}))
