"""The compose file, without an engine: every service's own command does its work against a router on loopback."""

import shutil
import subprocess
import threading
from pathlib import Path
from typing import Any

import pytest
import yaml

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime.bus_zenoh import router
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.loopback import free_endpoint

from ..end_to_end.conftest import PATIENCE_S, REACTORWATCH

COMPOSE = Path(__file__).parents[2] / "docker-compose.yml"
NODES = ("recorder", "monitor", "plant")


@pytest.fixture(scope="module")
def services() -> dict[str, Any]:
    declared: dict[str, Any] = yaml.safe_load(COMPOSE.read_text(encoding="utf-8"))["services"]
    return declared


def natively(words: list[str], endpoint: str, recordings: Path) -> list[str]:
    """A service's command as it would run outside a container."""
    replaced = {"tcp/router:7447": endpoint, "/recordings": str(recordings), "/state": str(recordings)}
    return [REACTORWATCH, *(replaced.get(word, word) for word in words)]


def test_every_service_s_command_and_health_check_work(services: dict[str, Any], tmp_path: Path) -> None:
    endpoint = free_endpoint()
    bus = router(BusConfig(endpoint=endpoint))
    estimated = threading.Event()

    def on_estimate(_message: Encoded) -> None:
        estimated.set()

    bus.subscribe(keys.all_of("cstr", keys.ESTIMATE), on_estimate)
    running = []
    try:
        for node in NODES:
            words = services[node]["command"]
            if node == "plant":  # a second of its clock is a second of ours in the container; not here
                words = [*words[:-1], "600"]
            running.append(subprocess.Popen(natively(words, endpoint, tmp_path)))
            check = services[node]["healthcheck"]["test"]
            assert check[:2] == ["CMD", "reactorwatch"]
            health = natively([*check[2:], "--timeout", f"{PATIENCE_S:g}"], endpoint, tmp_path)
            assert subprocess.run(health, check=False, capture_output=True).returncode == 0, node
        assert estimated.wait(PATIENCE_S)
        for process in reversed(running):
            process.terminate()
            assert process.wait(30) == 0
        assert len(list(tmp_path.glob("cstr-*.mcap"))) == 1
        assert (tmp_path / "monitor.state").is_file()
    finally:
        for process in running:
            if process.poll() is None:
                process.kill()
                process.wait()
        bus.close()


def test_every_service_is_watched_and_comes_back(services: dict[str, Any]) -> None:
    assert set(services) == {"router", *NODES}
    for name, service in services.items():
        assert service["restart"] == "unless-stopped", name
        assert service["healthcheck"]["test"], name


@pytest.mark.parametrize("node", ["recorder", "monitor"])
def test_the_recordings_and_what_was_learned_outlive_the_containers(services: dict[str, Any], node: str) -> None:
    declared = yaml.safe_load(COMPOSE.read_text(encoding="utf-8"))
    (mount,) = services[node]["volumes"]
    volume, target = mount.split(":")
    assert volume in declared["volumes"]
    assert target in services[node]["command"]
    assert f" {target}" in (COMPOSE.parent / "Dockerfile").read_text(encoding="utf-8"), "it would belong to root"


def test_the_router_is_open_on_loopback_only(services: dict[str, Any]) -> None:
    for service in services.values():
        for port in service.get("ports", []):
            assert port.startswith("127.0.0.1:")


def test_docker_compose_accepts_the_file() -> None:
    program = shutil.which("docker-compose")
    if program is None:
        pytest.skip("docker-compose is not installed")
    subprocess.run([program, "-f", str(COMPOSE), "config", "-q"], check=True)
