"""Claims on states: one monitor at a time uses a state file or a folder, and a claim that fails hides no alarm."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from monitor_node import state_files as claims
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.fleet import FleetConfig
from monitor_node.node import MonitorNode
from monitor_node.state_files import CLAIM, Claim, StateStore, is_local
from reactorwatch.contract.codec import Encoded
from reactorwatch.contract.messages_pb2 import Alarm
from reactorwatch.errors import InputError, is_passing

from ..fleets import QUICK, run_of

HOLDER = """
import sys, time
from pathlib import Path
from monitor_node.state_files import Claim
claim = Claim(Path(sys.argv[1]), "it")
print("claimed", claim.failure, flush=True)
time.sleep(600)
"""


@pytest.fixture
def shared(monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder is on a network file system."""
    monkeypatch.setattr(claims, "is_local", lambda _folder: False)


@pytest.fixture
def local(monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder is on a local file system, also where tests run on another."""
    monkeypatch.setattr(claims, "is_local", lambda _folder: True)


@pytest.mark.usefixtures("local")
def test_a_state_in_use_is_refused_in_one_line_for_a_monitor_and_for_a_fleet(tmp_path: Path) -> None:
    config = MonitorConfig(state_file=str(tmp_path / "monitor.state"))
    node, states = MonitorNode(config, 0), StateStore(tmp_path)
    for start, thing in ((lambda: MonitorNode(config, 0), "state_file"), (lambda: StateStore(tmp_path), "folder")):
        with pytest.raises(InputError, match=rf"{thing} \S+ is in use by another monitor; stop that") as refused:
            start()
        assert "\n" not in str(refused.value)
        assert not is_passing(refused.value)  # a node does not wait for it
    node.on_stop(0)
    states.close()
    MonitorNode(config, 0).on_stop(0)
    StateStore(tmp_path).close()


@pytest.mark.usefixtures("local")
def test_a_claim_ends_with_its_process_when_that_is_killed(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path / CLAIM)], stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline().split() == ["claimed"]
        if is_local(tmp_path):
            with pytest.raises(InputError):
                Claim(tmp_path / CLAIM, "it")
        holder.send_signal(signal.SIGKILL)
    assert Claim(tmp_path / CLAIM, "it").failure == ""


@pytest.mark.usefixtures("shared")
def test_on_a_network_file_system_the_last_claim_counts(tmp_path: Path) -> None:
    first = Claim(tmp_path / CLAIM, "state folder x")
    first.check()
    second = Claim(tmp_path / CLAIM, "state folder x")
    second.check()
    with pytest.raises(InputError, match="state folder x was claimed by another monitor"):
        first.check()


@pytest.mark.usefixtures("shared")
@pytest.mark.parametrize("kind", ["folder", "pipe", "no access", "full"])
def test_a_claim_that_cannot_be_written_withholds_no_alarm(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "missing" / CLAIM if kind == "no access" else tmp_path / CLAIM
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "full":
        Claim(path, "it")  # of another monitor, before

        def full(*_: object) -> int:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("os.write", full)
    claim = Claim(path, "it")
    assert "another monitor may use it" in claim.failure
    claim.check()


@pytest.mark.usefixtures("shared")
def test_a_stalled_monitor_that_was_replaced_publishes_no_alarm_and_writes_no_state(tmp_path: Path) -> None:
    run = run_of("a", 1, leak_min=30.0)
    own = Monitor(MonitorConfig(plant="a", training_min=20.0, isolation=False, diagnose_training=False), 0)
    assert any(isinstance(item.message, Alarm) for message in run for item in own.on_message(message, 0))
    node = fleet_node(tmp_path)
    node.on_messages(run[: 3 * 250], 0)
    second = StateStore(tmp_path)
    with pytest.raises(InputError, match="was claimed by another monitor"):
        node.on_messages(run[3 * 250 :], 0)
    node.on_stop(0)
    assert not (tmp_path / "a.state").exists()
    second.close()


@pytest.mark.usefixtures("shared")
def test_a_monitor_of_one_plant_that_was_replaced_publishes_no_alarm_and_writes_no_state(tmp_path: Path) -> None:
    config = MonitorConfig(
        plant="a", training_min=20.0, isolation=False, diagnose_training=False, state_file=str(tmp_path / "a.state")
    )
    node, run = MonitorNode(config, 0), run_of("a", 1, leak_min=30.0)
    for message in run[: 3 * 250]:
        node.on_message(message, 0)
    second = MonitorNode(config, 0)
    stored = (tmp_path / "a.state").read_bytes()

    def rest() -> None:
        for message in run[3 * 250 :]:
            node.on_message(message, 0)

    with pytest.raises(InputError, match="was claimed by another monitor"):
        rest()
    node.on_stop(0)
    assert (tmp_path / "a.state").read_bytes() == stored
    second.on_stop(0)


@pytest.mark.usefixtures("local")
@pytest.mark.parametrize(
    "wake",
    [
        lambda node, run: node.on_messages(run, 2_000_000_000),
        lambda node, _run: node.on_tick(2_000_000_000),
        lambda node, run: (node.on_messages(run, 999_999_999), node.on_tick(1_000_000_000)),
    ],
    ids=["by samples", "by time", "within a second"],
)
def test_a_shard_on_a_cluster_that_was_replaced_while_it_was_stalled_ends_before_it_publishes(
    tmp_path: Path, wake: Callable[[MonitorNode, list[Encoded]], object]
) -> None:
    """Also where the folder is on a local file system, whose locks a stalled process holds."""
    fleet = FleetConfig(plants="reactor/*", state=str(tmp_path), shard="1/1", scheduler="tcp://127.0.0.1:8786")
    first = MonitorNode(QUICK, 0, fleet)
    first.on_alive("reactor/a/alive/plant", True, 0)
    first.on_messages(run_of("a", 1, span_min=1.0), 0)
    second = MonitorNode(QUICK, 0, fleet)
    with pytest.raises(InputError, match="was claimed by another monitor, which uses it from now on"):
        wake(first, run_of("a", 1, span_min=2.0)[30:])
    second.on_tick(3_000_000_000)
    second.on_stop(3_000_000_000)


def test_a_mount_of_a_network_within_a_local_file_system_is_not_local(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a b" / "in").mkdir(parents=True)
    mounts = tmp_path / "mounts"
    mounts.write_text(
        "22 1 8:1 / / rw,relatime shared:1 - ext4 /dev/sda1 rw\n"
        f"23 22 0:50 / {str(tmp_path / 'a b').replace(' ', chr(92) + '040')} rw - nfs4 server:/x rw\n"
    )
    monkeypatch.setattr(claims, "MOUNTS", mounts)
    assert is_local(tmp_path)
    assert not is_local(tmp_path / "a b" / "in")
    monkeypatch.setattr(claims, "MOUNTS", tmp_path / "none")
    assert not is_local(tmp_path)


def fleet_node(folder: Path) -> MonitorNode:
    node = MonitorNode(QUICK, 0, FleetConfig(plants="reactor/*", state=str(folder)))
    node.on_alive("reactor/a/alive/plant", True, 0)
    return node


@pytest.mark.parametrize("messages", [0, 3])
def test_a_fleet_in_a_claimed_folder_publishes_its_alarms(
    tmp_path: Path, messages: int, runs: dict[str, list[Encoded]]
) -> None:
    node = fleet_node(tmp_path)
    node.on_messages(runs["a"][:messages], 0)
    published = node.on_messages(run_of("b", 22, leak_min=30.0), 0)
    assert any(isinstance(item.message, Alarm) for item in published)
    node.on_stop(0)
