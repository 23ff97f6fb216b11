"""The compose file with certificates, without an engine: its commands work past a router that keeps the rules."""

import re
import shutil
import subprocess
import threading
from pathlib import Path
from typing import Any

import pytest
import yaml

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime.bus_zenoh import connect
from reactorwatch.runtime.serve import StopSignal
from recorder.mcap_file import read_messages

from ..end_to_end.conftest import PATIENCE_S, REACTORWATCH
from .site import Site, settings

COMPOSE = Path(__file__).parents[2] / "deploy" / "docker-compose.secure.yml"
NODES = ("recorder", "monitor", "plant")


@pytest.fixture(scope="module")
def services() -> dict[str, Any]:
    declared: dict[str, Any] = yaml.safe_load(COMPOSE.read_text(encoding="utf-8"))["services"]
    return declared


def identity(service: dict[str, Any]) -> str:
    """The folder of the site that a service has as /identity."""
    (source,) = [mount.split(":")[0] for mount in service["volumes"] if mount.split(":")[1] == "/identity"]
    return str(source).removeprefix("./site/")


def natively(words: list[str], folder: Path, recordings: Path) -> list[str]:
    """A service's command as it would run outside a container."""
    replaced = {
        "/identity/settings.toml": str(folder / "settings.toml"),
        "/recordings": str(recordings),
        "/state": str(recordings),
    }
    return [REACTORWATCH, *(replaced.get(word, word) for word in words)]


def test_every_service_s_command_and_health_check_work(services: dict[str, Any], tmp_path: Path) -> None:
    site = Site(tmp_path / "site")
    recordings = tmp_path / "recordings"
    recordings.mkdir()
    estimated = threading.Event()
    viewer = connect(settings(site.folder, "cstr/viewer"), "viewer", StopSignal())
    assert viewer is not None

    def on_estimate(_message: Encoded) -> None:
        estimated.set()

    viewer.subscribe(keys.all_of("cstr", keys.ESTIMATE), on_estimate)
    running = []
    try:
        for node in NODES:
            folder = site.folder / identity(services[node])
            words = services[node]["command"]
            if node == "plant":  # a second of its clock is a second of ours in the container; not here
                words = [*words[:-1], "600"]
            running.append(subprocess.Popen(natively(words, folder, recordings)))
            check = services[node]["healthcheck"]["test"]
            assert check[:2] == ["CMD", "reactorwatch"]
            health = natively([*check[2:], "--timeout", f"{PATIENCE_S:g}"], folder, recordings)
            assert subprocess.run(health, check=False, capture_output=True).returncode == 0, node
        assert estimated.wait(PATIENCE_S)
        for process in reversed(running):
            process.terminate()
            assert process.wait(30) == 0
        (file,) = recordings.glob("cstr-*.mcap")
        kinds = {entry.key.split("/")[2] for entry in read_messages(file)}
        assert {keys.SAMPLE, keys.ESTIMATE, keys.HEALTH} <= kinds
    finally:
        for process in running:
            if process.poll() is None:
                process.kill()
                process.wait()
        viewer.close()
        site.close()


def test_each_service_has_its_own_identity_and_none_the_authority(services: dict[str, Any]) -> None:
    identities = {name: identity(service) for name, service in services.items()}
    assert identities == {"router": "router", **{node: f"cstr/{node}" for node in NODES}}
    for service in services.values():
        mounts = [mount for mount in service["volumes"] if mount.startswith("./site")]
        assert len(mounts) == 1
        assert mounts[0].endswith(":ro")


def test_the_router_is_open_on_loopback_only(services: dict[str, Any]) -> None:
    for service in services.values():
        for port in service.get("ports", []):
            assert port.startswith("127.0.0.1:")


def test_nothing_goes_by_plain_tcp(services: dict[str, Any]) -> None:
    for service in services.values():
        assert not re.search(r"tcp/", " ".join(service["command"]))


def test_the_router_s_settings_are_found_where_it_works(services: dict[str, Any]) -> None:
    """Zenoh reads files relative to the folder that it works in, and the settings name them without one."""
    router = services["router"]
    assert router["working_dir"] == "/identity"
    assert router["command"] == ["--config", "/identity/router.json5"]


def test_docker_compose_accepts_the_file() -> None:
    program = shutil.which("docker-compose")
    if program is None:
        pytest.skip("docker-compose is not installed")
    subprocess.run([program, "-f", str(COMPOSE), "config", "-q"], check=True)
