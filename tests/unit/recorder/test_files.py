"""The files of a recorder: each opens by itself; what is kept, deleted and recovered, and the black box."""

import os
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Publication, decode, encode
from reactorwatch.errors import InputError
from reactorwatch.version import version
from recorder.config import RecorderConfig
from recorder.core import ReceivedMessage, Recorder
from recorder.files.reader import Reader
from recorder.files.recording import Recording
from recorder.files.writer import RecordingWriter
from recorder.keep import AlarmInterval
from recorder.recording_files import RecordingFiles, free_bytes
from recorder.tools.convert import read_record
from tests.unit.recorder import golden
from tests.unit.recorder.recording import MINUTE, SECOND, Confirmed, Fed, alarm, of_others, recorder, samples, sequences

START = golden.RECEIVED_NS
ALL = [encode(publication) for publication in golden.publications()]


def test_files_follow_each_other_by_age_and_hold_everything_between_them(tmp_path: Path) -> None:
    fed = recorder(tmp_path / "run.mcap", START, rotate_min=1.0, black_box_min=0.0)
    fed.receive(golden.publications(), MINUTE // 700)
    fed.stop()
    files = sorted(tmp_path.iterdir(), key=lambda path: (len(path.name), path.name))
    assert [path.name for path in files] == ["run.mcap", "run-2.mcap", "run-3.mcap"]
    assert [entry[:3] for entry in of_others(tmp_path)] == [message[:3] for message in ALL]
    for path in files:
        times = [entry.log_time_ns for entry in Recording(path).messages()]
        assert times == sorted(times)
        assert times[-1] - times[0] <= MINUTE


def test_files_follow_each_other_by_size(tmp_path: Path) -> None:
    fed = recorder(tmp_path, START, rotate_mb=0.08, black_box_min=0.0)
    fed.receive(golden.publications(), SECOND // 10)
    fed.stop()
    sizes = [path.stat().st_size for path in Recording(tmp_path).files]
    assert len(sizes) > 2
    assert all(80_000 <= size <= 130_000 for size in sizes[:-1])  # and what its index takes
    assert [entry[:3] for entry in of_others(tmp_path)] == [message[:3] for message in ALL]


def test_every_file_starts_with_the_latched_messages_and_a_folder_yields_them_once(tmp_path: Path) -> None:
    fed = recorder(tmp_path, START, rotate_min=1.0)
    model = messages.ModelSnapshot(time_ns=5, structure="arx", rows=7, reference=True)
    stands = [Publication(keys.key("cstr", keys.MODEL, "T"), model), alarm("ewma/T")]
    fed.receive([*samples(1), *stands], SECOND)
    fed.receive(samples(200, first=1), SECOND)
    fed.stop()
    files = Recording(tmp_path).files
    assert len(files) == 4
    for path in files[1:]:
        first = [entry for entry in Recording(path).messages() if entry.latched]
        assert [decode(entry.payload, entry.encoding) for entry in first] == [item.message for item in stands]
        assert list(Recording(path).messages())[: len(first)] == first
        assert [entry.publish_time_ns for entry in first] == [5, 1]
    assert not any(entry.latched for entry in Recording(tmp_path).messages())
    assert sum("/alarm/" in entry.key for entry in Recording(tmp_path).messages()) == 1


def test_every_file_opens_by_itself_and_states_its_origin(tmp_path: Path) -> None:
    fed = recorder(tmp_path, START, rotate_min=1.0, about={"seed": "7"})
    fed.receive(samples(100), SECOND)
    fed.stop()
    first, second = Recording(tmp_path).files
    for number, path in enumerate((first, second), start=1):
        assert read_record(path).rows
        said = Recording(path).metadata
        assert (said["plant"], said["version"], said["seed"], said["file"]) == ("cstr", version(), "7", str(number))
        assert tomllib.loads(said["configuration"])["rotate_min"] == 1.0
    assert Recording(second).metadata["after"] == first.name


def test_a_folder_is_read_as_one_recording(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    fed = recorder(tmp_path / "folder", START, rotate_min=0.5, black_box_min=0.0)
    one = recorder(tmp_path / "one.mcap", START, black_box_min=0.0)
    for each in (fed, one):
        each.receive(golden.publications(), MINUTE // 500)
        each.stop()
    assert len(Recording(tmp_path / "folder").files) > 2
    assert of_others(tmp_path / "folder") == of_others(tmp_path / "one.mcap")
    assert Recording(tmp_path / "folder").plants == ("cstr",)
    a, b = read_record(tmp_path / "folder"), read_record(tmp_path / "one.mcap")
    assert a.time_min.tolist() == b.time_min.tolist()
    assert a.columns["T"].tolist() == b.columns["T"].tolist()


def test_files_that_overlap_in_time_are_read_together_in_order_of_receipt(tmp_path: Path) -> None:
    a, b = recorder(tmp_path / "a.mcap", START), recorder(tmp_path / "b.mcap", START, plant="other")
    for number in range(20):
        for fed in (a, b):
            fed.receive(samples(1, number), SECOND)
    a.stop()
    b.stop()
    times = [entry.log_time_ns for entry in of_others(tmp_path)]
    assert times == sorted(times)
    assert len(times) == 40


def test_the_oldest_are_deleted_and_never_the_one_being_written_nor_a_black_box(tmp_path: Path) -> None:
    fed = recorder(tmp_path / "run.mcap", START, rotate_min=1.0, keep_files=2.0, black_box_min=0.1)
    (tmp_path / "mine.mcap").write_bytes(b"of somebody else")
    fed.receive([*samples(30), alarm("ewma/T"), *samples(400, first=30)], SECOND)
    fed.stop()
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == [".run.ages", "black-box", "mine.mcap", "run-7.mcap", "run-8.mcap"]
    assert len(list((tmp_path / "black-box").iterdir())) == 1
    last = [entry for entry in Recording(tmp_path / "run-8.mcap").messages() if "/sample/" in entry.key]
    assert last


def test_a_black_box_holds_what_came_before_and_after_the_alarm_and_how_things_stood(tmp_path: Path) -> None:
    fed = recorder(tmp_path, START, rotate_min=1.0, black_box_min=0.5)
    fed.receive([*samples(10), alarm("shewhart/C"), *samples(89, 10), alarm("ewma/T"), *samples(100, 99)], SECOND)
    fed.stop()
    first, second = sorted((tmp_path / "black-box").iterdir())
    assert first.name.endswith("Z-shewhart-C.mcap")
    assert second.name.endswith("Z-ewma-T.mcap")
    assert Recording(second).metadata["alarm"] == "ewma/T"
    (standing,) = [entry for entry in Recording(second).messages() if entry.latched]
    assert standing.key == "reactor/cstr/alarm/shewhart/C"
    kept = [entry for entry in of_others(second) if not entry.latched]
    (at,) = [entry.log_time_ns for entry in kept if "/alarm/" in entry.key]
    whole = [entry for entry in of_others(tmp_path) if at - MINUTE // 2 <= entry.log_time_ns <= at + MINUTE // 2]
    assert kept == whole
    assert len(kept) == 61


def test_a_stretch_that_is_not_over_when_the_recorder_stops_is_kept_as_far_as_it_goes(tmp_path: Path) -> None:
    fed = recorder(tmp_path, START, black_box_min=5.0)
    fed.receive([*samples(5), alarm("ewma/T"), *samples(3, 5)], SECOND)
    fed.stop()
    (box,) = (tmp_path / "black-box").iterdir()
    assert len(of_others(box)) == 9


@pytest.mark.parametrize("left", [slice(-4), slice(0), slice(100)])
def test_a_stretch_whose_copy_is_damaged_is_copied_again_at_the_next_start(tmp_path: Path, left: slice) -> None:
    fed = recorder(tmp_path, START, black_box_min=1.0)
    fed.receive([*samples(30), alarm("ewma/T"), *samples(60, 30)], SECOND)
    fed.pass_time(2 * MINUTE)
    fed.stop()
    (box,) = (tmp_path / "black-box").iterdir()
    whole = of_others(box)
    box.write_bytes(box.read_bytes()[left])
    recorder(tmp_path, fed.now_ns + SECOND, black_box_min=1.0).stop()
    (again,) = set((tmp_path / "black-box").iterdir()) - {box}
    assert of_others(again) == whole


def test_all_of_a_stretch_is_in_the_file_when_it_is_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its last sample came a moment before its end, and would be flushed later."""
    fed = recorder(tmp_path / "run.mcap", START, black_box_min=0.5, flush_period_s=1.0)
    there: list[int] = []
    part = tmp_path / "run.mcap.part"
    monkeypatch.setattr(
        fed.files,
        "save_black_box",
        lambda _: there.append(sum("/sample/" in x.channel.key for x in Reader(part, tolerant=True))),
    )
    fed.receive([alarm("ewma/T")], SECOND)
    fed.pass_time(29 * SECOND)
    fed.receive(samples(1), 9 * SECOND // 10)
    fed.pass_time(SECOND // 5)
    assert there == [1]
    fed.stop()


def killed(folder: Path, count: int) -> Fed:
    fed = recorder(folder, START)
    fed.receive(samples(count), SECOND // 10)
    fed.kill()
    return fed


@pytest.mark.parametrize("name", ["run.mcap", "."])
def test_the_next_start_recovers_what_a_kill_left_and_resumes_in_a_new_file(tmp_path: Path, name: str) -> None:
    killed(tmp_path / name, 100)
    (part,) = tmp_path.glob("*.part")
    fed = recorder(tmp_path / name, START + MINUTE)
    fed.receive(samples(50, first=100), SECOND // 10)
    fed.stop()
    assert not list(tmp_path.glob("*.part"))
    first, _second = Recording(tmp_path).files
    assert first.name == part.name.removesuffix(".part")
    lost = sorted(set(range(150)) - set(sequences(tmp_path)))
    assert lost == list(range(100 - len(lost), 100))  # the last before the kill, and nothing else
    assert len(lost) <= 10  # a second
    last = [entry.log_time_ns for entry in of_others(first)][-1]
    assert abs(first.stat().st_mtime_ns - last) < 2 * SECOND  # the health report may be younger


def test_kills_one_after_the_other_leave_a_file_each(tmp_path: Path) -> None:
    for _ in range(3):
        killed(tmp_path / "run.mcap", 20)
    recorder(tmp_path / "run.mcap", START).stop()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run-2.mcap", "run-3.mcap", "run-4.mcap", "run.mcap"]


def test_a_recovery_that_was_killed_before_it_deleted_the_remains_is_done_again_into_the_same_file(
    tmp_path: Path,
) -> None:
    killed(tmp_path / "run.mcap", 100)
    remains = (tmp_path / "run.mcap.part").read_bytes()
    recorder(tmp_path / "run.mcap", START).stop()
    recovered = of_others(tmp_path / "run.mcap")
    (tmp_path / "run.mcap.part").write_bytes(remains)
    recorder(tmp_path / "run.mcap", START).stop()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run-2.mcap", "run-3.mcap", "run.mcap"]
    assert of_others(tmp_path / "run.mcap") == recovered


def test_a_file_of_the_same_name_and_another_origin_is_not_written_over_by_a_recovery(tmp_path: Path) -> None:
    killed(tmp_path / "run.mcap", 100)
    RecordingWriter(other := tmp_path / "other.mcap", {"started": "yesterday"}).close()
    other.rename(tmp_path / "run.mcap")
    recorder(tmp_path / "run.mcap", START).stop()
    assert not of_others(tmp_path / "run.mcap")
    assert of_others(tmp_path / "run-recovered.mcap")


def test_damaged_remains_count_and_are_deleted_in_their_turn_and_what_people_saved_is_not(tmp_path: Path) -> None:
    for name in ("run-recovered.mcap", "run-7.mcap.part.damaged", "mine.mcap.part.damaged"):
        (tmp_path / name).write_bytes(b"of before")
        os.utime(tmp_path / name, ns=(1, 1))
    fed = recorder(tmp_path / "run.mcap", START, rotate_min=1.0, keep_files=3.0, black_box_min=0.0)
    fed.receive(samples(130), SECOND)
    fed.stop()
    names = {path.name for path in tmp_path.iterdir()}
    assert names - {".run.ages"} == {
        "mine.mcap.part.damaged",
        "run-recovered.mcap",
        "run.mcap",
        "run-2.mcap",
        "run-3.mcap",
    }


def test_background_tasks_that_run_after_the_stop_delete_no_more_than_the_limits_require(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a machine does that is busy with other things."""
    late: list[Callable[[], None]] = []
    monkeypatch.setattr(RecordingFiles, "_submit", lambda _self, _name, task: late.append(task))
    fed = recorder(tmp_path / "run.mcap", START, rotate_min=1.0, keep_files=3.0, black_box_min=0.0)
    fed.receive(samples(130), SECOND)
    fed.stop()
    for task in late:
        task()
    assert late
    assert {path.name for path in tmp_path.glob("*.mcap")} == {"run.mcap", "run-2.mcap", "run-3.mcap"}


def raising(folder: Path) -> Fed:
    """A recorder that has heard an alarm and is killed a while after it."""
    fed = recorder(folder, START, black_box_min=0.5)
    fed.receive([*samples(100), alarm("ewma/T"), *samples(10, first=100)], SECOND)
    fed.pass_time(SECOND)  # the last of it is flushed
    fed.kill()
    return fed


def boxed(folder: Path) -> list[list[int]]:
    """The numbers of the samples in each file of the black box."""
    return [sequences(path) for path in sorted((folder / "black-box").glob("*.mcap"))]


def test_a_segment_under_way_when_the_recorder_is_killed_resumes_with_the_next_start(tmp_path: Path) -> None:
    before = raising(tmp_path)
    fed = recorder(tmp_path, before.now_ns + SECOND, black_box_min=0.5)
    fed.receive(samples(100, first=110), SECOND)
    fed.stop()
    (kept,) = boxed(tmp_path)
    assert kept == list(range(70, 128))  # half a minute around the alarm, two seconds of which passed in between


def test_a_stretch_that_was_over_while_no_recorder_ran_is_kept_by_the_next_start(tmp_path: Path) -> None:
    before = raising(tmp_path)
    recorder(tmp_path, before.now_ns + 2 * MINUTE, black_box_min=0.5).stop()
    assert boxed(tmp_path) == [list(range(70, 110))]


def test_a_copy_of_a_segment_that_a_kill_left_half_made_is_made_again_and_no_segment_twice(tmp_path: Path) -> None:
    before = raising(tmp_path)
    (tmp_path / "black-box").mkdir()
    (tmp_path / "black-box" / f".{tmp_path.name}.tmp").touch()  # of somebody else
    half = tmp_path / "black-box" / ".cstr-20260101T000000Z-ewma-T.mcap.1.tmp.part"
    half.write_bytes(b"x")
    recorder(tmp_path, before.now_ns + 2 * MINUTE, black_box_min=0.5).stop()
    assert not half.exists()
    for _ in range(2):
        recorder(tmp_path, before.now_ns + 2 * MINUTE, black_box_min=0.5).stop()
    assert boxed(tmp_path) == [list(range(70, 110))]


def test_what_cannot_be_recovered_is_kept_and_not_looked_at_again(tmp_path: Path) -> None:
    (tmp_path / "run.mcap.part").write_bytes(b"\0" * 100)
    recorder(tmp_path / "run.mcap", START).stop()
    assert (tmp_path / "run.mcap.part.damaged").read_bytes() == b"\0" * 100
    assert not list(tmp_path.glob("*.part"))


def test_a_file_left_behind_before_anything_was_in_it_is_deleted(tmp_path: Path) -> None:
    recorder(tmp_path / "run.mcap", START).kill()
    assert (tmp_path / "run.mcap.part").exists()
    fed = recorder(tmp_path / "run.mcap", START + MINUTE)
    fed.stop()
    assert not list(tmp_path.glob("*.part*"))


def test_of_a_file_left_behind_with_a_damaged_chunk_the_original_is_kept(tmp_path: Path) -> None:
    killed(tmp_path / "run.mcap", 100)
    part = tmp_path / "run.mcap.part"
    content = part.read_bytes()
    at = content.index(b"\x28\xb5\x2f\xfd", len(content) // 2)
    part.write_bytes(content[:at] + bytes(30) + content[at + 30 :])
    recorder(tmp_path / "run.mcap", START).stop()
    assert (tmp_path / "run.mcap.part.damaged").exists()
    assert of_others(tmp_path / "run.mcap")


def test_a_file_that_another_recorder_writes_is_left_alone(tmp_path: Path) -> None:
    fed = recorder(tmp_path / "run.mcap", START)
    with pytest.raises(InputError, match="is being written by another recorder"):
        recorder(tmp_path / "run.mcap", START)
    fed.stop()
    beside = recorder(tmp_path, START)
    other = recorder(tmp_path, START)
    beside.receive(samples(10), SECOND)
    other.receive(samples(10), SECOND)
    beside.stop()
    other.stop()
    assert len(list(tmp_path.glob("cstr-*.mcap"))) == 2


def test_a_copy_that_a_kill_left_half_made_is_removed(tmp_path: Path) -> None:
    (tmp_path / f".run.mcap.{os.getpid()}.tmp.part").write_bytes(b"x")
    recorder(tmp_path / "run.mcap", START).stop()
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


RUN = AlarmInterval(START, START + SECOND, START, "ewma/T")


def received(count: int) -> list[ReceivedMessage]:
    """Samples as they come to the files."""
    core, found = Recorder("cstr", 0), list[ReceivedMessage]()
    for number, item in enumerate(samples(count)):
        message = core.on_message(encode(item), START + number * SECOND)
        assert message is not None
        found.append(message)
    return found


def files(folder: Path, name: str = "run.mcap", **settings: object) -> RecordingFiles:
    """The files of a recorder."""
    config = RecorderConfig(out=str(folder / name), **settings)  # type: ignore[arg-type]
    return RecordingFiles(config, read_clock=Confirmed(0).read)


def test_a_file_is_as_old_as_its_last_message_and_has_a_size_while_it_is_written(tmp_path: Path) -> None:
    written = files(tmp_path)
    assert (written.path, written.size_bytes, written.abandon()) == (None, 0, 0)
    with written:
        path = written.start_file([], START)
        assert (written.path, written.size_bytes > 0) == (path, True)
        for message in received(3):
            written.write(message)
        started_bytes = written.size_bytes
        written.flush()
        assert written.size_bytes > started_bytes
    assert (written.path, written.size_bytes) == (None, 0)
    assert path.stat().st_mtime_ns == START + 2 * SECOND
    written.complete()
    assert [stored.sequence for stored in Reader(path)] == [0, 1, 2]


def test_black_boxes_of_one_alarm_and_second_are_numbered(tmp_path: Path) -> None:
    with files(tmp_path) as written:
        written.start_file([], START)
        written.write(received(1)[0])
        written.flush()
        for _ in range(3):
            written.save_black_box(RUN)
    names = sorted((path.name for path in (tmp_path / "black-box").iterdir()), key=len)
    moment = names[0].removeprefix("run-").removesuffix("-ewma-T.mcap")
    assert len(moment) == len("20260101T000000Z")
    assert sorted(names) == sorted(f"run-{moment}-ewma-T{end}.mcap" for end in ("", "-2", "-3"))


def test_work_in_the_background_is_done_in_its_order_though_some_of_it_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    done = list[str]()

    def fail_first(part: Path) -> None:
        done.append(part.name)
        if len(done) == 1:
            raise InputError("there is no file")

    monkeypatch.setattr("recorder.recording_files.repair", fail_first)
    for number in range(3):
        (tmp_path / f"run-{number + 2}.mcap.part").write_bytes(b"x")
    with files(tmp_path) as written:
        written.start_file([], START)
    assert done == [f"run-{number + 2}.mcap.part" for number in range(3)]
    assert f"recovering {tmp_path / done[0]} failed" in capsys.readouterr().out


def test_the_free_space_of_a_folder_that_does_not_exist_is_that_of_its_parent(tmp_path: Path) -> None:
    assert free_bytes(tmp_path / "none" / "deeper") > 0


def test_a_folder_that_does_not_exist_is_made_and_none_of_the_name_of_a_table(tmp_path: Path) -> None:
    files(tmp_path, "new")
    assert (tmp_path / "new").is_dir()
    with pytest.raises(InputError, match="does not exist"):
        files(tmp_path, "run.csv")
    assert not (tmp_path / "run.csv").exists()
