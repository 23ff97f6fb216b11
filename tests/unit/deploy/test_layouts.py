"""Dashboards for other viewers show what there is: metrics of the nodes' pages, keys and fields of the bus."""

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import yaml

from reactorwatch.contract import keys, messages_pb2
from reactorwatch.contract.codec import Publication
from reactorwatch.runtime.http_pages import Metrics

DEPLOY = Path(__file__).parents[3] / "deploy"
MESSAGES = {
    keys.SAMPLE: messages_pb2.Sample,
    keys.ESTIMATE: messages_pb2.Estimate,
    keys.CHART: messages_pb2.ChartPoint,
    keys.ALARM: messages_pb2.Alarm,
    keys.ALARM_KPIS: messages_pb2.AlarmKpis,
}


def check(topic: str, field: str | None) -> None:
    """The topic is a key of the bus, and its message has the field."""
    parsed = keys.parse(topic)
    assert parsed is not None, topic
    fields = MESSAGES[parsed.kind].DESCRIPTOR.fields_by_name  # type: ignore[attr-defined]
    assert field is None or field in fields, f"{topic}: {field}"


def test_the_foxglove_layout_shows_keys_and_fields_that_exist_and_every_panel() -> None:
    layout = json.loads((DEPLOY / "layouts" / "foxglove.json").read_text(encoding="utf-8"))
    text = json.dumps(layout["layout"])
    assert all(f'"{name}"' in text for name in layout["configById"])
    paths = [path for panel in layout["configById"].values() for path in panel.get("paths", ())]
    assert len(paths) > 10
    for path in paths:
        assert path["timestampMethod"] == "publishTime"
        topic, field = re.fullmatch(r'"([^"]+)"\.(\w+)', path["value"]).groups()  # type: ignore[union-attr]
        check(topic, field)


def test_the_plotjuggler_layout_shows_keys_and_fields_that_exist() -> None:
    root = ET.parse(DEPLOY / "layouts" / "plotjuggler.xml").getroot()
    curves = [curve.attrib["name"] for curve in root.iter("curve")]
    assert len(curves) > 10
    for name in curves:
        topic, _, field = name.rpartition("/")
        check(topic, field)
    (splitter,) = root.iter("DockSplitter")
    assert int(splitter.attrib["count"]) == len(splitter) == len(splitter.attrib["sizes"].split(";"))


def test_the_grafana_dashboard_asks_for_metrics_that_the_pages_have() -> None:
    pytest.importorskip("prometheus_client", reason="prometheus-client (reactorwatch[metrics]) is not installed")
    dashboard = json.loads((DEPLOY / "grafana" / "reactorwatch.json").read_text(encoding="utf-8"))
    asked = set(re.findall(r"reactorwatch_(\w+)", json.dumps([panel["targets"] for panel in dashboard["panels"]])))
    assert len(asked) > 7
    page = Metrics("recorder", {"cstr": list}, lambda: 0)
    page.on_publish(Publication("reactor/cstr/health/recorder", messages_pb2.Health()))
    shown = {family.name.removeprefix("reactorwatch_"): family.type for family in page.collect()}
    for name in asked:
        base = name.removesuffix("_total")
        assert base in shown, name
        assert (base != name) == (shown[base] == "counter")
    assert len({panel["id"] for panel in dashboard["panels"]}) == len(dashboard["panels"])


def test_the_dashboard_is_provisioned_from_its_folder() -> None:
    (provider,) = yaml.safe_load((DEPLOY / "grafana" / "dashboards.yml").read_text(encoding="utf-8"))["providers"]
    assert provider["type"] == "file"


@pytest.mark.parametrize("name", ["foxglove.json", "plotjuggler.xml"])
def test_a_layout_names_the_default_plant_alone(name: str) -> None:
    text = (DEPLOY / "layouts" / name).read_text(encoding="utf-8")
    assert set(re.findall(r"reactor/([\w-]+)/", text)) == {"cstr"}
