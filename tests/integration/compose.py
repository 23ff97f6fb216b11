"""The compose files, and what their services do without an engine."""

import subprocess
import threading
from collections.abc import Callable, Mapping
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
NODES = ("recorder", "monitor", "plant")

Services = dict[str, Any]


def services_of(file: Path) -> Services:
    """What a file says of each service."""
    declared: Services = yaml.safe_load(file.read_text(encoding="utf-8"))["services"]
    return declared


def run_nodes(services: Services, bus: ZenohBus, outside: Callable[[str], Mapping[str, str]]) -> None:
    """Run the nodes until the monitor has said something, each once the one before is healthy, and end them.

    Args:
        services: of the file.
        bus: that the nodes come to.
        outside: of each node, what the words of its commands that only a container knows are outside of it.
    """
    estimated = threading.Event()

    def on_estimate(_message: Encoded) -> None:
        estimated.set()

    def natively(node: str, words: list[str]) -> list[str]:
        replaced = outside(node)
        return [REACTORWATCH, *(replaced.get(word, word) for word in words)]

    bus.subscribe(keys.all_keys("cstr", keys.ESTIMATE), on_estimate)
    running = []
    try:
        for node in NODES:
            words = services[node]["command"]
            if node == "plant":  # a second of its clock is a second of ours in the container; not here
                words = [*words[:-1], "600"]
            running.append(subprocess.Popen(natively(node, words)))
            check = services[node]["healthcheck"]["test"]
            assert check[:2] == ["CMD", "reactorwatch"]
            health = natively(node, [*check[2:], "--timeout", f"{PATIENCE_S:g}"])
            assert subprocess.run(health, check=False, capture_output=True).returncode == 0, node
        assert estimated.wait(PATIENCE_S)
        for process in reversed(running):
            process.terminate()
            assert process.wait(PATIENCE_S) == 0
    finally:
        for process in running:
            if process.poll() is None:
                process.kill()
                process.wait()
