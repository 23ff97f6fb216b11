"""Real processes on a real router, all on loopback, all ended with the test."""

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from reactorwatch.runtime.bus_zenoh import ZenohBus, router
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.http_pages import free_endpoint
from tests.running import Command as Command

REACTORWATCH = str(Path(sys.executable).with_name("reactorwatch"))
PATIENCE_S = 60.0
COMMAND_WITHIN_S = 300.0
"""A diagnosis is half a minute of computing, and a busy machine takes several times that."""

Start = Callable[..., subprocess.Popen[str]]
WaitAlive = Callable[..., None]


@pytest.fixture
def command() -> Command:
    """Run `reactorwatch` with arguments to its end."""

    def run(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [REACTORWATCH, *map(str, arguments)],
            capture_output=True,
            text=True,
            timeout=COMMAND_WITHIN_S,
            check=False,
            cwd=cwd,
        )

    return run


@pytest.fixture
def endpoint() -> str:
    """An address for the router of this test."""
    return free_endpoint()


@pytest.fixture
def bus(endpoint: str) -> Iterator[ZenohBus]:
    """The router of this test, and a way onto its bus."""
    opened = router(BusConfig(endpoint=endpoint))
    yield opened
    opened.close()


@pytest.fixture
def start() -> Iterator[Start]:
    """Start `reactorwatch` with arguments in the background; it is ended with the test."""
    running: list[subprocess.Popen[str]] = []

    def begin(*arguments: str | Path) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [REACTORWATCH, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        running.append(process)
        return process

    yield begin
    for process in running:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture
def wait_alive(bus: ZenohBus) -> WaitAlive:
    """Wait until nodes of a plant show that they are alive."""

    def wait(plant: str, *nodes: str) -> None:
        missing, all_there = {f"reactor/{plant}/alive/{node}" for node in nodes}, threading.Event()

        def on_token(key: str, alive: bool) -> None:
            if alive:
                missing.discard(key)
            if not missing:
                all_there.set()

        bus.subscribe_liveliness(f"reactor/{plant}/alive/*", on_token)
        assert all_there.wait(PATIENCE_S), f"not alive within {PATIENCE_S:g} s: {sorted(missing)}"

    return wait
