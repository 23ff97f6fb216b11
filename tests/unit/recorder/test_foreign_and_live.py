"""Recordings of other programs are described, and a folder with only a file that is being recorded is read."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import pytest
from mcap.writer import Writer

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.api.files import expand_folder
from reactorwatch.contract import keys
from reactorwatch.contract.codec import encode
from reactorwatch.errors import InputError
from recorder import RecordedMessage
from recorder.config import ReplayConfig
from recorder.files.metadata import METADATA
from recorder.files.part_file import PART
from recorder.files.reader import read_start
from recorder.files.recording import Recording
from recorder.files.writer import RecordingWriter
from recorder.tools.convert import read_record
from recorder.tools.inspect import inspect
from recorder.tools.player import samples_of
from recorder.tools.replay import open_tape

from .recording import MINUTE, SECOND, recorder


def write_json(stream: BinaryIO) -> None:
    writer = Writer(stream)
    writer.start(profile="", library="a logger 1.2")
    schema = writer.register_schema("Level", "jsonschema", b"{}")
    channel = writer.register_channel("/tank/level", "json", schema)
    writer.add_message(channel, 1, json.dumps({"level": 1.0}).encode(), 1)
    writer.add_attachment(1, 1, "notes.txt", "text/plain", b"hello")
    writer.finish()  # type: ignore[no-untyped-call]


def write_ros(stream: BinaryIO) -> None:
    writer = Writer(stream)
    writer.start(profile="ros2", library="libmcap 1.4")
    schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data")
    channel = writer.register_channel("/tank/level", "cdr", schema)
    writer.add_message(channel, 1, bytes(12), 1)
    writer.finish()  # type: ignore[no-untyped-call]


FOREIGN = {
    "json": (write_json, "", "a logger 1.2", "json", ("notes.txt",)),
    "ros 2": (write_ros, "ros2", "libmcap 1.4", "cdr", ()),
}
START_NS = 1_700_000_000 * SECOND
Write = Callable[[BinaryIO], None]


@pytest.mark.parametrize(("write", "profile", "library", "encoding", "attachments"), FOREIGN.values(), ids=FOREIGN)
def test_a_recording_of_another_program_is_described_and_what_it_lacks_is_named(
    write: Write, profile: str, library: str, encoding: str, attachments: tuple[str, ...], tmp_path: Path
) -> None:
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as stream:
        write(stream)
    seen = inspect(path)
    assert (seen.profile, seen.library, seen.attachments) == (profile, library, attachments)
    assert seen.metadata == {}
    with pytest.raises(InputError) as caught:
        read_record(path)
    text = str(caught.value)
    assert text.count("\n") == 0
    for part in ("another program wrote it", f"'/tank/level' ({encoding})", "reactorwatch.v1.Sample", "sample/SIGNAL"):
        assert part in text


def test_a_folder_with_only_a_live_file_is_read_and_reported_as_live(tmp_path: Path) -> None:
    record = simulate_record(PlantConfig(seed=1), 100)
    fed = recorder(tmp_path, START_NS)
    fed.receive(samples_of(record, "cstr", START_NS), 2 * SECOND)
    fed.pass_time(MINUTE)
    (part,) = tmp_path.glob(f"*{PART}")
    assert not list(tmp_path.glob("*.mcap"))
    found = read_record(tmp_path)
    assert found.rows == 100
    assert found.columns["T"] == pytest.approx(record.columns["T"], rel=0, abs=0)
    assert f"{part.name}, which is still being recorded" in found.read_as
    assert inspect(tmp_path).live == part.name
    assert Recording(tmp_path).metadata["plant"] == "cstr"
    assert expand_folder(tmp_path) == [tmp_path]
    fed.kill()
    with pytest.raises(InputError, match=rf"holds no recording .*{part.name} is left of a recorder that was killed"):
        read_record(tmp_path)


def test_a_live_file_that_is_completed_while_it_is_read_is_read_to_its_end(tmp_path: Path) -> None:
    fed = recorder(tmp_path, START_NS)
    fed.receive(samples_of(simulate_record(PlantConfig(seed=1), 20), "cstr", START_NS), 2 * SECOND)
    fed.pass_time(MINUTE)
    recording = Recording(tmp_path)
    begun = len(list(recording.messages({keys.SAMPLE})))
    fed.stop()
    assert not list(tmp_path.glob(f"*{PART}"))
    assert len(list(recording.messages({keys.SAMPLE}))) == begun > 0
    assert recording.plants == ("cstr",)
    assert recording.metadata["plant"] == "cstr"
    assert METADATA in {record.name for record in recording.metadata_records}
    assert read_start(recording.files[0]).library
    (completed,) = tmp_path.glob("*.mcap")
    completed.unlink()
    with pytest.raises(InputError, match="there is no such file"):
        list(recording.messages())


def test_each_pass_of_a_loop_plays_the_files_that_the_folder_holds_then(tmp_path: Path) -> None:
    publications = list(samples_of(simulate_record(PlantConfig(seed=1), 30), "cstr", START_NS))
    third = len(publications) // 3

    def write(number: int) -> Path:
        path = tmp_path / f"cstr-{number}.mcap"
        with RecordingWriter(path, {"plant": "cstr"}) as writer:
            for item in publications[number * third : (number + 1) * third]:
                time_ns = item.message.time_ns
                writer.write(RecordedMessage(*encode(item)[:3], time_ns, time_ns))
        return path

    oldest, _ = write(0), write(1)
    _, tape = open_tape(ReplayConfig(file=str(tmp_path), loop=True))
    assert list(tape()) == publications[: 2 * third]
    oldest.unlink()
    write(2)
    assert list(tape()) == publications[third : 3 * third]
