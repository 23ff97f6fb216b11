"""The counts of a node are on its metrics page as they were published, in the Prometheus format."""

import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from urllib.request import urlopen

import pytest

from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, Health, Sample
from reactorwatch.errors import InputError
from reactorwatch.runtime.config import MetricsConfig, section
from reactorwatch.runtime.http_pages import LOOPBACK, PORT_OFFSET, Metrics, serve_metrics
from tests.ports import three_free_ports
from tests.running import WITHIN_S

HEALTH = Health(
    time_ns=1_700_000_000_500_000_000,
    node="monitor",
    version="1.2.3",
    phase="watching",
    uptime_s=12.5,
    received=1000,
    lost=3,
    late=4,
    refused=7,
    refused_by_reason={"payload": 5, "not_finite": 2},
    failures={"isolation": 3},
    lag_ms=1.5,
    duplicated=6,
    out_of_order=8,
    published=900,
    rows=330,
    incomplete_rows=2,
)
OF_NODE = 'node="monitor",plant="R-101"'


@pytest.fixture
def port() -> int:
    """Of the plant's page; the others are free as well."""
    pytest.importorskip("prometheus_client", reason="prometheus-client (reactorwatch[metrics]) is not installed")
    return three_free_ports()


def page(port: int, node: str = "monitor") -> dict[str, float]:
    """Value by name and labels, as read over HTTP."""
    from prometheus_client.parser import text_string_to_metric_families

    with urlopen(f"http://{LOOPBACK}:{port + PORT_OFFSET[node]}/metrics", timeout=WITHIN_S) as answer:
        text = answer.read().decode()
    found = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            labels = ",".join(f'{name}="{value}"' for name, value in sorted(sample.labels.items()))
            found[f"{sample.name}{{{labels}}}"] = sample.value
    return found


Publish = Callable[[Health | Alarm | Sample], None]


@pytest.fixture
def alarms() -> list[Alarm]:
    return [
        Alarm(alarm="ewma/T", state=AlarmState.ALARM_STATE_UNACKNOWLEDGED),
        Alarm(alarm="ewma/C", state=AlarmState.ALARM_STATE_NORMAL),
        Alarm(alarm="stuck/C", state=AlarmState.ALARM_STATE_NORMAL),
    ]


@pytest.fixture
def publish(port: int, alarms: list[Alarm]) -> Iterator[Publish]:
    """Publishes as the monitor, whose page is served."""
    page = Metrics("monitor", {"R-101": lambda: alarms}, lambda: 5_000_000)
    with serve_metrics(MetricsConfig(port=port), page) as metrics:
        assert metrics is not None
        yield lambda message: metrics.on_publish(Publication("reactor/R-101/of/node", message))


def test_the_counts_of_health_are_there_in_base_units(port: int, publish: Publish) -> None:
    publish(HEALTH)
    found = page(port)
    expected = {
        "messages_received_total": 1000,
        "messages_published_total": 900,
        "samples_lost": 3,
        "samples_late_total": 4,
        "samples_duplicated_total": 6,
        "samples_out_of_order_total": 8,
        "rows_total": 330,
        "rows_incomplete_total": 2,
        "lag_seconds": 0.0015,
        "uptime_seconds": 12.5,
        "reported_timestamp_seconds": 1_700_000_000.5,
        "disk_free_bytes": 5_000_000,
    }
    for name, value in expected.items():
        assert found[f"reactorwatch_{name}{{{OF_NODE}}}"] == pytest.approx(value, rel=1e-12), name
    assert found[f'reactorwatch_messages_refused_total{{{OF_NODE},reason="payload"}}'] == 5
    assert found[f'reactorwatch_failures_total{{{OF_NODE},stage="isolation"}}'] == 3
    assert found[f'reactorwatch_messages_refused_total{{{OF_NODE},reason="not_finite"}}'] == 2
    assert found['reactorwatch_phase{node="monitor",phase="watching",plant="R-101"}'] == 1
    assert found[f'reactorwatch_node_info{{{OF_NODE},version="1.2.3"}}'] == 1
    assert found["process_resident_memory_bytes{}"] > 1e6


def test_alarms_are_counted_by_state_also_where_there_are_none(
    port: int, publish: Publish, alarms: list[Alarm]
) -> None:
    def counted() -> dict[str, float]:
        return {
            name.split('state="')[1].rstrip('"}'): value
            for name, value in page(port).items()
            if name.startswith("reactorwatch_alarms{")
        }

    publish(HEALTH)
    none = dict.fromkeys(
        ("acknowledged", "returned_unacknowledged", "shelved", "suppressed_by_design", "out_of_service"), 0.0
    )
    assert counted() == {"normal": 2.0, "unacknowledged": 1.0, **none}
    alarms[0].state = AlarmState.ALARM_STATE_ACKNOWLEDGED
    publish(alarms[0])
    assert counted() == {"normal": 2.0, "unacknowledged": 0.0, **none, "acknowledged": 1.0}


def test_a_node_that_has_published_nothing_yet_has_a_page_without_counts(port: int, publish: Publish) -> None:
    publish(Sample(time_ns=1))
    assert not any(name.startswith(("reactorwatch_messages", "reactorwatch_alarms")) for name in page(port))


def test_the_page_of_a_fleet_has_the_counts_and_alarms_of_each_plant_that_is_watched(
    port: int, alarms: list[Alarm]
) -> None:
    found: dict[str, list[Alarm] | None] = {"a": alarms, "b": alarms[1:], "c": alarms}
    with serve_metrics(MetricsConfig(port=port), Metrics("monitor")) as metrics:
        assert metrics is not None
        for plant in found:
            metrics.add_plant(plant, lambda plant=plant: found[plant])  # type: ignore[misc]
            metrics.on_publish(Publication(f"reactor/{plant}/health/monitor", HEALTH))
        metrics.on_publish(Publication("reactor/nobody/health/monitor", HEALTH))
        metrics.remove_plant("c")
        found["a"] = None  # as they were
        metrics.on_publish(Publication("reactor/a/health/monitor", Health(received=1001)))
        shown = page(port)
    received = {name: value for name, value in shown.items() if "messages_received_total" in name}
    assert received == {
        'reactorwatch_messages_received_total{node="monitor",plant="a"}': 1001,
        'reactorwatch_messages_received_total{node="monitor",plant="b"}': 1000,
    }
    normal = {name: value for name, value in shown.items() if 'state="normal"' in name}
    assert normal == {
        'reactorwatch_alarms{node="monitor",plant="a",state="normal"}': 2,
        'reactorwatch_alarms{node="monitor",plant="b",state="normal"}': 2,
    }
    raised = shown['reactorwatch_alarms{node="monitor",plant="a",state="unacknowledged"}']
    assert (raised, shown['reactorwatch_alarms{node="monitor",plant="b",state="unacknowledged"}']) == (1, 0)


def test_the_page_of_a_fleet_has_so_many_plants_and_one_that_leaves_makes_room(
    port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("reactorwatch.runtime.http_pages.MAX_PLANTS", 2)
    with serve_metrics(MetricsConfig(port=port), Metrics("monitor")) as metrics:
        assert metrics is not None
        for plant in "abc":
            metrics.add_plant(plant, lambda: None)
        metrics.remove_plant("a")
        metrics.add_plant("d", lambda: None)
        for plant in "abcd":
            metrics.on_publish(Publication(f"reactor/{plant}/health/monitor", HEALTH))
        rows = [name for name in page(port) if name.startswith("reactorwatch_rows_total")]
    assert rows == [f'reactorwatch_rows_total{{node="monitor",plant="{plant}"}}' for plant in "bd"]


def test_a_disk_that_is_gone_leaves_its_number_out(port: int) -> None:
    def gone() -> int:
        raise FileNotFoundError

    with serve_metrics(MetricsConfig(port=port), Metrics("recorder", {"R-101": None}, gone)):
        assert not any("disk" in name for name in page(port, "recorder"))


def test_nothing_is_served_unless_asked() -> None:
    with serve_metrics(MetricsConfig(), Metrics("plant", {"R-101": None})) as metrics:
        assert metrics is None


def test_the_page_goes_with_the_node(port: int) -> None:
    for _ in range(2):  # the port is free again, too
        with serve_metrics(MetricsConfig(port=port), Metrics("plant", {"R-101": None})):
            assert page(port, "plant")
    with pytest.raises(OSError, match="refused"):
        page(port, "plant")


class Lines:
    """A log that a test waits for."""

    def __init__(self) -> None:
        self.warnings, self.served = list[str](), threading.Event()

    def warning(self, text: str) -> None:
        self.warnings.append(text)

    def info(self, _event: str, **_fields: str) -> None:
        self.served.set()


def test_a_port_in_use_stops_no_node_is_reported_in_health_and_is_served_once_it_is_free(
    port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("reactorwatch.runtime.http_pages.log", lines := Lines())
    key = "reactor/R-101/health/monitor"
    taken = socket.create_server((LOOPBACK, port + 1))
    with closing(taken), serve_metrics(MetricsConfig(port=port), Metrics("monitor", {"R-101": None})) as metrics:
        assert metrics is not None
        metrics.on_publish(Publication(key, without := Health()))
        said = f"[metrics] port {port}: the monitor cannot listen at 127.0.0.1:{port + 1}: Address already in use"
        assert without.waiting_for == said
        taken.close()
        assert lines.served.wait(WITHIN_S)
        metrics.on_publish(Publication(key, served := Health(received=7)))
        assert not served.waiting_for
        assert page(port)['reactorwatch_messages_received_total{node="monitor",plant="R-101"}'] == 7
    assert lines.warnings == [said]


def test_a_node_ends_at_once_while_its_port_is_taken(port: int) -> None:
    with socket.create_server((LOOPBACK, port)):
        with serve_metrics(MetricsConfig(port=port), Metrics("plant")) as metrics:
            assert metrics is not None
        assert "metrics" not in {thread.name for thread in threading.enumerate()}


def test_without_the_library_the_cure_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    metrics = serve_metrics(MetricsConfig(port=9464), Metrics("monitor", {"R-101": None}))
    with pytest.raises(InputError, match=r"pip install 'reactorwatch\[metrics\]'"), metrics:
        pass


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"port": 0}, "port must be in [1, 65533], got 0"),
        ({"port": 65534}, "port must be in [1, 65533], got 65534"),
        ({"address": "here"}, "address must be an IP address of this machine, such as 127.0.0.1, got 'here'"),
        ({"ports": 1}, "unknown key 'ports'; did you mean 'port'?"),
    ],
)
def test_impossible_settings_are_reported(values: dict[str, object], said: str) -> None:
    with pytest.raises(InputError) as told:
        section(MetricsConfig, "metrics", {"metrics": values}, {})
    assert said in str(told.value)


def test_pages_are_on_loopback_unless_asked() -> None:
    assert MetricsConfig(port=9464).address == LOOPBACK
