"""A folder or file that is deleted under a recorder raises the alarm, and recording resumes in a new file."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from reactorwatch.contract import messages_pb2 as messages
from recorder.core import DISK_ALARM
from recorder.files.part_file import DELETED
from tests.unit.recorder import golden
from tests.unit.recorder.recording import SECOND, recorder
from tests.unit.recorder.test_disk_full import recorded
from tests.unit.recorder.test_files import alarm, samples

START = golden.RECEIVED_NS


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
    kept = recorded(folder)
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
    assert recorded(folder)[-1] == 49


def test_a_folder_that_is_deleted_when_a_file_is_due_to_end_costs_that_file_alone(tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    fed = recorder(folder, START, rotate_min=1.0, black_box_min=0.0)
    fed.receive(samples(59), SECOND)
    shutil.rmtree(folder)
    fed.receive(samples(60, first=59), SECOND)
    fed.stop()
    assert recorded(folder)[-1] == 118
