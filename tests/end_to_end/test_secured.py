"""`up` and `demo` on a site: its router with its rules, each node with the certificate of its role."""

import json
import subprocess
import threading
import tomllib
from datetime import UTC, datetime
from pathlib import Path

import pytest
import zenoh

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, decode
from reactorwatch.contract.messages_pb2 import Health, Sample
from reactorwatch.runtime.bus_zenoh import connect
from reactorwatch.runtime.config import BusConfig, read_settings, section
from reactorwatch.runtime.event_loop import StopSignal
from reactorwatch.runtime.http_pages import free_port
from reactorwatch.runtime.provisioning import make_site
from recorder.files.recording import Recording

from .conftest import PATIENCE_S, Command, Start

NODES = ("plant", "monitor", "recorder")


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A site of the plants `cstr` and `demo` on loopback."""
    folder = tmp_path / "site"
    make_site(folder, ("cstr", "demo"), f"tls/127.0.0.1:{free_port()}", None, 30.0, datetime.now(UTC))
    return folder


def bus_of(file: Path) -> BusConfig:
    return section(BusConfig, "bus", read_settings(file), {})


@pytest.mark.slow
def test_a_demonstration_runs_on_a_secured_router_and_each_node_has_its_own_certificate(
    site: Path, tmp_path: Path, command: Command
) -> None:
    done = command("demo", "--site", "site", "--out", "run", "--speed", "max", "--duration", "160", cwd=tmp_path)
    run = tmp_path / "run"
    logs = "\n".join(path.read_text() for path in run.glob("*.log"))
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}\n{logs}"
    for node in NODES:
        joined = bus_of(run / f"settings.{node}.toml")
        assert joined.endpoint.startswith("tls/")
        assert joined.certificate == str(site / "demo" / node / "certificate.pem")
    assert bus_of(run / "settings.toml").certificate == str(site / "demo" / "viewer" / "certificate.pem")
    bodies = [decode(entry.payload, entry.encoding) for entry in Recording(run / "demo.mcap").messages(plant="demo")]
    assert sum(isinstance(body, Sample) for body in bodies) == 3 * 1600
    assert {body.node for body in bodies if isinstance(body, Health)} == set(NODES)


@pytest.mark.slow
def test_up_admits_clients_with_a_certificate_and_no_others(site: Path, tmp_path: Path, start: Start) -> None:
    process = start("up", "--site", site, "--out", tmp_path / "runs", "--speed", "60")
    viewer = connect(bus_of(site / "cstr" / "viewer" / "settings.toml"), "viewer", StopSignal())
    assert viewer is not None
    heard, all_heard = set[str](), threading.Event()

    def listen(message: Encoded) -> None:
        health = decode(message.payload, message.encoding)
        assert isinstance(health, Health)
        if health.received or health.published > 1:
            heard.add(health.node)
        if heard == set(NODES):
            all_heard.set()

    viewer.subscribe(keys.all_keys("cstr", keys.HEALTH), listen)
    assert all_heard.wait(PATIENCE_S), heard
    stranger = zenoh.Config()
    endpoint = bus_of(site / "cstr" / "viewer" / "settings.toml").endpoint
    for name, value in (
        ("mode", '"client"'),
        ("connect/endpoints", f'["{endpoint}"]'),
        ("connect/timeout_ms", "0"),
        ("scouting/multicast/enabled", "false"),
        ("transport/link/tls/root_ca_certificate", f'"{site / "cstr" / "viewer" / "ca.pem"}"'),
    ):
        stranger.insert_json5(name, value)
    with pytest.raises(zenoh.ZError):
        zenoh.open(stranger)
    viewer.close()
    process.terminate()
    assert process.wait(PATIENCE_S) == 0
    (recording,) = (tmp_path / "runs").glob("*.mcap")
    kinds = {entry.key.split("/")[2] for entry in Recording(recording).messages()}
    assert {"sample", "health"} <= kinds
    (written,) = (tmp_path / "runs").glob("*.plant.toml")
    assert tomllib.loads(written.read_text())["recorder"]["key_expression"] == "reactor/cstr/**"


@pytest.mark.slow
def test_a_monitor_for_all_plants_watches_two_that_have_certificates_of_their_own(
    site: Path, tmp_path: Path, start: Start, command: Command
) -> None:
    make_site(site, ("*",), None, None, 90.0, datetime.now(UTC))
    start("router", site / "router" / "router.json5")
    for plant in ("cstr", "demo"):
        start("plant", "--config", site / plant / "plant" / "settings.toml", "--speed", "60")
    start("monitor", "--config", site / "fleet" / "monitor" / "settings.toml")
    start("record", "--config", site / "fleet" / "recorder" / "settings.toml", "--out", tmp_path / "runs")
    viewer = connect(bus_of(site / "fleet" / "viewer" / "settings.toml"), "viewer", StopSignal())
    assert viewer is not None
    watched, both = set[str](), threading.Event()

    def listen(message: Encoded) -> None:
        health = decode(message.payload, message.encoding)
        assert isinstance(health, Health)
        if health.received > 100:
            watched.add(message.key.split("/")[1])
        if watched >= {"cstr", "demo"}:
            both.set()

    viewer.subscribe("reactor/*/health/monitor", listen)
    assert both.wait(PATIENCE_S), watched
    viewer.close()
    shown = {}
    for member in ("fleet/viewer", "cstr/viewer"):
        done = command("status", "--json", "--config", site / member / "settings.toml", cwd=tmp_path)
        shown[member] = {item["plant"]: item for item in json.loads(done.stdout)["plants"]}
    assert shown["fleet/viewer"].keys() == {"cstr", "demo", "fleet"}
    assert shown["cstr/viewer"].keys() == {"cstr"}
    for plant in ("cstr", "demo"):
        alive = {node["node"]: node["alive"] for node in shown["fleet/viewer"][plant]["nodes"]}
        assert alive == {"plant": True, "monitor": True}
    doctor = command("doctor", "--config", site / "fleet" / "monitor" / "settings.toml", cwd=tmp_path)
    assert doctor.returncode == 0, doctor.stdout
    assert "ok     plants: 2 with nodes" in doctor.stdout
    for asked in ("alarm list", "view"):
        unnamed = command(*asked.split(), "--config", site / "fleet" / "viewer" / "settings.toml", cwd=tmp_path)
        assert (unnamed.returncode, unnamed.stderr.count("name one by --plant")) == (2, 1)
    alarms = command("alarm", "list", "--plant", "demo", "--config", site / "fleet" / "viewer" / "settings.toml")
    assert alarms.returncode == 0, alarms.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["up", "--site", "SITE", "--plant", "R-7"], "there is no R-7/plant/settings.toml in it; make it with: "),
        (["up", "--site", "SITE", "--endpoint", "tcp/127.0.0.1:1"], "leave it out"),
        (["demo", "--site", "nowhere"], "there is no demo/plant/settings.toml in it; make it with: "),
        (["up", "--config", "SITE/cstr/plant/settings.toml"], "name the site with --site"),
    ],
)
def test_impossible_options_are_reported_in_one_line_and_nothing_is_written(
    site: Path, tmp_path: Path, called: Command, arguments: list[str], said: str
) -> None:
    done: subprocess.CompletedProcess[str] = called(
        *(item.replace("SITE", str(site)) for item in arguments), "--out", "runs", cwd=tmp_path
    )
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert said in line
    assert not (tmp_path / "runs").exists()
