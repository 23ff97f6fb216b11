"""The state of a monitor persists in a file, and a damaged file costs no more than what was learned.

The folder of a fleet's states: each is there whole, or as it was before.
"""

import errno
import os
from pathlib import Path

import msgspec
import pytest

from monitor_node.config import MonitorConfig
from monitor_node.node import MonitorNode
from monitor_node.state_files import CLAIM, StateStore
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, encode, encode_message
from reactorwatch.contract.messages_pb2 import Baseline, BaselineCommand, Health, ListAlarms
from reactorwatch.errors import InputError

from ..samples import leaking_run, samples
from .restarts import own, start_node

SECOND = 1_000_000_000
END_MIN = 70.0


@pytest.fixture(scope="module")
def leak() -> list[Encoded]:
    """A run whose coolant leaks from minute 65 on."""
    return list(samples(*leaking_run(-0.1, 65.0, END_MIN, seed=1)))


@pytest.fixture
def config(tmp_path: Path) -> MonitorConfig:
    path = str(tmp_path / "monitor.state")
    return MonitorConfig(training_min=60.0, diagnose_training=False, state_file=path, state_every_s=2.0)


def health(node: MonitorNode, now_ns: int) -> Health:
    (message,) = [item.message for item in node.on_tick(now_ns) if isinstance(item.message, Health)]
    return message


def stored_rows(config: MonitorConfig) -> int:
    """Rows of the run that the file knows."""
    copy = Path(str(config.state_file)).with_name("copy.state")
    copy.write_bytes(Path(str(config.state_file)).read_bytes())
    return own(start_node(msgspec.structs.replace(config, state_file=str(copy)), 0)).rows


def test_it_is_stored_when_it_is_due_and_something_was_received(config: MonitorConfig, leak: list[Encoded]) -> None:
    node = start_node(config, 0)
    path = Path(str(config.state_file))
    for number, message in enumerate(leak[:60]):
        node.on_message(message, number * SECOND // 10)
        node.on_tick(number * SECOND // 10)
        assert node.next_tick_ns() <= 2 * SECOND + (number * SECOND // 10)
    assert 13 <= stored_rows(config) <= 20
    node.on_tick(60 * SECOND)
    assert stored_rows(config) == 20
    before = path.stat().st_mtime_ns
    node.on_tick(70 * SECOND)
    assert path.stat().st_mtime_ns == before


def test_a_command_that_only_asks_stores_nothing_and_one_that_changes_something_is_stored_at_once(
    config: MonitorConfig, leak: list[Encoded]
) -> None:
    node, path = start_node(config, 0), Path(str(config.state_file))
    for message in leak[:60]:
        node.on_message(message, 0)
    node.on_tick(60 * SECOND)
    stored = []
    for name, command in (
        ("list_alarms", ListAlarms()),
        ("baseline", BaselineCommand(what="list")),
        ("baseline", BaselineCommand(what="relearn", by="ada", why="cleaned")),
    ):
        before = path.stat().st_ino
        reply, _ = node.on_command(Encoded(f"reactor/cstr/command/{name}", *encode_message(command)), 61 * SECOND)
        assert reply is not None
        assert reply.accepted, reply.text
        stored.append(path.stat().st_ino != before)
    assert stored == [False, False, True]


def test_a_change_of_an_alarm_is_stored_before_it_is_published(config: MonitorConfig, leak: list[Encoded]) -> None:
    node = start_node(config, 0)
    for message in leak:
        said = node.on_message(message, 0)
        if any("/alarm/" in item.key for item in said):
            break
    assert stored_rows(config) == own(node).rows


def test_messages_that_a_kill_kept_from_leaving_are_published_first_after_the_restart(
    config: MonitorConfig, leak: list[Encoded]
) -> None:
    node = start_node(config, 0)
    messages = iter(leak)
    for message in messages:
        said = node.on_message(message, 0)
        if any("/alarm/" in item.key for item in said):
            break
    resumed = start_node(config, 0)
    again = resumed.on_message(next(messages), 0)
    assert [encode(item) for item in again[: len(said)]] == [encode(item) for item in said]
    assert not any("/alarm/" in item.key for item in resumed.on_tick(0))


def test_a_monitor_that_ended_publishes_nothing_again(config: MonitorConfig, leak: list[Encoded]) -> None:
    node = start_node(config, 0)
    for message in leak[:30]:
        node.on_message(message, 0)
    node.on_stop(0)
    assert {type(item.message) for item in start_node(config, 0).on_tick(0)} == {Health}


def test_at_its_end_it_is_stored(config: MonitorConfig, leak: list[Encoded]) -> None:
    node = start_node(config, 0)
    for message in leak[:30]:
        node.on_message(message, 0)
    node.on_stop(0)
    assert own(start_node(config, 0)).rows == 10


@pytest.mark.parametrize("data", [b"", b"reactorw", b"reactorwatch monitor\x00\x01 and then no state"])
def test_a_damaged_file_is_kept_aside_and_reported_in_one_line(
    data: bytes, config: MonitorConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    path = Path(str(config.state_file))
    path.write_bytes(data)
    node = start_node(config, 0)
    assert (own(node).phase, node.resumed) == ("waiting", False)
    assert path.with_name("monitor.state.damaged").read_bytes() == data
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "monitor.state" in line]
    assert "it is kept as monitor.state.damaged, and the monitor learns again" in line
    assert own(start_node(config, 0)).phase == "waiting"


def test_what_was_learned_with_other_settings_is_kept_aside_and_the_setting_named(
    config: MonitorConfig, leak: list[Encoded], capsys: pytest.CaptureFixture[str]
) -> None:
    node = start_node(config, 0)
    for message in leak[:30]:
        node.on_message(message, 0)
    node.on_stop(0)
    other = start_node(msgspec.structs.replace(config, order=2), 0)
    assert own(other).rows == 0
    assert "was learned with other settings: order was not stated and is 2; it is kept as" in capsys.readouterr().out
    path = Path(str(config.state_file))
    path.with_name("monitor.state.other-settings").replace(path)
    assert own(start_node(config, 0)).rows == 10


def test_a_file_in_no_folder_is_refused_at_the_start(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        start_node(MonitorConfig(state_file=str(tmp_path / "none" / "monitor.state")), 0)


def test_a_full_disk_is_reported_once_counted_and_stops_no_monitor(
    config: MonitorConfig, leak: list[Encoded], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither at the start nor later; what was stored before is still there, and it is tried again."""
    full = True

    def fsync(_: int) -> None:
        if full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fsync)
    node = start_node(config, 0)
    for number, message in enumerate(leak[:300]):
        node.on_message(message, number * SECOND)
        node.on_tick(number * SECOND)
    count = health(node, 300 * SECOND).not_stored
    assert count > 50
    assert own(node).rows == 100
    said = [line for line in capsys.readouterr().out.splitlines() if "No space left" in line]
    assert len(said) == 2  # at the start, and then
    path = Path(str(config.state_file))
    assert [item.name for item in path.parent.iterdir()] == [f".{path.name}{CLAIM}"]
    full = False
    node.on_message(leak[300], 310 * SECOND)
    node.on_tick(320 * SECOND)
    assert stored_rows(config) == 100
    assert health(node, 330 * SECOND).not_stored == count


def test_an_accepted_command_on_the_baseline_is_stored_before_the_reply(
    config: MonitorConfig, leak: list[Encoded]
) -> None:
    node = start_node(config, 0)
    for message in leak[:30]:
        node.on_message(message, 0)
    key = keys.key(config.plant, keys.COMMAND, "baseline")
    command = BaselineCommand(what="relearn", by="Anna", why="new pump")
    reply, _ = node.on_command(Encoded(key, *encode_message(command)), 0)
    assert reply is not None
    assert reply.accepted
    resumed = start_node(config, 0)
    published = [item.message for message in leak[30:33] for item in resumed.on_message(message, 0)]
    assert [item.what for item in published if isinstance(item, Baseline)] == ["relearn"]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name != CLAIM)


def test_the_newest_state_of_each_plant_is_there_when_the_folder_is_closed(tmp_path: Path) -> None:
    states = StateStore(tmp_path)
    for number in range(100):
        states.put("a", b"%d" % number)
        states.put("b", b"of b")
    states.close()
    assert names(tmp_path) == ["a.state", "b.state"]
    assert [(tmp_path / f"{plant}.state").read_bytes() for plant in "ab"] == [b"99", b"of b"]
    again = StateStore(tmp_path)
    assert again.plants == ["a", "b"]
    again.close()


def test_a_failed_write_is_reported_and_leaves_the_state_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = StateStore(tmp_path)
    before.put("a", b"before")
    before.close()

    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    states = StateStore(tmp_path)
    states.put("a", b"now")
    states.close()
    ((plant, why),) = states.pop_failures()
    assert plant == "a"
    assert "No space left on device" in why
    assert (tmp_path / "a.state").read_bytes() == b"before"


def test_a_state_that_was_removed_by_a_person_is_written_again(tmp_path: Path) -> None:
    (tmp_path / "a.state").write_bytes(b"before")
    states = StateStore(tmp_path)
    (tmp_path / "a.state").unlink()
    states.put("a", b"now")
    states.close()
    assert (tmp_path / "a.state").read_bytes() == b"now"


def test_temporary_files_of_a_killed_writer_are_removed_at_the_next_start(tmp_path: Path) -> None:
    left, fresh = tmp_path / ".a.state.123.tmp", tmp_path / ".b.state.124.tmp"
    for path in (left, fresh):
        path.write_bytes(b"half")
    os.utime(left, (0.0, 0.0))
    StateStore(tmp_path).close()
    assert names(tmp_path) == [fresh.name]


@pytest.mark.parametrize("name", ["missing", "file"])
def test_a_folder_that_is_none_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=f"state folder .*{name}"):
        StateStore(tmp_path / name)
