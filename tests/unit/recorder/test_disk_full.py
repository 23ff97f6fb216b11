"""A full disk stops the recording, with an alarm, and not the recorder; with space again it resumes."""

import errno
import os
from pathlib import Path

import pytest

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import decode
from recorder.core import DISK_ALARM
from recorder.files.part_file import PartFile
from recorder.files.recording import Recording
from tests.unit.recorder import golden
from tests.unit.recorder.recording import SECOND, recorder
from tests.unit.recorder.test_files import alarm, samples

START = golden.RECEIVED_NS


class Disk:
    """A disk with so much room, shared by the files on it; as on a real one, a write may be taken in part."""

    def __init__(self, room: int) -> None:
        self.room = room
        self.error = errno.ENOSPC

    def open(self, path: Path) -> PartFile:
        disk = self

        class OnDisk(PartFile):
            def _append(self, data: bytearray) -> int:
                if not disk.room:
                    raise OSError(disk.error, os.strerror(disk.error))
                taken = super()._append(data[: disk.room])
                disk.room -= taken
                return taken

        return OnDisk(path)


def recorded(folder: Path) -> list[int]:
    """The sequence numbers of the samples in its recordings."""
    return [
        message.sequence
        for entry in Recording(folder).messages()
        if isinstance(message := decode(entry.payload, entry.encoding), messages.Sample)
    ]


@pytest.mark.parametrize("room", range(19_000, 22_000, 100))
def test_what_is_counted_as_not_recorded_is_missing_wherever_the_disk_is_full(tmp_path: Path, room: int) -> None:
    disk = Disk(room)
    fed = recorder(tmp_path / "run.mcap", START, disk.open, health_period_s=60.0, resume_mb=0.0)
    fed.receive(samples(1000), SECOND // 100)
    disk.room = 10**9
    fed.pass_time(3 * SECOND)
    fed.stop()
    assert fed.last_health().refused_by_reason["disk"] == 1000 - len(recorded(tmp_path)) > 0


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EDQUOT, errno.EIO])
def test_recording_stops_with_an_alarm_keeps_what_is_there_and_resumes_when_there_is_room(
    tmp_path: Path, error: int
) -> None:
    disk = Disk(20_000)
    disk.error = error
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
    kept = recorded(tmp_path)
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
    kept = recorded(tmp_path)
    assert kept[:2910] == list(range(2910))
    assert kept[-1] == 3109
    assert fed.last_health().refused_by_reason["disk"] == 3110 - len(kept)
    assert [entry.key for entry in Recording(second).messages() if entry.latched] == ["reactor/cstr/alarm/ewma/T"]
    assert first.name == "run.mcap"
