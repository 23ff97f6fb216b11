"""A recorder that cannot write reports it in an alarm, which operators can acknowledge."""

import contextlib
import json
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import QUALITY_GOOD, Sample
from reactorwatch.runtime.bus_zenoh import ZenohBus
from tests.running import mount_small_disk

from .conftest import PATIENCE_S, REACTORWATCH, Command, Start, WaitAlive

LARGEST_FILE = 64  # blocks: as if the disk were full then
DISK = "recording/disk"


@contextlib.contextmanager
def recording(folder: Path, endpoint: str) -> Iterator[None]:
    """A recorder that may write no more than so much to a file."""
    settings = folder / "settings.toml"
    settings.write_text(f'[recorder]\nout = "{folder}"\nresume_mb = 1e12\n')
    command = f"ulimit -f {LARGEST_FILE}; exec {REACTORWATCH} record --config {settings} --endpoint {endpoint}"
    process = subprocess.Popen(["sh", "-c", command], stderr=subprocess.PIPE)
    try:
        yield
    finally:
        process.terminate()
        _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said.decode()


def fill(bus: ZenohBus) -> None:
    """Publish until the recorder's alarm comes."""
    raised = threading.Event()
    bus.subscribe(keys.key("cstr", keys.ALARM, DISK), lambda _: raised.set())
    for number in range(10_000_000):
        sample = Sample(time_ns=number, sequence=number, value=number / 7, quality=QUALITY_GOOD)
        encoded: Encoded = encode(Publication(keys.key("cstr", keys.SAMPLE, "x"), sample))
        bus.publish(encoded)
        if number % 1000 == 0 and raised.wait(0.01):
            return


def test_a_full_disk_is_listed_with_the_other_alarms_and_can_be_acknowledged(
    tmp_path: Path, bus: ZenohBus, endpoint: str, called: Command, start: Start, wait_alive: WaitAlive
) -> None:
    start("monitor", "--endpoint", endpoint)
    with recording(tmp_path, endpoint):
        wait_alive("cstr", "monitor", "recorder")
        # the recorder answers behind what was published before
        at = ("--endpoint", endpoint, "--timeout", f"{PATIENCE_S:g}")
        early = called("alarm", "acknowledge", DISK, "--by", "Ada", *at)
        assert (early.returncode, early.stderr) == (
            2,
            f"reactorwatch: alarm {DISK} is normal, there is nothing to acknowledge\n",
        )
        fill(bus)
        listed = [json.loads(line) for line in called("alarm", "list", "--json", *at).stdout.splitlines()]
        (disk,) = [alarm for alarm in listed if alarm["alarm"] == DISK]
        assert (disk["state"], disk["priority"]) == ("unacknowledged", "critical")
        assert "shewhart/T" in {alarm["alarm"] for alarm in listed}
        done = called("alarm", "acknowledge", DISK, "--by", "Ada", "--comment", "I make room", *at)
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout.startswith(f"{DISK} (critical): acknowledged; ")
        assert done.stdout.rstrip().endswith("Ada: I make room")
        shelved = called("alarm", "shelve", DISK, "--by", "Ada", "--minutes", "5", *at)
        assert (shelved.returncode, shelved.stdout) == (2, "")
        assert "can be acknowledged and nothing else" in shelved.stderr
    gone = called("alarm", "acknowledge", DISK, "--by", "Ada", *at)
    assert (gone.returncode, gone.stderr.count("no recorder of plant 'cstr' answered")) == (2, 1)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A folder on a disk of 300 kB."""
    with mount_small_disk(tmp_path / "disk", "300k") as folder:
        yield folder


@pytest.mark.slow
def test_a_demonstration_on_a_full_disk_reports_it_in_one_line(small_disk: Path, called: Command) -> None:
    done = called("demo", "--out", small_disk / "runs", "--speed", "max")
    assert (done.returncode, done.stdout) == (2, "")
    *_, said = done.stderr.splitlines()
    assert said == (
        f"reactorwatch: {small_disk}/runs is not complete: recording stopped: No space left on device; "
        "it resumes when a file can be written; make room, and run it again"
    )
