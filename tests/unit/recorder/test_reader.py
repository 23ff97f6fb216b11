"""One pass over a file: its messages in order, and its damage by the byte and the kind."""

from pathlib import Path

import pytest
from mcap.records import Channel, Chunk, Metadata

from reactorwatch.errors import InputError
from recorder.files.index import LATEST_NS
from recorder.files.reader import Damage, Reader, read_start
from tests.unit.recorder.mcap_bytes import DESCRIBED, KEY, bytes_of, chunk, message, recording

FIRST = chunk(DESCRIBED + message(1) + message(4), first_ns=1, last_ns=4)
SECOND = chunk(message(5) + message(9), first_ns=5, last_ns=9)
WHOLE = recording([FIRST, SECOND])
HEADER_END = 8 + 9 + 8
FIRST_END = HEADER_END + len(bytes_of(FIRST))


def read(path: Path, content: bytes, *, tolerant: bool = True) -> tuple[list[int], list[str]]:
    """Numbers of the messages, and damages."""
    path.write_bytes(content)
    reader = Reader(path, tolerant=tolerant)
    return [stored.sequence for stored in reader], [str(damage) for damage in reader.damages]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


def test_a_file_whose_beginning_is_damaged_is_read_from_its_first_chunk(path: Path) -> None:
    for first, last in ((0, 1), (3, 4), (0, 20)):
        content = WHOLE[:first] + b"?" * (last - first) + WHOLE[last:]
        assert read(path, content) == ([1, 4, 5, 9], ["the beginning cannot be read at byte 0"])
    with pytest.raises(InputError, match="got another kind of file"):
        read(path, b"?" + WHOLE[1:], tolerant=False)


def test_a_file_without_any_chunk_is_of_another_kind_unless_it_is_the_start_of_one(path: Path) -> None:
    with pytest.raises(InputError, match="got another kind of file"):
        read(path, b"time_min,T\n0,1\n" * 9)
    with pytest.raises(InputError, match="got an empty file"):
        read(path, b"")
    for length in (1, 7):
        messages, (first, *_) = read(path, WHOLE[:length])
        assert (messages, first) == ([], "the beginning cannot be read at byte 0")


@pytest.mark.parametrize(
    ("from_ns", "to_ns", "expected"),
    [
        (0, LATEST_NS, [1, 4, 5, 9]),
        (4, LATEST_NS, [1, 4, 5, 9]),
        (5, LATEST_NS, [5, 9]),
        (9, LATEST_NS, [5, 9]),
        (10, LATEST_NS, []),
        (0, 5, [1, 4, 5, 9]),
        (0, 4, [1, 4]),
        (0, 1, [1, 4]),
        (0, 0, []),
    ],
)
def test_chunks_that_are_entirely_outside_of_the_time_are_skipped(
    path: Path, from_ns: int, to_ns: int, expected: list[int]
) -> None:
    path.write_bytes(WHOLE)
    assert [stored.sequence for stored in Reader(path, from_ns, to_ns)] == expected
    assert [stored.sequence for stored in Reader(path, from_ns, to_ns).in_order()] == expected


def test_only_wanted_topics_are_read(path: Path) -> None:
    other = bytes_of(Channel(id=2, topic="other", message_encoding="x", metadata={}, schema_id=0))
    second = message(7).replace(b"\x01\x00", b"\x02\x00", 1)
    path.write_bytes(recording([chunk(DESCRIBED + other + message(1) + second + message(2))], indexed=False))
    for wanted, expected in (
        (None, [(KEY, 1), ("other", 7), (KEY, 2)]),
        (lambda topic: topic == KEY, [(KEY, 1), (KEY, 2)]),
        (lambda topic: topic == "other", [("other", 7)]),
    ):
        found = [(stored.channel.key, stored.sequence) for stored in Reader(path, wanted=wanted)]
        assert found == expected


def test_messages_that_overlap_between_chunks_are_read_in_the_order_of_receipt(path: Path) -> None:
    chunks = [
        chunk(DESCRIBED + message(1) + message(6) + message(9), first_ns=1, last_ns=9),
        chunk(message(3) + message(5), first_ns=3, last_ns=5),
        chunk(message(7) + message(2), first_ns=2, last_ns=7),
    ]
    for indexed in (True, False):
        path.write_bytes(recording(chunks, indexed=indexed))
        assert [stored.log_time_ns for stored in Reader(path).in_order()] == [1, 2, 3, 5, 6, 7, 9]
    assert [stored.log_time_ns for stored in Reader(path)] == [1, 6, 9, 3, 5, 7, 2]


def test_a_damaged_chunk_is_named_by_its_byte_and_the_others_are_read(path: Path) -> None:
    at = HEADER_END + 60
    content = WHOLE[:at] + bytes((WHOLE[at] ^ 255,)) + WHOLE[at + 1 :]
    messages, (damage,) = read(path, content)
    assert messages == [5, 9]
    assert damage.startswith(f"a chunk of {FIRST_END - HEADER_END} bytes (")
    assert damage.endswith(f") at byte {HEADER_END}")
    with pytest.raises(InputError, match=f"the chunk at byte {HEADER_END} cannot be read"):
        list(Reader(path))


@pytest.mark.parametrize("lost", [1, 20, 37])
def test_a_file_without_its_end_is_cut_off_there(path: Path, lost: int) -> None:
    path.write_bytes(WHOLE[:-lost])
    reader = Reader(path, tolerant=True)
    assert [stored.sequence for stored in reader] == [1, 4, 5, 9]
    assert [damage.is_end for damage in reader.damages] == [True]
    assert str(reader.damages[0]).startswith("cut off")
    assert str(reader.damages[0]).endswith(f" at byte {len(WHOLE) - lost}")


def test_an_unfinished_record_at_the_end_is_counted_in_bytes(path: Path) -> None:
    path.write_bytes(WHOLE[: FIRST_END + 30])
    reader = Reader(path, tolerant=True)
    assert [stored.sequence for stored in reader] == [1, 4]
    assert reader.damages == [Damage(FIRST_END + 30, "cut off, after 30 bytes of an unfinished record,", is_end=True)]
    path.write_bytes(WHOLE[:FIRST_END])
    reader = Reader(path, tolerant=True)
    assert ([stored.sequence for stored in reader], reader.damages) == ([1, 4], [Damage(FIRST_END, "cut off", True)])


@pytest.mark.parametrize(("kind", "is_private"), [(0x7F, False), (0x80, True), (0xFF, True)])
def test_a_record_of_another_kind_is_damage_unless_it_is_private_to_a_program(
    path: Path, kind: int, *, is_private: bool
) -> None:
    strange = bytes((kind,)) + (3).to_bytes(8, "little") + b"abc"
    content = recording([FIRST, SECOND], indexed=False)
    content = content[:HEADER_END] + strange + content[HEADER_END:]
    assert read(path, content) == ([1, 4, 5, 9], [f"a record of 12 bytes (of no known kind) at byte {HEADER_END}"])
    if is_private:
        assert read(path, content, tolerant=False) == ([1, 4, 5, 9], [])
    else:
        with pytest.raises(InputError, match=f"the record at byte {HEADER_END} cannot be read"):
            read(path, content, tolerant=False)


def test_messages_of_a_channel_that_is_described_nowhere_are_counted(path: Path) -> None:
    content = recording([chunk(message(1) + message(2)), chunk(DESCRIBED + message(3))], indexed=False)
    path.write_bytes(content)
    reader = Reader(path, tolerant=True)
    assert [stored.sequence for stored in reader] == [3]
    assert (reader.orphans, reader.damages) == (2, [])
    with pytest.raises(InputError, match="channel 1 is described nowhere"):
        read(path, content, tolerant=False)


def test_a_description_with_a_checksum_is_not_replaced_by_one_without(path: Path) -> None:
    other = bytes_of(Channel(id=1, topic="other", message_encoding="x", metadata={}, schema_id=0))

    def keys(*records: bytes | Chunk) -> list[str]:
        content = recording([item if isinstance(item, Chunk) else _unverified(item) for item in records], indexed=False)
        path.write_bytes(content)
        return [stored.channel.key for stored in Reader(path)]

    verified = chunk(DESCRIBED + message(1))
    assert keys(verified, other + message(2)) == [KEY, KEY]
    assert keys(other + message(1), verified) == ["other", KEY]
    assert keys(verified, chunk(other + message(2))) == [KEY, "other"]
    assert keys(DESCRIBED + message(1), other + message(2)) == [KEY, "other"]


def _unverified(data: bytes) -> Chunk:
    """A chunk without a checksum."""
    item = chunk(data)
    item.uncompressed_crc = 0
    return item


def test_the_start_of_a_file_has_its_first_metadata_and_its_writer(path: Path) -> None:
    note = bytes_of(Metadata(name="notes", metadata={"text": "a"}))
    late = bytes_of(Metadata(name="late", metadata={}))
    path.write_bytes(WHOLE[:HEADER_END] + note + WHOLE[HEADER_END:FIRST_END] + late + WHOLE[FIRST_END:])
    start = read_start(path)
    assert [record.name for record in start.metadata] == ["notes"]
    reader = Reader(path, tolerant=True)
    assert len(list(reader)) == 4
    assert [record.name for record in reader.metadata] == ["notes", "late"]
    assert (reader.profile, reader.library) == ("", "")


def test_an_index_that_names_a_chunk_where_there_is_none_is_damage(path: Path) -> None:
    claimed = b"".join(number.to_bytes(8, "little") for number in (1, 4, HEADER_END))
    at = WHOLE.rindex(claimed) + 16
    for offset in (HEADER_END + 1, 8):  # within the chunk; the header
        path.write_bytes(WHOLE[:at] + offset.to_bytes(8, "little") + WHOLE[at + 8 :])
        with pytest.raises(InputError, match=f"the index names a chunk where there is none at byte {offset}"):
            list(Reader(path).in_order())


def test_last_bytes_that_are_not_those_of_a_recording_are_damage(path: Path) -> None:
    messages, (damage,) = read(path, WHOLE[:-1] + b"?")
    assert messages == [1, 4, 5, 9]
    assert "the last bytes are not those of a recording" in damage
