"""No stored file is lost to another start: what cannot be used is kept, and used again when it fits."""

import json
import os
import re
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from monitor_node.config import MonitorConfig
from monitor_node.fleet import FleetConfig
from monitor_node.node import MonitorNode
from monitor_node.state_files import CLAIM, StateStore, find_kept_aside, keep_aside
from reactorwatch.contract.codec import Encoded
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState
from reactorwatch.errors import InputError

from ..fleets import of_plant
from ..samples import leaking_run, samples
from .restarts import own, start_node

FOREIGN = {
    "settings.toml": b'[monitor]\nplant = "cstr"\n',
    "record.csv": b"time_min,qc,C,T\n0,103.41,0.1,438.54\n",
    "notes.json": json.dumps({"version": 1, "plant": "cstr"}).encode(),
    "picture.png": b"\x89PNG\r\n\x1a\n",
    "run.mcap": b"\x89MCAP0\r\n",
    "map.msgpack": msgspec.msgpack.encode({"version": 1, "plant": "cstr"}),
    "word.txt": b"reactorwatch is on the third shelf",
}
"""Files of a user's, named by mistake."""


@pytest.fixture(scope="module")
def rows() -> list[Encoded]:
    """Three messages a row."""
    return list(samples(*leaking_run(-0.1, 5.0, 8.0, seed=1)))


def config(folder: Path, **others: object) -> MonitorConfig:
    return MonitorConfig(**({"state_file": str(folder / "monitor.state")} | others))  # type: ignore[arg-type]


def files(folder: Path) -> dict[str, bytes]:
    """Files of a folder by name, without claims."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if not path.name.endswith(CLAIM)}


SETTINGS: list[dict[str, object]] = [{}, {"order": 2}, {"charts": ("ewma",)}, {"isolation": False}]


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.sampled_from(range(len(SETTINGS))), min_size=2, max_size=6))
def test_settings_changed_and_changed_back_cost_no_row(
    tmp_path_factory: pytest.TempPathFactory, rows: list[Encoded], starts: list[int]
) -> None:
    """Each start goes on with all rows that were learned with its settings, in any order of starts."""
    folder = tmp_path_factory.mktemp("changed")
    learned = dict.fromkeys(range(len(SETTINGS)), 0)
    for number in starts:
        node = start_node(config(folder, **SETTINGS[number]), 0)
        assert own(node).rows == learned[number]
        first = 3 * learned[number]
        for message in rows[first : first + 15]:
            node.on_message(message, 0)
        node.on_stop(0)
        learned[number] = own(node).rows
    assert len(files(folder)) == len(set(starts))


def test_each_damaged_file_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, damaged = tmp_path / "monitor.state", list[bytes]()
    for number in range(4):
        start_node(config(tmp_path), 0)
        data = bytearray(path.read_bytes())
        data[-1 - number] ^= 1
        path.write_bytes(data)
        damaged.append(bytes(data))
    start_node(config(tmp_path), 0)
    kept = {name: data for name, data in files(tmp_path).items() if name != path.name}
    assert [kept[f"monitor.state.damaged{ending}"] for ending in ("", ".2", ".3", ".4")] == damaged
    assert "it is kept as monitor.state.damaged.4, and" in capsys.readouterr().out


def test_every_flipped_bit_of_a_head_is_damage_and_no_foreign_file(tmp_path: Path) -> None:
    start_node(config(tmp_path), 0)
    path = tmp_path / "monitor.state"
    stored = path.read_bytes()
    for bit in range(0, 8 * 24, 5):
        data = bytearray(stored)
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        assert not start_node(config(tmp_path), 0).resumed
    kept = find_kept_aside(tmp_path)["monitor.state"]
    assert len({aside.read_bytes() for aside in kept}) == len(range(0, 8 * 24, 5))


@pytest.mark.parametrize("name", FOREIGN)
def test_a_file_that_is_no_state_is_refused_and_left_alone(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(FOREIGN[name])
    before = files(tmp_path)
    with pytest.raises(InputError, match=rf"^state_file .*{name}: is no ") as refused:
        start_node(MonitorConfig(state_file=str(tmp_path / name)), 0)
    assert "\n" not in str(refused.value)
    assert files(tmp_path) == before


DAMAGED: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda stored: b"",
    "zeros": lambda stored: bytes(len(stored)),
    "one zero": lambda stored: b"\0",
    "part of its first word": lambda stored: stored[:7],
    "its head alone": lambda stored: stored[:21],
    "cut": lambda stored: stored[: len(stored) // 2],
    "a byte too many": lambda stored: stored + b"\0",
    "a wrong bit": lambda stored: flip_bit(stored, 8 * len(stored) - 3),
    "of a later version": lambda stored: re.sub(rb"(?<=[rs])\0.", b"\0\xfe", stored, count=1),
    "zeros at its end": lambda stored: stored[:30] + bytes(len(stored) - 30),
}
"""Remains of power failures, of failing disks and of other versions, from the bytes that were stored."""


@pytest.mark.parametrize("kind", DAMAGED)
def test_a_damaged_state_is_kept_aside_in_a_line(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A restart never ends at it."""
    path = tmp_path / "a.state"
    settings_ = MonitorConfig(state_file=str(path))
    start_node(settings_, 0)
    data = DAMAGED[kind](path.read_bytes())
    path.write_bytes(data)
    capsys.readouterr()
    assert not start_node(settings_, 0).resumed
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "state_file" in line]
    assert "it is kept as a.state.damaged, and" in line
    assert (tmp_path / "a.state.damaged").read_bytes() == data
    start_node(settings_, 0)
    assert len(files(tmp_path)) == 2


def test_what_is_no_regular_file_is_refused(tmp_path: Path) -> None:
    """A pipe would be waited for, a device replaced."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match=r"^state_file .*pipe: is not a regular file; name one"):
        start_node(MonitorConfig(state_file=str(tmp_path / "pipe")), 0)
    assert (tmp_path / "pipe").is_fifo()


def test_a_typo_in_the_plant_s_name_changes_no_file(tmp_path: Path, rows: list[Encoded]) -> None:
    """The state is another plant's, so nothing is started."""
    node = start_node(config(tmp_path), 0)
    for message in rows:
        node.on_message(message, 0)
    node.on_stop(0)
    before = files(tmp_path)
    with pytest.raises(InputError, match="is the state of plant 'cstr', not of 'cst'; it is left as it is"):
        start_node(config(tmp_path, plant="cst"), 0)
    assert files(tmp_path) == before


def test_a_name_that_is_taken_meanwhile_is_not_overwritten(tmp_path: Path) -> None:
    for number in range(3):
        (tmp_path / "a.state").write_bytes(b"%d" % number)
        keep_aside(tmp_path / "a.state", ".damaged")
    assert files(tmp_path) == {"a.state.damaged": b"0", "a.state.damaged.2": b"1", "a.state.damaged.3": b"2"}


# --- alarms ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def leak() -> list[Encoded]:
    """A run whose coolant leaks from minute 65 on, so that alarms stand at its end."""
    return list(samples(*leaking_run(-0.1, 65.0, 70.0, seed=1)))


def stands(alarm: Alarm) -> bool:
    return alarm.state in (AlarmState.ALARM_STATE_UNACKNOWLEDGED, AlarmState.ALARM_STATE_ACKNOWLEDGED)


def stored_alarms(node: MonitorNode) -> list[Alarm]:
    """Its alarms, without the time of the newest row."""
    alarms = own(node).alarms.all_alarms()
    for alarm in alarms:
        alarm.time_ns = 0
    return alarms


WITH_ALARMS = MonitorConfig(training_min=60.0, diagnose_training=False)


@pytest.fixture(scope="module")
def in_alarm(leak: list[Encoded]) -> MonitorNode:
    """A monitor with alarms that stand."""
    node = start_node(WITH_ALARMS, 0)
    for message in leak:
        node.on_message(message, 0)
    assert any(stands(alarm) for alarm in own(node).alarms.all_alarms())
    return node


def flip_bit(stored: bytes, bit: int) -> bytes:
    data = bytearray(stored)
    data[bit // 8] ^= 1 << bit % 8
    return bytes(data)


@pytest.fixture
def stored(tmp_path: Path, in_alarm: MonitorNode) -> Path:
    """Folder with the state of a monitor with alarms that stand."""
    (tmp_path / "monitor.state").write_bytes(own(in_alarm).to_bytes())
    return tmp_path


def with_alarms(folder: Path, **others: object) -> MonitorNode:
    return start_node(config(folder, training_min=60.0, diagnose_training=False, **others), 0)


def test_other_settings_start_a_training_and_cost_no_alarm(stored: Path, in_alarm: MonitorNode) -> None:
    other = with_alarms(stored, order=2)
    assert not other.resumed
    assert stored_alarms(other) == stored_alarms(in_alarm)


def test_alarms_that_a_setting_leaves_out_come_back_with_it(stored: Path, in_alarm: MonitorNode) -> None:
    few = with_alarms(stored, charts=("shewhart",))
    assert len(stored_alarms(few)) < len(stored_alarms(in_alarm))
    assert stored_alarms(with_alarms(stored, order=2)) == stored_alarms(in_alarm)


def test_alarms_are_not_older_than_those_of_other_settings_after_a_state_was_aside(
    tmp_path: Path, leak: list[Encoded]
) -> None:
    """A comment made while other settings were in force is kept."""
    both = config(tmp_path, training_min=60.0)
    node = start_node(both, 0)
    for message in leak:
        node.on_message(message, 0)
    node.on_stop(0)
    standing = next(alarm.alarm for alarm in own(node).alarms.all_alarms() if stands(alarm))
    other = start_node(msgspec.structs.replace(both, order=2), 0)
    own(other).alarms.act(standing, "comment", "Anna", "the valve is being repaired")
    other.on_stop(0)
    again = start_node(both, 0)
    assert own(again).rows == own(node).rows
    assert own(again).alarms.alarm(standing).comment == "the valve is being repaired"


def test_a_silence_that_stood_ends_with_the_next_sample(tmp_path: Path, rows: list[Encoded]) -> None:
    """Also when the monitor learns from scratch with other settings, and knows the silence from the alarms alone."""
    settings_ = config(tmp_path)
    node = start_node(settings_, 0)
    for message in rows[:150]:
        node.on_message(message, 0)
    own(node).silence.declare_timeout(0)
    node.on_stop(0)
    again = start_node(config(tmp_path, order=2), 0)
    assert stands(own(again).alarms.alarm("silence/plant"))
    for message in rows[150:]:
        again.on_message(message, 0)
    assert not stands(own(again).alarms.alarm("silence/plant"))


# --- fleets ------------------------------------------------------------------------------------------------------


def fleet_of(folder: Path, order: int, rows: list[Encoded]) -> MonitorNode:
    """A fleet's monitor that watches the plants of its folder, and is stopped after some rows of plant `a`."""
    config_ = MonitorConfig(order=order, isolation=False)
    node = MonitorNode(config_, 0, FleetConfig(plants="reactor/*", state=str(folder)))
    node.on_history_end()
    if rows:
        node.on_alive("reactor/a/alive/plant", True, 0)
    node.on_messages(of_plant("a", rows), 0)
    node.on_stop(0)
    return node


def test_a_fleet_resumes_from_its_stored_state_when_its_settings_are_back(tmp_path: Path, rows: list[Encoded]) -> None:
    """With the other settings the plant is watched from the start on, before its first sample."""
    fleet_of(tmp_path, 3, rows[:30])
    other = fleet_of(tmp_path, 2, [])
    assert (other.plants, other.monitor("a").rows) == (["a"], 0)
    assert sorted(files(tmp_path)) == ["a.state.other-settings"]
    assert fleet_of(tmp_path, 3, rows[30:60]).monitor("a").rows == 20
    assert fleet_of(tmp_path, 2, []).monitor("a").rows == 0
    assert fleet_of(tmp_path, 3, []).monitor("a").rows == 20


def test_a_fleet_s_unusable_state_is_reported_before_its_plant_publishes_anything(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for data in (b"", b"reactorwatch monitor\x00\x01 and then no state"):
        (tmp_path / "a.state").write_bytes(data)
        assert fleet_of(tmp_path, 3, []).plants == ["a"]
        assert "it is kept as a.state.damaged" in (line := capsys.readouterr().out)
        assert "the monitor learns again" in line
    assert sorted(files(tmp_path)) == ["a.state.damaged", "a.state.damaged.2"]
    assert StateStore(tmp_path).plants == ["a"]


def test_a_plant_whose_state_could_only_be_kept_aside_is_watched_at_the_next_start(tmp_path: Path) -> None:
    """The disk was full when its empty state was to be stored, for instance."""
    (tmp_path / "a.state.other-settings").write_bytes(b"of long ago")
    assert fleet_of(tmp_path, 3, []).plants == ["a"]


@pytest.mark.parametrize("data", FOREIGN.values(), ids=FOREIGN)
def test_a_fleet_leaves_a_file_alone_that_is_no_state(
    data: bytes, tmp_path: Path, rows: list[Encoded], capsys: pytest.CaptureFixture[str]
) -> None:
    """Its plant is watched; nothing is stored of it, which the log says, until the file is moved away."""
    (tmp_path / "a.state").write_bytes(data)
    assert fleet_of(tmp_path, 3, rows[:30]).monitor("a").rows == 10
    assert files(tmp_path) == {"a.state": data}
    assert "it is left as it is, and nothing is stored of the plant" in capsys.readouterr().out
    (tmp_path / "a.state").rename(tmp_path / "mine")
    fleet_of(tmp_path, 3, rows[:30])
    assert fleet_of(tmp_path, 3, []).monitor("a").rows == 10


def test_a_fleet_s_state_that_cannot_be_read_is_not_overwritten(tmp_path: Path, rows: list[Encoded]) -> None:
    (tmp_path / "a.state").mkdir()
    (tmp_path / "a.state" / "file").touch()
    assert fleet_of(tmp_path, 3, rows[:30]).monitor("a").rows == 10
    assert sorted(path.name for path in tmp_path.rglob("*")) == [CLAIM, "a.state", "file"]
