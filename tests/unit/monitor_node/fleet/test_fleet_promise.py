"""A fleet's false alarms a day are promised for all of its plants together, beside each plant's own number."""

import pytest
from structlog.testing import capture_logs

from monitor_node.config import MonitorConfig
from monitor_node.fleet import FleetConfig
from monitor_node.node import MonitorNode
from reactorwatch.errors import InputError
from reactorwatch.runtime.config import section

from ..fleets import QUICK, run_of

OWN = MonitorConfig(false_alarms_per_30_days=0.5)


@pytest.mark.parametrize("plants", [4, 100, 1000])
def test_the_shares_of_all_plants_sum_up_to_the_promise(plants: int) -> None:
    fleet = FleetConfig(plants="reactor/*", false_alarms_per_day=4.0, most_plants=plants)
    share = fleet.share_promise(MonitorConfig()).false_alarms_per_30_days
    assert share is not None
    assert plants * share / 30.0 == pytest.approx(4.0)


def test_of_a_plant_s_own_number_and_its_share_the_smaller_holds() -> None:
    few, many = (FleetConfig(plants="reactor/*", false_alarms_per_day=1.0, most_plants=count) for count in (10, 300))
    assert few.share_promise(OWN).false_alarms_per_30_days == 0.5
    assert many.share_promise(OWN).false_alarms_per_30_days == pytest.approx(0.1)


def test_without_a_promise_for_the_fleet_each_plant_has_its_own() -> None:
    fleet = FleetConfig(plants="reactor/*")
    assert (fleet.share_promise(OWN), fleet.share_promise(QUICK)) == (OWN, QUICK)


def test_a_plant_named_without_a_pattern_has_it_alone() -> None:
    assert FleetConfig(plants="reactor/north", false_alarms_per_day=1.0).share_per_30_days == 30.0


def test_a_share_that_no_plant_can_have_is_refused_in_one_line() -> None:
    with pytest.raises(InputError, match="false_alarms_per_day over most_plants must be in") as refused:
        section(FleetConfig, "fleet", {"fleet": {"plants": "reactor/*", "false_alarms_per_day": 1e-3}}, {})
    assert "\n" not in str(refused.value)


def test_each_plant_is_watched_with_its_share() -> None:
    fleet = FleetConfig(plants="reactor/*", false_alarms_per_day=2.0, most_plants=30)
    node = MonitorNode(QUICK, 0, fleet)
    for message in run_of("x", 11, span_min=25.0):
        node.on_messages([message], 0)
    promise = node.monitor("x").promise
    assert promise is not None
    assert promise.expected == pytest.approx(2.0)
    assert promise.expected * 30 / 30.0 == pytest.approx(2.0)  # thirty plants, a thirtieth of a month


def test_more_plants_than_share_it_are_logged_once_with_what_may_come() -> None:
    fleet = FleetConfig(plants="reactor/*", false_alarms_per_day=1.0, most_plants=2)
    node = MonitorNode(QUICK, 0, fleet)
    with capture_logs() as lines:
        for name in ("a", "b", "c"):
            node.register(name, 0, verified=True)
        for now_ns in (10**9, 10**12, 2 * 10**12):
            node.on_tick(now_ns)
    found = [line["event"] for line in lines if "false_alarms_per_day is divided among 2" in line["event"]]
    assert len(found) == 1
    assert "up to 1.5 false alarms a day" in found[0]
