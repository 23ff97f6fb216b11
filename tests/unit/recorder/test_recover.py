"""Recovery of a damaged recording of any program: all before the damage, all after it, and never a wrong message."""

import struct
from collections import Counter
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from reactorwatch.contract.codec import Publication, encode
from reactorwatch.contract.messages_pb2 import QUALITY_GOOD, Sample
from reactorwatch.errors import InputError
from recorder import RecordedMessage
from recorder.files.copies import RecoveryResult, Window, cut, recover
from recorder.files.index import LATEST_NS
from recorder.files.reader import Damage, metadata_records
from recorder.files.recording import Recording
from tests.unit.recorder import golden
from tests.unit.recorder.recording import MINUTE, recorded

ENTRIES = list(golden.entries())[:90]
CHUNK = 30


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A recording of three chunks."""
    path = tmp_path_factory.mktemp("whole") / "run.mcap"
    return recorded(path, ENTRIES, CHUNK, {"plant": "cstr", "seed": "3"}).read_bytes()


def records(content: bytes) -> list[tuple[int, int, int]]:
    """(opcode, start, end) of each record, walked by the specification and not by the code under test."""
    found, at = [], 8
    while at < len(content) - 8:
        opcode, length = struct.unpack_from("<BQ", content, at)
        found.append((opcode, at, at + 9 + length))
        at += 9 + length
    return found


def chunks(content: bytes) -> list[tuple[int, int]]:
    return [(start, end) for opcode, start, end in records(content) if opcode == Opcode.CHUNK]


def recovered(folder: Path, content: bytes) -> tuple[list[RecordedMessage], RecoveryResult]:
    """What is in the recovered file, read as any whole file is."""
    damaged, out = folder / "damaged.mcap", folder / "out.mcap"
    damaged.write_bytes(content)
    saved = recover(damaged, out)
    assert damaged.read_bytes() == content
    assert sorted(path.name for path in folder.iterdir()) == ["damaged.mcap", "out.mcap"]
    return list(Recording(out).messages()), saved


def expected_of_a_cut(content: bytes, length: int) -> list[RecordedMessage]:
    """The messages of the chunks that end before the cut."""
    return ENTRIES[: CHUNK * sum(end <= length for _, end in chunks(content))]


def test_a_file_cut_off_anywhere_keeps_every_chunk_that_is_whole(tmp_path: Path, whole: bytes) -> None:
    """At every byte around the edges of records, and at some within them."""
    edges = {edge + near for _, start, end in records(whole) for edge in (start, end) for near in (-1, 0, 1, 20)}
    for length in sorted({*edges, *range(9, len(whole), 397)}):
        if not 8 < length < len(whole):
            continue
        expected = expected_of_a_cut(whole, length)
        if expected:
            kept, saved = recovered(tmp_path, whole[:length])
            assert kept == expected, length
            assert saved.is_only_truncated, length
            assert "cut off" in saved.losses
            (tmp_path / "out.mcap").unlink()
        else:
            (tmp_path / "damaged.mcap").write_bytes(whole[:length])
            with pytest.raises(InputError, match="holds no message that could be saved"):
                recover(tmp_path / "damaged.mcap", tmp_path / "out.mcap")
            assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("number", [0, 1, 2])
@pytest.mark.parametrize("ending", ["whole", "cut off"])
def test_a_damaged_chunk_is_passed_over_and_all_others_are_kept(
    tmp_path: Path, whole: bytes, number: int, ending: str
) -> None:
    """The first one too, in which the channels of all others are described."""
    start, end = chunks(whole)[number]
    middle = (start + end) // 2
    content = whole[:middle] + bytes(40) + whole[middle + 40 :]
    if ending == "cut off":
        content = content[: next(start for opcode, start, _ in records(whole) if opcode == Opcode.DATA_END)]
    kept, saved = recovered(tmp_path, content)
    assert kept == ENTRIES[: number * CHUNK] + ENTRIES[(number + 1) * CHUNK :]
    assert f"a chunk of {end - start} bytes" in saved.losses
    assert f"at byte {start}" in saved.losses
    assert not saved.orphans


def test_a_length_that_is_damaged_costs_its_chunk_and_no_more(tmp_path: Path, whole: bytes) -> None:
    start, _ = chunks(whole)[1]
    for wrong in (0, 3, 500, 2**40):
        kept, saved = recovered(tmp_path, whole[: start + 1] + struct.pack("<Q", wrong) + whole[start + 9 :])
        assert kept == ENTRIES[:CHUNK] + ENTRIES[2 * CHUNK :]
        assert not saved.is_only_truncated
        (tmp_path / "out.mcap").unlink()


def test_a_byte_that_is_wrong_costs_one_chunk_at_most_and_no_message_is_altered(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "damaged.mcap"
    out = tmp_path / "out.mcap"
    read_segments = [ENTRIES[at : at + CHUNK] for at in range(0, len(ENTRIES), CHUNK)]
    may_be_left = [[entry for other in read_segments if other is not lost for entry in other] for lost in read_segments]
    for place in range(0, len(whole), 61):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        saved = recover(path, out)
        kept = list(Recording(out).messages())
        assert kept == ENTRIES or (kept in may_be_left and saved.losses), place


def test_a_recovered_file_states_its_origin_and_what_is_missing(tmp_path: Path, whole: bytes) -> None:
    recovered(tmp_path, whole[:-1])
    metadata = Recording(tmp_path / "out.mcap").metadata
    assert (metadata["plant"], metadata["seed"]) == ("cstr", "3")
    said = {record.name: record.metadata for record in metadata_records(tmp_path / "out.mcap")}
    assert said["recovered"]["from"] == "damaged.mcap"
    assert "at byte" in said["recovered"]["lost"]


def test_a_whole_file_is_recovered_to_the_same_messages(tmp_path: Path, whole: bytes) -> None:
    kept, saved = recovered(tmp_path, whole)
    assert kept == ENTRIES
    assert saved.losses == ""


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "expected an MCAP recording, got an empty file"),
        (b"time_min,qc,C,T\n0,1,2,3\n", "expected an MCAP recording, got another kind of file"),
        (b"PK\x03\x04" + bytes(1000), "expected an MCAP recording, got another kind of file"),
        (b"zstd" * 100, "expected an MCAP recording, got another kind of file"),
        (b"\x89MCAP0\r\n", "holds no message that could be saved"),
        (b"\x89MCAP0\r\n" + bytes(1000), "holds no message that could be saved"),
    ],
)
def test_where_nothing_can_be_saved_one_line_reports_it_and_nothing_is_written(
    tmp_path: Path, content: bytes, said: str
) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError, match=said):
        recover(path, tmp_path / "out.mcap")
    assert list(tmp_path.iterdir()) == [path]


def test_the_damaged_file_is_never_written_over(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(whole[:-1])
    with pytest.raises(InputError, match="is one of the files that are read"):
        recover(path, path)


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("compression", list(CompressionType))
def test_files_of_other_programs_are_recovered_with_their_schemas_and_metadata(
    tmp_path: Path, chunked: bool, compression: CompressionType
) -> None:
    if compression == CompressionType.LZ4:
        pytest.importorskip("lz4", reason="the library reads lz4 only where that is installed")
    path, out = tmp_path / "ros.mcap", tmp_path / "out.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression, use_chunking=chunked)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/String", "ros2msg", b"string data")
        channel = writer.register_channel("/chatter", "cdr", schema, {"offered_qos_profiles": "1"})
        for number in range(50):
            writer.add_message(channel, 10 + number, bytes([number]) * 8, 5 + number, sequence=number)
        writer.add_metadata("rosbag2", {"ROS_DISTRO": "jazzy"})
        writer.add_message(channel, 99, b"last", 99, sequence=50)
        stream.flush()
        cut = path.stat().st_size
        writer.finish()  # type: ignore[no-untyped-call]
    content = path.read_bytes()
    path.write_bytes(content[: records(content)[-3][1]] if chunked else content[: cut + 20])
    recover(path, out)
    with out.open("rb") as stream:
        reader = make_reader(stream)
        found = [
            (schema and (schema.name, schema.data), channel.topic, channel.metadata, message.sequence, message.data)
            for schema, channel, message in reader.iter_messages()
        ]
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    described = (("std_msgs/String", b"string data"), "/chatter", {"offered_qos_profiles": "1"})
    assert found[:50] == [(*described, number, bytes([number]) * 8) for number in range(50)]
    assert metadata["rosbag2"] == {"ROS_DISTRO": "jazzy"}


def test_the_losses_of_a_recovery_are_named_up_to_five_places() -> None:
    damages = tuple(Damage(at, "a chunk") for at in range(7))
    assert RecoveryResult(1, 1, 1, {}, (), 0).losses == ""
    assert RecoveryResult(1, 1, 1, {}, damages[:2], 3).losses == (
        "a chunk at byte 0; a chunk at byte 1; 3 messages of channels that are described nowhere"
    )
    assert "more places" not in RecoveryResult(1, 1, 1, {}, damages[:5], 0).losses
    assert RecoveryResult(1, 1, 1, {}, damages, 0).losses.endswith("a chunk at byte 4; 2 more places")


def test_a_recovery_that_lost_nothing_but_the_end_is_only_truncated() -> None:
    end, chunk = Damage(9, "cut off", is_end=True), Damage(3, "a chunk")
    for damages, orphans, expected in (
        ((), 0, True), ((end,), 0, True), ((chunk, end), 0, False), ((end,), 1, False),
    ):  # fmt: skip
        assert RecoveryResult(1, 1, 1, {}, damages, orphans).is_only_truncated is expected


def test_a_recovery_counts_topics_and_times_and_dates_the_file_by_its_last_message(tmp_path: Path) -> None:
    source, out = recorded(tmp_path / "run.mcap", ENTRIES[:50]), tmp_path / "out.mcap"
    saved = recover(source, out)
    times = [entry.log_time_ns for entry in ENTRIES[:50]]
    assert (saved.messages, saved.first_ns, saved.last_ns) == (50, times[0], times[-1])
    assert saved.topics == Counter(entry.key for entry in ENTRIES[:50])
    assert out.stat().st_mtime_ns == times[-1]
    assert [record.name for record in metadata_records(out)] == ["reactorwatch"]


CALIBRATION = {"sensor": "T", "offset": "0.2"}
PICTURE = b"\x89PNG" + bytes(100_000)

Parts = tuple[str, dict[str, dict[str, str]], dict[str, bytes], int]


def foreign(path: Path, profile: str = "ros2", minute: int = 0, notes: str = "") -> Path:
    """A recording as another program writes it."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile=profile, library="another program")
        writer.add_metadata("calibration", CALIBRATION)
        if notes:
            writer.add_metadata("notes", {"text": notes})
        channel = writer.register_channel("reactor/cstr/sample/T", "protobuf", 0)
        for row in range(10):
            time_ns = 10**18 + (10 * minute + row) * MINUTE
            body = encode(
                Publication("reactor/cstr/sample/T", Sample(time_ns=time_ns, value=440.0, quality=QUALITY_GOOD))
            )
            writer.add_message(channel, time_ns, body.payload, time_ns)
        writer.add_attachment(10**18, 10**18, "plant.png", "image/png", PICTURE)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def parts(path: Path) -> Parts:
    """The profile, the metadata of others, the attachments of a file, and how many of them its statistics say."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        profile, statistics = reader.get_header().profile, reader.get_summary().statistics  # type: ignore[union-attr]
        assert statistics is not None
        metadata = {item.name: item.metadata for item in reader.iter_metadata() if item.name != "reactorwatch"}
        attachments = {item.name: item.data for item in reader.iter_attachments()}
    return profile, metadata, attachments, statistics.attachment_count


def all_parts(notes: str = "") -> Parts:
    metadata = {"calibration": CALIBRATION, **({"notes": {"text": notes}} if notes else {})}
    return "ros2", metadata, {"plant.png": PICTURE}, 1


def test_a_cut_keeps_them_equal_ones_once_and_of_several_profiles_none(
    tmp_path: Path,
) -> None:
    source, new, always = foreign(tmp_path / "a.mcap", notes="a"), tmp_path / "new.mcap", Window((0, LATEST_NS))
    cut([source], new, always, {})
    assert parts(new) == all_parts("a") == parts(source)
    cut([foreign(tmp_path / "c.mcap"), foreign(tmp_path / "b.mcap", minute=1, notes="b")], new, always, {})
    assert parts(new) == all_parts("b")
    cut([source, foreign(tmp_path / "d.mcap", "x", 1)], new, always, {})
    assert parts(new)[0] == ""


@pytest.mark.parametrize("cut_off", [0, 1, 50])
def test_a_recovery_keeps_them(tmp_path: Path, cut_off: int) -> None:
    source = foreign(tmp_path / "a.mcap")
    content = source.read_bytes()
    source.write_bytes(content[: len(content) - cut_off])
    recover(source, tmp_path / "new.mcap")
    profile, metadata, attachments, count = parts(tmp_path / "new.mcap")
    assert (profile, metadata["calibration"], attachments, count) == ("ros2", CALIBRATION, {"plant.png": PICTURE}, 1)
    assert ("recovered" in metadata) == bool(cut_off)


def test_a_damaged_attachment_is_reported_and_left_out(tmp_path: Path) -> None:
    source = foreign(tmp_path / "a.mcap")
    content = bytearray(source.read_bytes())
    content[content.index(PICTURE) + 50_000] ^= 1
    source.write_bytes(content)
    saved = recover(source, tmp_path / "new.mcap")
    assert "an attachment" in saved.losses
    assert parts(tmp_path / "new.mcap")[2:] == ({}, 0)
