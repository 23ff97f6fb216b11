"""A fleet's monitor with a folder of states, commands, metrics and logs."""

from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from monitor_node.core import Monitor
from monitor_node.fleet import EVICT_NS, FleetConfig
from monitor_node.node import POLL_NS, MonitorNode
from monitor_node.state_files import CLAIM
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Alarm, AlarmKpis
from reactorwatch.runtime.http_pages import Metrics

from ..fleets import PLANTS, QUICK, alarms, of, row_by_row, run_of


class Bench:
    """A monitor of a fleet, and its clock."""

    def __init__(self, folder: Path) -> None:
        self.now_ns = 0
        config = msgspec.structs.replace(QUICK, state_every_s=0.1)
        self.node = MonitorNode(config, 0, FleetConfig(plants=PLANTS, state=str(folder)))

    def tick(self) -> list[Publication]:
        """Publications a moment later."""
        self.now_ns += POLL_NS
        return self.node.on_tick(self.now_ns)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    bench.node.on_alive("reactor/a/alive/plant", True, bench.now_ns)
    yield bench
    bench.node.on_stop(bench.now_ns)


def test_a_fleet_that_was_stopped_resumes_each_plant_value_for_value(
    tmp_path: Path, runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    """Samples that publishers send again are used once."""
    messages, at = row_by_row(runs.values()), 3 * len(runs) * 310
    first = Bench(tmp_path)
    published = first.node.on_messages(messages[:at], 0)
    first.node.on_stop(0)
    second = Bench(tmp_path)
    assert sorted(second.node.plants) == sorted(runs)
    again = second.node.on_messages(messages[at - 90 :], 0)
    second.node.on_history_end()
    for plant in runs:
        said, rest = of(plant, published), of(plant, again)
        whole = [item for item in expected[plant] if isinstance(item.message, Alarm)]
        assert [item for item in said + rest if isinstance(item.message, Alarm)] == whole
        assert second.node.monitor(plant).rows == 401
    assert alarms(expected["b"])
    second.node.on_stop(0)


def test_the_state_of_a_plant_is_stored_as_soon_as_its_alarm_is_published(bench: Bench, tmp_path: Path) -> None:
    bench.node.on_messages(run_of("a", 1, span_min=1.0), bench.now_ns)
    run = run_of("b", 22, leak_min=30.0)
    row = 0
    while not any(isinstance(item.message, Alarm) for item in bench.node.on_messages(run[row : row + 3], 0)):
        row += 3
    bench.node.on_tick(bench.now_ns)
    bench.node.on_stop(bench.now_ns)
    after = Bench(tmp_path)
    stored = [alarm for alarm in after.node.monitor("b").alarms.all_alarms() if alarm.raised_ns]
    assert stored
    after.node.on_stop(0)


def test_the_counts_and_alarms_of_each_plant_are_on_the_page_as_long_as_it_is_watched(bench: Bench) -> None:
    pytest.importorskip("prometheus_client", reason="prometheus-client (reactorwatch[metrics]) is not installed")
    metrics = bench.node.metrics = Metrics("monitor")
    plant = "made-up"
    run = run_of(plant, 1, span_min=1.0)  # too few rows to verify it
    bench.node.on_messages(run, bench.now_ns)
    bench.now_ns += int(QUICK.health_period_s * 1e9)
    for publication in bench.node.on_tick(bench.now_ns):
        metrics.on_publish(publication)
    shown = {metric.name: metric.samples for metric in metrics.collect()}
    (rows,) = shown["reactorwatch_rows"]
    assert (rows.labels, rows.value) == ({"plant": plant, "node": "monitor"}, len(run) // 3)
    normal = [sample.value for sample in shown["reactorwatch_alarms"] if sample.labels["state"] == "normal"]
    assert normal == [len(bench.node.monitor(plant).alarms.all_alarms())]
    bench.node.on_messages(run_of("a", 1, span_min=1.0), bench.now_ns)  # its token is shown
    bench.node.on_tick(bench.now_ns + EVICT_NS)
    assert "reactorwatch_rows" not in {metric.name for metric in metrics.collect() if metric.samples}


def test_there_is_no_file_of_a_plant_of_which_nothing_is_known(bench: Bench, tmp_path: Path) -> None:
    bench.node.on_messages(run_of("made-up", 1, span_min=1.0), bench.now_ns)
    for _ in range(10):
        bench.tick()
    bench.node.on_messages(run_of("a", 1, span_min=1.0), bench.now_ns)
    bench.node.on_stop(bench.now_ns)
    assert sorted(path.name for path in tmp_path.iterdir()) == [CLAIM, "a.state"]


def test_alarm_kpis_are_published_from_the_first_alarm_of_a_plant_on() -> None:
    node = MonitorNode(QUICK, 0, FleetConfig(plants=PLANTS))
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
