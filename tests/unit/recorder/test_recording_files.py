"""Each file of a recorder states where it comes from; work in the background ends in its order, whatever fails."""

import tomllib
from pathlib import Path

import pytest

from reactorwatch.contract.codec import encode
from reactorwatch.errors import InputError
from reactorwatch.runtime.reorder_buffer import Gap
from recorder.config import RecorderConfig
from recorder.core import ReceivedMessage, Recorder
from recorder.files.metadata import gap_metadata, gaps_of, own_metadata, parse_gap, processes_in
from recorder.files.reader import Reader, metadata_records, select_topics
from recorder.keep import AlarmInterval
from recorder.recording_files import BackgroundTasks, RecordingFiles, file_names, free_bytes
from tests.unit.recorder.recording import SECOND, Confirmed
from tests.unit.recorder.test_files import START, samples

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


def test_a_file_names_its_settings_its_place_in_the_run_and_the_file_before_it(tmp_path: Path) -> None:
    with files(tmp_path, about={"case": "7"}) as written:
        paths = [written.start_file([], START + number * SECOND) for number in range(3)]
    assert [path.name for path in paths] == ["run.mcap", "run-2.mcap", "run-3.mcap"]
    found = [own_metadata(metadata_records(path)) for path in paths]
    assert [item["file"] for item in found] == ["1", "2", "3"]
    assert [item.get("after") for item in found] == [None, "run.mcap", "run-2.mcap"]
    assert {item["case"] for item in found} == {"7"}
    assert tomllib.loads(found[0]["configuration"])["out"] == str(tmp_path / "run.mcap")
    assert found[1]["started"].endswith("+00:00")
    assert found[0]["started"] < found[1]["started"]


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


def test_an_abandoned_file_is_recovered_after_the_next_one_is_started(tmp_path: Path) -> None:
    with files(tmp_path) as written:
        first = written.start_file([], START)
        written.write(received(1)[0])
        written.flush()
        assert written.abandon() == 0
        assert not first.exists()
        second = written.start_file([], START + SECOND)
    assert [stored.sequence for stored in Reader(first)] == [0]
    assert second.name == "run-2.mcap"
    assert list(tmp_path.glob("*.part")) == []


def test_the_files_of_a_folder_that_was_deleted_are_written_into_a_new_one(tmp_path: Path) -> None:
    folder = tmp_path / "runs"
    folder.mkdir()
    with files(folder) as written:
        written.start_file([], START)
        written.complete()
        (folder / "run.mcap").unlink()
        for path in folder.iterdir():
            path.unlink()
        folder.rmdir()
        assert written.start_file([], START + SECOND).parent == folder
    assert folder.is_dir()


def test_a_recorder_of_a_name_that_is_taken_is_refused_at_its_start(tmp_path: Path) -> None:
    with files(tmp_path) as written:
        written.start_file([], START)
        with pytest.raises(InputError, match="is being written by another recorder"):
            files(tmp_path)
    with pytest.raises(InputError, match="exists already"):
        files(tmp_path)


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


def test_background_tasks_are_done_in_their_order_though_one_fails(capsys: pytest.CaptureFixture[str]) -> None:
    tasks, done = BackgroundTasks(), list[int]()

    def fail() -> None:
        raise InputError("there is no file")

    for number, task in enumerate((lambda: done.append(1), fail, lambda: done.append(2))):
        tasks.submit(f"task {number}", task)
    tasks.finish()
    assert done == [1, 2]
    assert "task 1 failed" in capsys.readouterr().out
    BackgroundTasks().finish()


def test_the_free_space_of_a_folder_that_does_not_exist_is_that_of_its_parent(tmp_path: Path) -> None:
    assert free_bytes(tmp_path / "none" / "deeper") > 0


@pytest.mark.parametrize(
    ("topic", "expected"),
    [("reactor/cstr/alarm/ewma/T", True), ("reactor/cstr/sample/T", False), ("alarm", False)],
)
def test_the_topic_of_an_alarm_is_known(topic: str, *, expected: bool) -> None:
    assert select_topics({"alarm"})(topic) is expected


def test_a_folder_or_a_file_is_named_by_the_settings(tmp_path: Path) -> None:
    for out, dated in ((tmp_path / "run.mcap", False), (tmp_path, True), (tmp_path / "new", True)):
        assert file_names(RecorderConfig(out=str(out))).dated is dated
    (tmp_path / "folder.mcap").mkdir()
    assert file_names(RecorderConfig(out=str(tmp_path / "folder.mcap"))).dated


def test_gaps_are_read_back_and_records_that_are_none_are_skipped(tmp_path: Path) -> None:
    gap = Gap("reactor/cstr/alarm", 2**64 - 1, 5, 9, 3, 20 * SECOND)
    with files(tmp_path, processes={"*": "cstr"}) as written:
        path = written.start_file([], START)
        written.write_gap(gap)
        for message in received(2):
            written.write(message)
    records = metadata_records(path)
    assert gaps_of(records) == (gap,)
    assert gap_metadata(gap)["publisher"] == "f" * 16
    assert [parse_gap(record) for record in records if record.name != "reactorwatch.gap"] == [None] * (len(records) - 1)
    (process,) = (record for record in records if record.name == "reactorwatch.process")
    assert process.metadata["plant"] == "cstr", "it is described once"
    assert list(processes_in(records)) == ["cstr"]
    process.metadata["signals"] = "none"
    assert processes_in(records) == {}


def test_a_later_description_of_a_plant_is_not_used(tmp_path: Path) -> None:
    with files(tmp_path, processes={"*": "cstr"}) as written:
        path = written.start_file([], START)
        written.write(received(1)[0])
    (record,) = (item for item in metadata_records(path) if item.name == "reactorwatch.process")
    later = type(record)(name=record.name, metadata={**record.metadata, "process": "another"})
    assert processes_in([record, later])["cstr"].name == "cstr"
    assert processes_in([later, record])["cstr"].name == "another"


def test_a_folder_that_does_not_exist_is_made_and_none_of_the_name_of_a_table(tmp_path: Path) -> None:
    files(tmp_path, "new")
    assert (tmp_path / "new").is_dir()
    with pytest.raises(InputError, match="does not exist"):
        files(tmp_path, "run.csv")
    assert not (tmp_path / "run.csv").exists()
