"""The bytes of a recording are those that the MCAP library writes of the same messages."""

import io
import random
from pathlib import Path

import pytest
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Channel, McapRecord, Schema
from mcap.writer import Writer

from recorder.storage import mcap_stream
from recorder.storage.mcap_stream import McapStream

SIGNALS = ("qc", "C", "T")
BEGAN = 1_700_000_000_000_000_000

Sent = list[tuple[int, int, bytes, int, int]]


def sent(count: int) -> Sent:
    """Messages of three channels: channel, log time, payload, publish time, sequence; the times not always in order."""
    draw = random.Random(1)
    return [
        (
            1 + number % 3,
            BEGAN + 1000 * number + draw.randrange(3000),
            draw.randbytes(draw.randrange(60)),
            draw.randrange(2**63),
            number,
        )
        for number in range(count)
    ]


def by_us(messages: Sent, flush_every: int) -> bytes:
    sink = io.BytesIO()
    stream = McapStream(sink)
    stream.start("x 1")
    stream.add_metadata("about", {"plant": "cstr"})
    schema = stream.add_schema("S", "protobuf", b"described")
    for number, signal in enumerate(SIGNALS):
        stream.add_channel(signal, "protobuf", schema if number else 0, {"unit": "K"} if number else {})
    for number, message in enumerate(messages):
        stream.add_message(*message)
        if number % flush_every == flush_every - 1:
            stream.flush()
    stream.add_metadata("gap", {"messages": "3"})
    stream.finish()
    return sink.getvalue()


def by_the_library(messages: Sent, flush_every: int, chunk_bytes: int) -> bytes:
    sink = io.BytesIO()

    def describe(record: McapRecord) -> None:
        """Outside of a chunk, too."""
        builder = RecordBuilder()
        record.write(builder)
        sink.write(builder.end())  # type: ignore[no-untyped-call]

    writer = Writer(sink, chunk_size=chunk_bytes)
    writer.start(library="x 1")
    writer.add_metadata("about", {"plant": "cstr"})
    schema = writer.register_schema("S", "protobuf", b"described")
    describe(Schema(data=b"described", encoding="protobuf", id=schema, name="S"))
    for number, signal in enumerate(SIGNALS):
        metadata = {"unit": "K"} if number else {}
        channel = writer.register_channel(signal, "protobuf", schema if number else 0, metadata)
        describe(Channel(channel, signal, "protobuf", metadata, schema if number else 0))
    for number, (channel, log_time, payload, publish_time, sequence) in enumerate(messages):
        writer.add_message(channel, log_time, payload, publish_time, sequence)
        if number % flush_every == flush_every - 1:
            writer.flush()  # type: ignore[no-untyped-call]
    writer.add_metadata("gap", {"messages": "3"})
    writer.finish()  # type: ignore[no-untyped-call]
    return sink.getvalue()


@pytest.mark.parametrize("count", [0, 1, 2000])
@pytest.mark.parametrize("flush_every", [7, 300, 10**9])
def test_the_same_messages_give_the_same_bytes(monkeypatch: pytest.MonkeyPatch, count: int, flush_every: int) -> None:
    monkeypatch.setattr(mcap_stream, "CHUNK_BYTES", 10_000)
    assert by_us(sent(count), flush_every) == by_the_library(sent(count), flush_every, 10_000)


def test_a_chunk_ends_by_itself_at_the_size_that_the_library_takes_for_granted() -> None:
    messages = sent(40_000)
    assert by_us(messages, 10**9) == by_the_library(messages, 10**9, 1024 * 1024)


def test_the_library_reads_what_was_written(tmp_path: Path) -> None:
    messages = sent(2000)
    path = tmp_path / "x.mcap"
    path.write_bytes(by_us(messages, 300))
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        found = [
            (channel.id, message.log_time, message.data, message.publish_time, message.sequence)
            for _, channel, message in reader.iter_messages(log_time_order=False)
        ]
        summary = reader.get_summary()
    assert found == messages
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(messages)
    assert summary.statistics.message_start_time == min(message[1] for message in messages)
