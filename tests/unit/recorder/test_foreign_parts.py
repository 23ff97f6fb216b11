"""Recordings of other programs keep their profile, their metadata and their attachments when they are copied."""

from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from reactorwatch.contract.codec import Publication, encode
from reactorwatch.contract.messages_pb2 import QUALITY_GOOD, Sample
from recorder.files.copies import Window, cut, recover
from recorder.files.index import LATEST_NS

MINUTE_NS = 60 * 10**9
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
            time_ns = 10**18 + (10 * minute + row) * MINUTE_NS
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


def whole(notes: str = "") -> Parts:
    metadata = {"calibration": CALIBRATION, **({"notes": {"text": notes}} if notes else {})}
    return "ros2", metadata, {"plant.png": PICTURE}, 1


def test_a_cut_keeps_them(tmp_path: Path) -> None:
    source = foreign(tmp_path / "a.mcap", notes="a")
    cut([source], tmp_path / "new.mcap", Window((0, LATEST_NS)), {})
    assert parts(tmp_path / "new.mcap") == whole("a") == parts(source)


def test_a_cut_of_two_recordings_keeps_them_and_writes_equal_ones_once(tmp_path: Path) -> None:
    sources = [foreign(tmp_path / "a.mcap"), foreign(tmp_path / "b.mcap", minute=1, notes="b")]
    cut(sources, tmp_path / "new.mcap", Window((0, LATEST_NS)), {})
    assert parts(tmp_path / "new.mcap") == whole("b")


def test_of_several_profiles_none_is_kept(tmp_path: Path) -> None:
    cut(
        [foreign(tmp_path / "a.mcap"), foreign(tmp_path / "b.mcap", "x", 1)],
        tmp_path / "new.mcap",
        Window((0, 2**63 - 1)),
        {},
    )
    assert parts(tmp_path / "new.mcap")[0] == ""


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
