"""What a fleet's monitor tells of what its plants' monitors say."""

import msgspec

from monitor_node.core import Monitor
from monitor_node.fleet_config import FleetConfig
from monitor_node.fleet_node import FleetNode
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, AlarmKpis
from reactorwatch.runtime.bus import Exchange, MemoryBus

from .fleets import PLANTS, QUICK, row_by_row, run_of


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
