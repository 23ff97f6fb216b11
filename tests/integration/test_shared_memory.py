"""A session maps no memory of other processes: Zenoh keeps 18 MB of each for good, also of those that have ended."""

import json
import subprocess
import sys
from pathlib import Path
from queue import SimpleQueue

import pytest

from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.bus_zenoh import ZenohBus, connect_now
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.http_pages import free_endpoint

MAPS = Path("/proc/self/maps")
PUBLISHERS, PAYLOAD_BYTES, WITHIN_S = 3, 100_000, 60.0
PUBLISHER = """
import sys, zenoh
config = zenoh.Config()
for path, value in (("mode", '"client"'), ("connect/endpoints", sys.argv[1]), ("scouting/multicast/enabled", "false")):
    config.insert_json5(path, value)
with zenoh.open(config) as session:
    session.put("reactor/cstr/sample/T", bytes(int(sys.argv[2])), congestion_control=zenoh.CongestionControl.BLOCK)
    sys.stdin.read()
"""

pytestmark = pytest.mark.skipif(not MAPS.exists(), reason="what a process maps is read from /proc")


def segments() -> set[str]:
    """Files of shared memory that this process maps."""
    return {line.split()[-1] for line in MAPS.read_text(encoding="utf-8").splitlines() if "/dev/shm/" in line}


def from_settings(config: BusConfig, folder: Path) -> ZenohBus:
    """A router from a file of Zenoh's settings, which leaves shared memory as it is by default."""
    path = folder / "router.json5"
    settings = {
        "mode": "router",
        "listen": {"endpoints": [config.endpoint]},
        "scouting": {"multicast": {"enabled": False}},
    }
    path.write_text(json.dumps(settings), encoding="utf-8")
    return bus_zenoh.router_from_file(path)


@pytest.mark.parametrize("is_from_file", [False, True], ids=["router", "router from a file"])
def test_large_messages_of_other_processes_leave_no_mapped_memory(is_from_file: bool, tmp_path: Path) -> None:
    config, before = BusConfig(endpoint=free_endpoint()), segments()
    router = from_settings(config, tmp_path) if is_from_file else bus_zenoh.router(config)
    bus = connect_now(config)
    came: SimpleQueue[Encoded] = SimpleQueue()
    bus.subscribe_uncached("reactor/**", came.put)
    command = [sys.executable, "-c", PUBLISHER, json.dumps([config.endpoint]), str(PAYLOAD_BYTES)]
    for _ in range(PUBLISHERS):
        with subprocess.Popen(command, stdin=subprocess.PIPE) as publisher:
            assert len(came.get(timeout=WITHIN_S).payload) == PAYLOAD_BYTES
            assert publisher.stdin is not None
            publisher.stdin.close()
    bus.close()
    router.close()
    assert segments() == before
