"""No stored file is lost to another start: what cannot be used is kept, and used again when it fits."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from monitor_node.__main__ import MonitorNode
from monitor_node.config import MonitorConfig
from monitor_node.fleet.config import FleetConfig
from monitor_node.fleet.node import POLL_NS, FleetNode
from monitor_node.storage import state_recovery
from monitor_node.storage.alarm_file import SEAL
from monitor_node.storage.fleet_states import FleetStates
from monitor_node.storage.kept_aside import find_kept_aside, keep_aside
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState
from reactorwatch.errors import InputError
from tests.memory_bus import Exchange, MemoryBus
from tests.running import WITHIN_S

from ..fleets import of_plant
from ..samples import leaking_run, samples

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
    return {path.name: path.read_bytes() for path in folder.iterdir()}


SETTINGS: list[dict[str, object]] = [{}, {"order": 2}, {"plant": "typo"}, {"isolation": False}]


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.sampled_from(range(len(SETTINGS))), min_size=2, max_size=6))
def test_settings_changed_and_changed_back_cost_no_row(
    tmp_path_factory: pytest.TempPathFactory, rows: list[Encoded], starts: list[int]
) -> None:
    """Each start goes on with all rows that were learned with its settings, in any order of starts."""
    folder = tmp_path_factory.mktemp("changed")
    learned = dict.fromkeys(range(len(SETTINGS)), 0)
    for number in starts:
        node = MonitorNode(config(folder, **SETTINGS[number]), 0)
        assert node.rows == learned[number]
        first = 3 * learned[number]
        for message in of_plant(str(SETTINGS[number].get("plant", "cstr")), rows[first : first + 15]):
            node.on_message(message, 0)
        node.on_stop(0)
        learned[number] = node.rows
    assert len(files(folder)) == len(set(starts))


def test_an_empty_state_is_not_written_over_one_that_was_kept(tmp_path: Path, rows: list[Encoded]) -> None:
    """The case of issue 23: two starts with other settings and no sample, then the old settings again."""
    node = MonitorNode(config(tmp_path), 0)
    for message in rows:
        node.on_message(message, 0)
    node.on_stop(0)
    for order in (2, 4):
        MonitorNode(config(tmp_path, order=order), 0)
    assert MonitorNode(config(tmp_path), 0).rows == len(rows) // 3


def test_each_damaged_file_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, damaged = tmp_path / "monitor.state", list[bytes]()
    for number in range(4):
        MonitorNode(config(tmp_path), 0)
        data = bytearray(path.read_bytes())
        data[-1 - number] ^= 1
        path.write_bytes(data)
        damaged.append(bytes(data))
    MonitorNode(config(tmp_path), 0)
    kept = {name: data for name, data in files(tmp_path).items() if name != path.name}
    assert [kept[f"monitor.state.damaged{ending}"] for ending in ("", ".2", ".3", ".4")] == damaged
    assert "it is kept as monitor.state.damaged.4, and" in capsys.readouterr().out


def test_every_flipped_bit_of_a_head_is_damage_and_no_foreign_file(tmp_path: Path) -> None:
    MonitorNode(config(tmp_path), 0)
    path = tmp_path / "monitor.state"
    stored = path.read_bytes()
    for bit in range(0, 8 * 24, 5):
        data = bytearray(stored)
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        assert not MonitorNode(config(tmp_path), 0).resumed
    kept = find_kept_aside(tmp_path)["monitor.state"]
    assert len({aside.read_bytes() for aside in kept}) == len(range(0, 8 * 24, 5))


@pytest.mark.parametrize("setting", ["state_file", "alarm_state_file"])
@pytest.mark.parametrize("name", FOREIGN)
def test_a_file_that_is_no_state_is_refused_and_left_alone(setting: str, name: str, tmp_path: Path) -> None:
    """Also while the other file is a good one of a monitor that has learned something."""
    (tmp_path / name).write_bytes(FOREIGN[name])
    good = {"state_file": str(tmp_path / "monitor.state"), "alarm_state_file": str(tmp_path / "alarms.state")}
    MonitorNode(MonitorConfig(**good), 0)  # type: ignore[arg-type]
    before = files(tmp_path)
    with pytest.raises(InputError, match=rf"^{setting} .*{name}: is no ") as refused:
        MonitorNode(MonitorConfig(**(good | {setting: str(tmp_path / name)})), 0)  # type: ignore[arg-type]
    assert "\n" not in str(refused.value)
    assert files(tmp_path) == before


@pytest.mark.parametrize("setting", ["state_file", "alarm_state_file"])
def test_what_is_no_regular_file_is_refused(setting: str, tmp_path: Path) -> None:
    """A pipe would be waited for, a device replaced."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match=rf"^{setting} .*pipe: is not a regular file; name one"):
        MonitorNode(MonitorConfig(**{setting: str(tmp_path / "pipe")}), 0)  # type: ignore[arg-type]
    assert (tmp_path / "pipe").is_fifo()


def test_one_file_for_both_is_refused(tmp_path: Path) -> None:
    path = str(tmp_path / "both.state")
    with pytest.raises(InputError, match=r"must be two files, got .*both.state for both"):
        MonitorNode(MonitorConfig(state_file=path, alarm_state_file=path), 0)
    assert files(tmp_path) == {}


def test_a_typo_in_the_plant_s_name_changes_no_file(tmp_path: Path, rows: list[Encoded]) -> None:
    """With both files, as `monitor --state` names them: the alarms are another plant's, so nothing is begun."""
    both = config(tmp_path, alarm_state_file=str(tmp_path / "alarms.state"))
    node = MonitorNode(both, 0)
    for message in rows:
        node.on_message(message, 0)
    node.on_stop(0)
    before = files(tmp_path)
    with pytest.raises(InputError, match="is the alarm state of plant 'cstr', not of 'cst'; move it away"):
        MonitorNode(msgspec.structs.replace(both, plant="cst"), 0)
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
    alarms = node.alarms.all_alarms()
    for alarm in alarms:
        alarm.time_ns = 0
    return alarms


WITH_ALARMS = MonitorConfig(training_min=60.0, diagnose_training=False)


@pytest.fixture(scope="module")
def in_alarm(leak: list[Encoded]) -> MonitorNode:
    """A monitor with alarms that stand."""
    node = MonitorNode(WITH_ALARMS, 0)
    for message in leak:
        node.on_message(message, 0)
    assert any(stands(alarm) for alarm in node.alarms.all_alarms())
    return node


@pytest.fixture
def alarm_file(tmp_path: Path, in_alarm: MonitorNode) -> Path:
    path = tmp_path / "alarms.state"
    path.write_bytes(SEAL.close(in_alarm.alarms.to_bytes()))
    return path


def from_alarms(path: Path, **others: object) -> MonitorNode:
    """A monitor that starts with a file of alarms."""
    settings_ = {"alarm_state_file": str(path)} | others
    return MonitorNode(msgspec.structs.replace(WITH_ALARMS, **settings_), 0)


def flip_bit(stored: bytes, bit: int) -> bytes:
    data = bytearray(stored)
    data[bit // 8] ^= 1 << bit % 8
    return bytes(data)


def is_refused(data: bytes) -> bool:
    try:
        SEAL.open(data)
    except InputError:
        return True
    return False


def test_every_flipped_bit_of_the_alarms_is_refused(alarm_file: Path) -> None:
    """One in a name would make a standing alarm normal. All are tried on the bytes, some on the file."""
    stored = alarm_file.read_bytes()
    assert [bit for bit in range(8 * len(stored)) if not is_refused(flip_bit(stored, bit))] == []
    for bit in range(0, 8 * len(stored), 8 * len(stored) // 5):
        alarm_file.write_bytes(flip_bit(stored, bit))
        with pytest.raises(InputError, match=r"^alarm_state_file .*; move it away to begin"):
            from_alarms(alarm_file)
        assert alarm_file.read_bytes() == flip_bit(stored, bit)


def test_damaged_alarms_beside_a_good_state_are_kept_and_reported(
    alarm_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], rows: list[Encoded]
) -> None:
    """The state has the alarms, too: the watch goes on with these."""
    both, damaged = {"state_file": str(tmp_path / "monitor.state")}, flip_bit(alarm_file.read_bytes(), 5000)
    node = from_alarms(alarm_file, **both)
    for message in rows:
        node.on_message(message, 0)
    node.on_stop(0)
    alarm_file.write_bytes(damaged)
    capsys.readouterr()
    again = from_alarms(alarm_file, **both)
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "alarm_state_file" in line]
    assert "is a damaged alarm state" in line
    assert "it is kept as alarms.state.damaged, and the alarms are those of state_file" in line
    assert (again.rows, stored_alarms(again)) == (node.rows, stored_alarms(node))
    assert (tmp_path / "alarms.state.damaged").read_bytes() == damaged
    assert not is_refused(alarm_file.read_bytes())


def test_alarms_of_a_version_without_a_digest_are_read(alarm_file: Path, in_alarm: MonitorNode) -> None:
    alarm_file.write_bytes(in_alarm.alarms.to_bytes())
    assert stored_alarms(from_alarms(alarm_file)) == stored_alarms(in_alarm)
    assert not is_refused(alarm_file.read_bytes())


def test_alarms_that_a_setting_leaves_out_come_back_with_it(alarm_file: Path, in_alarm: MonitorNode) -> None:
    few = from_alarms(alarm_file, charts=("shewhart",))
    assert len(stored_alarms(few)) < len(stored_alarms(in_alarm))
    assert stored_alarms(from_alarms(alarm_file)) == stored_alarms(in_alarm)


def test_alarms_are_not_older_than_their_file_after_a_state_was_aside(tmp_path: Path, leak: list[Encoded]) -> None:
    """A comment made while other settings were in force is kept."""
    both = config(tmp_path, training_min=60.0, alarm_state_file=str(tmp_path / "alarms.state"))
    node = MonitorNode(both, 0)
    for message in leak:
        node.on_message(message, 0)
    node.on_stop(0)
    standing = next(alarm.alarm for alarm in node.alarms.all_alarms() if stands(alarm))
    other = MonitorNode(msgspec.structs.replace(both, order=2), 0)
    other.alarms.comment(standing, "Anna", "the valve is being repaired")
    other.on_tick(0)
    again = MonitorNode(both, 0)
    assert again.rows == node.rows
    assert again.alarms.alarm(standing).comment == "the valve is being repaired"


def test_a_silence_that_stood_ends_with_the_next_sample(tmp_path: Path, rows: list[Encoded]) -> None:
    """Also when the monitor learns from scratch, and knows the silence from the file of the alarms alone."""
    settings_ = MonitorConfig(alarm_state_file=str(tmp_path / "alarms.state"))
    node = MonitorNode(settings_, 0)
    for message in rows[:150]:
        node.on_message(message, 0)
    node.silence.declare_timeout()
    node.on_tick(0)
    again = MonitorNode(settings_, 0)
    assert stands(again.alarms.alarm("silence/plant"))
    for message in rows[150:]:
        again.on_message(message, 0)
    assert not stands(again.alarms.alarm("silence/plant"))


# --- fleets ------------------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _no_settling(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state_recovery, "HANDOVER_S", 0.0)


def fleet_of(folder: Path, order: int, rows: list[Encoded]) -> FleetNode:
    """A fleet's monitor that watches the plants of its folder, and is stopped after some rows of plant `a`."""
    config_ = MonitorConfig(order=order, isolation=False)
    node = FleetNode(config_, FleetConfig(plants="reactor/*"), MemoryBus(Exchange()), 0, FleetStates(folder))
    calls: SimpleQueue[Callable[[int], list[Publication]]] = SimpleQueue()
    for _ in node.subscriptions:
        node.on_subscribed(calls.put)
    if rows:
        node.on_alive("reactor/a/alive/plant", True, 0)
    now_ns = 0
    while node.is_pending("a"):
        calls.get(timeout=WITHIN_S)(now_ns)
        now_ns += POLL_NS
        node.on_tick(now_ns)
    node.on_messages(of_plant("a", rows), now_ns)
    node.on_stop(now_ns)
    return node


def test_a_fleet_goes_on_from_what_it_kept_when_its_settings_are_back(tmp_path: Path, rows: list[Encoded]) -> None:
    """With the other settings the plant is watched and in the folder from the start on, before it says anything."""
    fleet_of(tmp_path, 3, rows[:30])
    other = fleet_of(tmp_path, 2, [])
    assert (other.plants, other.monitor("a").rows) == (["a"], 0)
    assert sorted(files(tmp_path)) == ["a.state", "a.state.other-settings"]
    assert fleet_of(tmp_path, 3, rows[30:60]).monitor("a").rows == 20
    assert fleet_of(tmp_path, 2, []).monitor("a").rows == 0
    assert fleet_of(tmp_path, 3, []).monitor("a").rows == 20


def test_a_fleet_s_unusable_state_is_reported_before_its_plant_says_anything(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for data in (b"", b"reactorwatch monitor\x00\x01 and then no state"):
        (tmp_path / "a.state").write_bytes(data)
        assert fleet_of(tmp_path, 3, []).plants == ["a"]
        assert "the plant is learned again, and the state kept as a.state.damaged" in capsys.readouterr().out
    assert sorted(files(tmp_path)) == ["a.state", "a.state.damaged", "a.state.damaged.2"]
    assert FleetStates(tmp_path).plants == ["a"]


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
    assert "a.state is left as it is; nothing is stored of the plant" in capsys.readouterr().out
    (tmp_path / "a.state").rename(tmp_path / "mine")
    fleet_of(tmp_path, 3, rows[:30])
    assert fleet_of(tmp_path, 3, []).monitor("a").rows == 10


def test_a_fleet_s_state_that_cannot_be_read_is_not_overwritten(tmp_path: Path, rows: list[Encoded]) -> None:
    (tmp_path / "a.state").mkdir()
    (tmp_path / "a.state" / "file").touch()
    assert fleet_of(tmp_path, 3, rows[:30]).monitor("a").rows == 10
    assert [path.name for path in tmp_path.rglob("*")] == ["a.state", "file"]
