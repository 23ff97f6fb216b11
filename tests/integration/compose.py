"""The compose files, and what their services do without an engine."""

import subprocess
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime.bus_zenoh import ZenohBus

from ..end_to_end.conftest import PATIENCE_S, REACTORWATCH

ROOT = Path(__file__).parents[2]
PLAIN = ROOT / "docker-compose.yml"
SECURE = ROOT / "deploy" / "docker-compose.secure.yml"
FLEET = ROOT / "deploy" / "docker-compose.fleet.yml"
NODES = ("recorder", "monitor", "plant")
SHARDS = 5
"""Number of monitors of a fleet, which are `monitor-1` to `monitor-5` everywhere."""
WATCHED = keys.key("cstr", keys.HEALTH, "monitor")
"""Sign that the monitor of a fleet watches the plant: it publishes no estimates."""

Services = dict[str, Any]


def services_of(file: Path) -> Services:
    """What a file says of each service."""
    declared: Services = yaml.safe_load(file.read_text(encoding="utf-8"))["services"]
    return declared


def plant_beside(*bus: str) -> dict[str, Any]:
    """A plant as a service, for a fleet that has none of its own, with its options of the bus."""
    check = ["CMD", "reactorwatch", "status", "--check", "plant", *bus]
    return {"command": ["plant", *bus, "--speed", "1"], "healthcheck": {"test": check}}


def run_nodes(
    services: Services,
    bus: ZenohBus,
    outside: Callable[[str], Mapping[str, str]],
    nodes: Sequence[str] = NODES,
    sign: str = keys.all_keys("cstr", keys.ESTIMATE),
) -> None:
    """Run nodes until the monitor has published something, each once the one before is healthy, and end them.

    Args:
        services: of the file.
        bus: that the nodes come to.
        outside: of each node, what the words of its commands that only a container knows are outside of it.
        nodes: names of the services that are run; the last one is the plant `cstr`.
        sign: key expression of the messages of which the monitor must publish one.
    """
    published = threading.Event()

    def on_message(_message: Encoded) -> None:
        published.set()

    def natively(node: str, words: list[str]) -> list[str]:
        replaced = outside(node)
        return [REACTORWATCH, *(replaced.get(word, word) for word in words)]

    bus.subscribe(sign, on_message)
    running = []
    try:
        for node in nodes:
            words = services[node]["command"]
            if node == "plant":  # a second of its clock is a second of ours in the container; not here
                words = [*words[:-1], "600"]
            running.append(subprocess.Popen(natively(node, words)))
            check = services[node]["healthcheck"]["test"]
            assert check[:2] == ["CMD", "reactorwatch"]
            health = natively(node, [*check[2:], "--timeout", f"{PATIENCE_S:g}"])
            assert subprocess.run(health, check=False, capture_output=True).returncode == 0, node
        assert published.wait(PATIENCE_S)
        for process in reversed(running):
            process.terminate()
            assert process.wait(PATIENCE_S) == 0
    finally:
        for process in running:
            if process.poll() is None:
                process.kill()
                process.wait()
