"""The pages that Prometheus scrapes, of real nodes; and their logs as objects."""

import json
import signal
import threading
from pathlib import Path
from urllib.request import urlopen

import pytest
import yaml

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, decode
from reactorwatch.contract.messages_pb2 import Health
from reactorwatch.runtime.bus_zenoh import connect
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal
from reactorwatch.runtime.http_pages import LOOPBACK, PORT_OFFSET
from tests.ports import three_free_ports

from .conftest import PATIENCE_S, Start

NODES = tuple(PORT_OFFSET)
ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_every_node_of_up_has_a_page_with_what_it_has_counted(endpoint: str, start: Start, tmp_path: Path) -> None:
    pytest.importorskip("prometheus_client", reason="prometheus-client (reactorwatch[metrics]) is not installed")
    from prometheus_client.parser import text_string_to_metric_families

    port = three_free_ports()
    settings = tmp_path / "settings.toml"
    settings.write_text(
        f'[metrics]\nport = {port}\n[log]\nformat = "json"\n[monitor]\nhealth_period_s = 0.2\n'
        "[plant]\nhealth_period_s = 0.2\nspeed = 60.0\n[recorder]\nhealth_period_s = 0.2\n"
    )
    process = start("up", "--config", settings, "--endpoint", endpoint, "--out", tmp_path / "runs")
    listener = connect(BusConfig(endpoint=endpoint), "test", StopSignal())
    assert listener is not None
    heard, all_heard = dict[str, int](), threading.Event()

    def listen(message: Encoded) -> None:
        health = decode(message.payload, message.encoding)
        assert isinstance(health, Health)
        count = health.published if health.node == "plant" else health.received
        if count > 0:
            heard.setdefault(health.node, count)
        if set(heard) == set(NODES):
            all_heard.set()

    listener.subscribe(keys.all_keys("cstr", keys.HEALTH), listen)
    assert all_heard.wait(PATIENCE_S)
    pages = {}
    for node in NODES:
        with urlopen(f"http://{LOOPBACK}:{port + PORT_OFFSET[node]}/metrics", timeout=PATIENCE_S) as answer:
            families = text_string_to_metric_families(answer.read().decode())
            pages[node] = {
                sample.name: sample.value
                for family in families
                for sample in family.samples
                if sample.labels.get("node") == node
            }
    listener.close()
    process.send_signal(signal.SIGTERM)
    said, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert pages["plant"]["reactorwatch_messages_published_total"] >= heard["plant"]
    assert pages["monitor"]["reactorwatch_messages_received_total"] >= heard["monitor"]
    assert pages["recorder"]["reactorwatch_messages_received_total"] >= heard["recorder"]
    assert pages["recorder"]["reactorwatch_disk_free_bytes"] > 0
    assert {node for node in NODES if "reactorwatch_alarms" in pages[node]} == {"monitor", "recorder"}
    events = [json.loads(line) for line in said.splitlines()]
    assert {"running", "recording", "listening", "metrics"} <= {event["event"] for event in events}


def test_the_example_names_the_pages_of_the_nodes() -> None:
    example = yaml.safe_load((ROOT / "deploy" / "prometheus.yml").read_text())
    (job,) = example["scrape_configs"]
    (static,) = job["static_configs"]
    ports = [int(target.rpartition(":")[2]) for target in static["targets"]]
    assert [port - ports[0] for port in ports] == list(PORT_OFFSET.values())
    assert f"port = {ports[0]}" in (ROOT / "docs" / "deployment.md").read_text()
