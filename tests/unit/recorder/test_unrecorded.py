"""Alarms about what cannot be recorded: a full disk, a deleted folder, too many keys."""

import errno
import os
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Encoded, Publication, encode
from recorder.core import DISK_ALARM, KEYS_ALARM
from recorder.files.recording import Recording
from recorder.files.writer import DELETED
from recorder.keep import MAX_OTHER_CHANNELS
from tests.unit.recorder import golden
from tests.unit.recorder.recording import SECOND, Disk, Fed, alarm, recorder, samples, sequences

START = golden.RECEIVED_NS


@pytest.mark.parametrize("room", range(19_000, 22_000, 100))
def test_what_is_counted_as_not_recorded_is_missing_wherever_the_disk_is_full(tmp_path: Path, room: int) -> None:
    disk = Disk(room)
    fed = recorder(tmp_path / "run.mcap", START, disk.open, health_period_s=60.0, resume_mb=0.0)
    fed.receive(samples(1000), SECOND // 100)
    disk.room = 10**9
    fed.pass_time(3 * SECOND)
    fed.stop()
    assert fed.last_health().refused_by_reason["disk"] == 1000 - len(sequences(tmp_path)) > 0


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EDQUOT, errno.EIO])
def test_recording_stops_with_an_alarm_keeps_what_is_there_and_resumes_when_there_is_room(
    tmp_path: Path, error: int
) -> None:
    disk = Disk(20_000, error)
    fed = recorder(tmp_path / "run.mcap", START, disk.open, health_period_s=60.0, resume_mb=0.0)
    fed.receive(samples(1000), SECOND // 100)
    (raised,) = fed.alarms()
    assert (raised.alarm, raised.event, raised.priority) == (DISK_ALARM, "raised", messages.PRIORITY_CRITICAL)
    assert os.strerror(error) in raised.text
    assert fed.last_health().phase == "not recording"
    disk.room = 10**9
    fed.pass_time(3 * SECOND)
    assert [item.event for item in fed.alarms()] == ["raised", "cleared"]
    assert fed.alarms()[-1].state == messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED  # nobody has said that he saw it
    fed.receive(samples(1000, first=1000), SECOND // 100)
    fed.stop()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run-2.mcap", "run.mcap"]
    kept = sequences(tmp_path)
    missing = sorted(set(range(2000)) - set(kept))
    assert kept == sorted(kept)
    assert 0 < len(missing) < 1000
    assert missing == list(range(missing[0], missing[-1] + 1))  # nothing but the time without room
    assert missing[-1] == 999
    health = fed.last_health()
    assert health.refused_by_reason["disk"] == len(missing)
    assert health.received == 2000


def test_while_the_disk_stays_full_it_is_reported_once_and_each_report_counts_on(tmp_path: Path) -> None:
    disk = Disk(20_000)
    fed = recorder(tmp_path / "run.mcap", START, disk.open, health_period_s=1.0, resume_mb=0.0)
    fed.receive(samples(1500), SECOND // 100)
    reports = [item.message for item in fed.published if isinstance(item.message, messages.Health)]
    counts = [report.refused_by_reason["disk"] for report in reports if report.phase == "not recording"]
    assert len(counts) > 5
    assert counts == sorted(set(counts))
    assert len(fed.alarms()) == 1
    fed.stop()
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap.part"]


def test_without_the_room_that_was_asked_for_it_does_not_try(tmp_path: Path) -> None:
    disk = Disk(12_000)
    fed = recorder(tmp_path / "run.mcap", START, disk.open, resume_mb=1e12)
    fed.receive(samples(500), SECOND // 100)
    disk.room = 10**9
    fed.pass_time(60 * SECOND)
    assert [item.event for item in fed.alarms()] == ["raised"]
    fed.stop()


def test_a_disk_that_is_full_when_a_file_is_completed_loses_nothing_that_was_flushed(tmp_path: Path) -> None:
    """The index of the finished file finds no room; the file is recovered when there is some."""
    disk = Disk(10**9)
    fed = recorder(tmp_path / "run.mcap", START, disk.open, rotate_min=0.5, resume_mb=0.0)
    fed.receive([*samples(10), alarm("ewma/T"), *samples(2900, 10)], SECOND // 100)
    fed.pass_time(SECOND)
    disk.room = 100
    fed.receive(samples(100, first=2910), SECOND // 10)
    disk.room = 10**9
    fed.receive(samples(100, first=3010), SECOND // 10)
    fed.stop()
    first, second = Recording(tmp_path).files
    assert not list(tmp_path.glob("*.part"))
    kept = sequences(tmp_path)
    assert kept[:2910] == list(range(2910))
    assert kept[-1] == 3109
    assert fed.last_health().refused_by_reason["disk"] == 3110 - len(kept)
    assert [entry.key for entry in Recording(second).messages() if entry.latched] == ["reactor/cstr/alarm/ewma/T"]
    assert first.name == "run.mcap"


def delete_file(folder: Path) -> None:
    for part in folder.glob("*.part"):
        part.unlink()


def put_another_file(folder: Path) -> None:
    for part in folder.glob("*.part"):
        part.unlink()
        part.write_bytes(b"another")


def delete_folder(folder: Path) -> None:
    """Whatever the recorder is just writing there."""
    while folder.exists():
        shutil.rmtree(folder, ignore_errors=True)


def delete_folders(folder: Path) -> None:
    delete_folder(folder.parent)


def rename_folder(folder: Path) -> None:
    folder.rename(folder.with_name("elsewhere"))


WAYS = (delete_file, put_another_file, delete_folder, delete_folders, rename_folder)


@pytest.mark.parametrize("out", ["", "run.mcap"])
@pytest.mark.parametrize("delete", WAYS)
def test_the_alarm_is_raised_at_the_next_flush_and_recording_resumes_in_a_new_file(
    tmp_path: Path, delete: Callable[[Path], None], out: str
) -> None:
    folder = tmp_path / "plant" / "recordings"
    folder.mkdir(parents=True)
    fed = recorder(folder / out, START, black_box_min=0.1)
    fed.receive([alarm("ewma/T"), *samples(100)], SECOND // 10)
    delete(folder)
    fed.receive(samples(10, first=100), SECOND // 10)
    (raised,) = fed.alarms()
    assert (raised.alarm, raised.event) == (DISK_ALARM, "raised")
    assert DELETED in raised.text
    assert fed.last_health().phase == "not recording"
    fed.receive(samples(100, first=110), SECOND // 10)
    assert [item.event for item in fed.alarms()] == ["raised", "cleared"]
    assert fed.alarms()[-1].state == messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED
    fed.stop()
    kept = sequences(folder)
    assert kept == list(range(kept[0], 210))
    assert 100 < kept[0] < 140
    missing = fed.last_health().refused_by_reason["disk"]
    assert kept[0] - 100 <= missing <= kept[0] - 100 + 5  # with what was not flushed when it was deleted


def test_a_folder_that_cannot_be_made_again_is_tried_until_it_can(tmp_path: Path) -> None:
    folder = tmp_path / "plant" / "recordings"
    folder.mkdir(parents=True)
    fed = recorder(folder, START)
    fed.receive(samples(10), SECOND)
    delete_folder(folder.parent)
    folder.parent.write_bytes(b"a file where the folder was")
    fed.receive(samples(30, first=10), SECOND)
    assert [item.event for item in fed.alarms()] == ["raised"]
    folder.parent.unlink()
    fed.receive(samples(10, first=40), SECOND)
    assert [item.event for item in fed.alarms()] == ["raised", "cleared"]
    fed.stop()
    assert sequences(folder)[-1] == 49


def test_a_folder_that_is_deleted_when_a_file_is_due_to_end_costs_that_file_alone(tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    fed = recorder(folder, START, rotate_min=1.0, black_box_min=0.0)
    fed.receive(samples(59), SECOND)
    shutil.rmtree(folder)
    fed.receive(samples(60, first=59), SECOND)
    fed.stop()
    assert sequences(folder)[-1] == 118


GOOD = messages.QUALITY_GOOD
SAMPLE = encode(Publication("", messages.Sample(quality=GOOD)))

STRAYS: dict[str, Callable[[int], Encoded]] = {
    "no payload": lambda number: Encoded(f"reactor/x/sample/{number}", b"", "?"),
    "another payload": lambda number: Encoded(f"reactor/x/sample/{number}", b"\xff\xff", SAMPLE.encoding),
    "another encoding each": lambda number: Encoded("reactor/cstr/sample/T", b"{}", f"text/{number}"),
    "our messages on keys of others": lambda number: SAMPLE._replace(key=f"weather/{number}"),
}


def sample(plant: str, sequence: int = 0) -> Encoded:
    return encode(Publication(f"reactor/{plant}/sample/T", messages.Sample(sequence=sequence, quality=GOOD)))


def receive(fed: Fed, received: Iterable[Encoded], apart_ns: int = 0) -> None:
    for message in received:
        fed.pass_time(apart_ns)
        fed.published += fed.node.on_message(message._replace(received_ns=fed.now_ns), fed.now_ns)


def recorded_keys(folder: Path) -> set[str]:
    return {entry.key for entry in Recording(folder).messages()}


@pytest.mark.parametrize("kind", STRAYS)
def test_10_000_stray_keys_take_no_room_from_messages_of_the_product(tmp_path: Path, kind: str) -> None:
    fed = recorder(tmp_path, START, most_keys=200, black_box_min=0.0)
    receive(fed, map(STRAYS[kind], range(10_000)))
    receive(fed, (sample(f"p{number}") for number in range(100)))
    (raised,) = fed.alarms()
    assert (raised.alarm, raised.event) == (KEYS_ALARM, "raised")
    assert "for more keys of other programs" in raised.text
    fed.pass_time(120 * SECOND)
    assert fed.alarms()[-1].event == "cleared"
    fed.stop()
    assert {f"reactor/p{number}/sample/T" for number in range(100)} <= recorded_keys(tmp_path)
    assert fed.last_health().refused_by_reason["too many keys"] == 10_000 - MAX_OTHER_CHANNELS


def test_messages_of_the_product_beyond_the_budget_raise_the_alarm_and_those_within_it_continue(tmp_path: Path) -> None:
    fed = recorder(tmp_path, START, most_keys=100, black_box_min=0.0)
    for second in range(100):
        receive(fed, (sample(f"p{number}", second) for number in range(105)))
        fed.pass_time(SECOND)
    (raised,) = fed.alarms()
    receive(fed, [encode(Publication(f"reactor/cstr/alarm/{KEYS_ALARM}", raised))])
    assert "for more keys of this software" in raised.text
    assert "'reactor/p100/sample/T'" in raised.text
    fed.stop()
    files = Recording(tmp_path).files
    assert len(files) == 1  # every key is in use: another file would have no room for more
    samples = {f"reactor/p{number}/sample/T" for number in range(100)}
    own = {f"reactor/cstr/alarm/{KEYS_ALARM}", "reactor/cstr/health/recorder"}
    assert recorded_keys(tmp_path) == samples | own
    assert fed.last_health().refused_by_reason["too many keys"] == 5 * 100


def test_silent_keys_give_their_budget_to_others_in_the_next_file(tmp_path: Path) -> None:
    """Forged messages of the product on 100 keys are forgotten; the keys of a sound plant have room again."""
    fed = recorder(tmp_path, START, most_keys=100, black_box_min=0.0)
    receive(fed, (sample(f"forged{number}") for number in range(150)))
    for second in range(100):
        receive(fed, [sample("cstr", second)])
        fed.pass_time(SECOND)
    fed.pass_time(SECOND)
    assert [item.event for item in fed.alarms()] == ["raised"]
    receive(fed, (sample("cstr", second) for second in range(100, 200)), SECOND)
    assert [item.event for item in fed.alarms()] == ["raised", "cleared"]
    fed.stop()
    first, second_file = Recording(tmp_path).files
    assert recorded_keys(second_file) == {"reactor/cstr/sample/T", "reactor/cstr/health/recorder"}
    assert "reactor/cstr/sample/T" not in recorded_keys(first)
