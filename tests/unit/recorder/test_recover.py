"""Recovery of a damaged recording: all before the damage, all after it, and never a wrong message."""

import io
import struct
from collections import Counter
from pathlib import Path

import pytest
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.writer import CompressionType, Writer
from mcap_protobuf.decoder import DecoderFactory

from reactorwatch.errors import InputError
from recorder import RecordedMessage, StoredMessage
from recorder.files.copies import RecoveryResult, recover
from recorder.files.reader import Reader, metadata_records
from recorder.files.recording import Recording
from recorder.files.writer import RecordingWriter
from tests.unit.recorder import golden

ENTRIES = list(golden.entries())[:90]
CHUNK = 30


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A recording of three chunks."""
    path = tmp_path_factory.mktemp("whole") / "run.mcap"
    with RecordingWriter(path, {"plant": "cstr", "seed": "3"}) as writer:
        for number, entry in enumerate(ENTRIES, start=1):
            writer.write(entry)
            if number % CHUNK == 0:
                writer.flush()
    return path.read_bytes()


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


def test_without_its_index_nothing_is_missing(tmp_path: Path, whole: bytes) -> None:
    summary = next(end for opcode, _, end in records(whole) if opcode == Opcode.DATA_END)
    kept, saved = recovered(tmp_path, whole[:summary])
    assert kept == ENTRIES
    assert saved.messages == len(ENTRIES)


def test_saved_messages_are_reported_by_topic_and_time(tmp_path: Path, whole: bytes) -> None:
    _, saved = recovered(tmp_path, whole[: chunks(whole)[2][0]])
    assert saved.topics == Counter(entry.key for entry in ENTRIES[: 2 * CHUNK])
    assert (saved.first_ns, saved.last_ns) == (ENTRIES[0].log_time_ns, ENTRIES[2 * CHUNK - 1].log_time_ns)


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


def test_other_software_reads_what_was_recovered(tmp_path: Path, whole: bytes) -> None:
    recovered(tmp_path, whole[: chunks(whole)[1][1]])
    with (tmp_path / "out.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert len(list(reader.iter_decoded_messages())) == 2 * CHUNK


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


def test_messages_without_a_description_of_their_channel_are_counted(tmp_path: Path, whole: bytes) -> None:
    """A file of another program, which describes its channels in the first chunk alone; that chunk is damaged."""
    path = tmp_path / "other.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channels = [writer.register_channel(f"/{name}", "json", 0) for name in "ab"]
        for number in range(20):
            writer.add_message(channels[0], number, b"{}", number)
        writer.flush()  # type: ignore[no-untyped-call]
        channels.append(writer.register_channel("/c", "json", 0))
        for number in range(20, 40):
            writer.add_message(channels[number % 2 * 2], number, b"{}", number)
        writer.flush()  # type: ignore[no-untyped-call]
    content = path.read_bytes()
    start, end = chunks(content)[0]
    path.write_bytes(content[: end - 10] + bytes(10) + content[end:])
    saved = recover(path, tmp_path / "out.mcap")
    assert (saved.topics, saved.orphans) == ({"/c": 10}, 10)
    assert "10 messages of channels that are described nowhere" in saved.losses
    assert Chunk.read(ReadDataStream(io.BytesIO(content[start + 9 : end]))).message_end_time == 19


def test_a_pass_over_a_stretch_of_time_reads_only_the_chunks_in_it(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "run.mcap"
    _, end = chunks(whole)[0]
    path.write_bytes(whole[: end - 10] + bytes(10) + whole[end:])
    reader = Reader(path, ENTRIES[CHUNK].log_time_ns, ENTRIES[2 * CHUNK - 1].log_time_ns)
    found: list[StoredMessage] = list(reader)
    assert [stored.payload for stored in found] == [entry.payload for entry in ENTRIES[CHUNK : 2 * CHUNK]]
    assert not reader.damages
