"""A recording of some kilobytes that expands to gigabytes is refused by every command, with bounded memory."""

import json
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC

MEBIBYTE = 1 << 20
BOMB_BYTES = 1 << 30
LARGEST_BYTES = 700_000_000
"""Memory of the commands with all that they import (250 MB), without a bomb."""

RUN_ALL = """
import contextlib, io, json, sys
from pathlib import Path
from reactorwatch.cli.main import main
for line in json.loads(sys.argv[1]):
    sys.argv = ["reactorwatch", *line]
    shown = io.StringIO()
    with contextlib.redirect_stderr(shown), contextlib.redirect_stdout(io.StringIO()):
        try:
            main()
        except SystemExit as ended:
            code = ended.code
    status = Path("/proc/self/status").read_text()  # ru_maxrss is that of the parent at least
    peak = 1024 * int(status.split("VmHWM:")[1].split()[0])
    print(json.dumps([" ".join(line), code, shown.getvalue(), peak]), flush=True)
"""

COMMANDS = (
    "info FILE",
    "diagnose FILE",
    "simulate FILE -o FOLDER/x.csv",
    "dashboard FILE -o FOLDER/x.rrd",
    "export FILE -o FOLDER/x.csv",
    "backtest FILE",
    "replay FILE --verify",
    "replay FILE --endpoint tcp/127.0.0.1:1",
    "cut FILE -o FOLDER/x.mcap --from 0min",
    "recover FILE -o FOLDER/x.mcap",
    "identify FILE --output T",
    "causes --process cstr --record FILE",
)


def bytes_of(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def zstd_bomb() -> bytes:
    packed = zstandard.ZstdCompressor().compressobj(size=BOMB_BYTES)
    return b"".join(packed.compress(bytes(MEBIBYTE)) for _ in range(BOMB_BYTES // MEBIBYTE)) + packed.flush()


def lz4_bomb() -> bytes:
    with lz4.frame.LZ4FrameCompressor() as packed:
        start = packed.begin(BOMB_BYTES)
        parts = [packed.compress(bytes(MEBIBYTE)) for _ in range(BOMB_BYTES // MEBIBYTE)]
        return b"".join((start, *parts, packed.flush()))


CHANNEL = bytes_of(Channel(id=1, topic="reactor/cstr/sample/T", message_encoding="x", metadata={}, schema_id=0))
COUNTS = Statistics(
    attachment_count=0,
    channel_count=1,
    channel_message_counts={1: 1},
    chunk_count=1,
    message_count=1,
    message_end_time=2,
    message_start_time=1,
    metadata_count=0,
    schema_count=0,
)
HEAD = MCAP0_MAGIC + bytes_of(Header(profile="", library=""))


def finished(content: bytes, summary: bytes) -> bytes:
    """File of a data section and a summary."""
    content += bytes_of(DataEnd(0))
    start = len(content) if summary else 0
    crc = zlib.crc32(summary + bytes_of(Footer(start, 0, 0))[:-4]) if summary else 0
    return content + summary + bytes_of(Footer(start, 0, crc)) + MCAP0_MAGIC


def index_of(chunk: Chunk, record: bytes, at: int) -> bytes:
    return bytes_of(
        ChunkIndex(
            chunk_length=len(record),
            chunk_start_offset=at,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=2,
            message_index_length=0,
            message_index_offsets={1: at},
            message_start_time=1,
            uncompressed_size=chunk.uncompressed_size,
        )
    )


FILES: dict[str, Callable[[Chunk, bytes], bytes]] = {
    "indexed": lambda chunk, record: finished(HEAD + record, CHANNEL + index_of(chunk, record, len(HEAD))),
    "without an index": lambda _, record: finished(HEAD + record, b""),
    "without an index of the chunk": lambda _, record: finished(HEAD + record, CHANNEL + bytes_of(COUNTS)),
    "chunk within the index": lambda _, record: finished(HEAD, CHANNEL + record),
    "chunk in place of metadata": lambda chunk, record: finished(
        HEAD + record,
        CHANNEL
        + index_of(chunk, record, len(HEAD))
        + bytes_of(MetadataIndex(offset=len(HEAD), length=len(record), name="reactorwatch")),
    ),
    "after metadata": lambda _, record: finished(
        HEAD + bytes_of(Metadata(name="reactorwatch", metadata={"plant": "cstr", "settings": ""})) + record, b""
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("packing", ["zstd", "lz4"])
def test_every_command_refuses_a_bomb_in_one_line_with_bounded_memory(packing: str, tmp_path: Path) -> None:
    data = {"zstd": zstd_bomb, "lz4": lz4_bomb}[packing]()
    lines = []
    for number, write in enumerate(FILES.values()):
        for claimed in (BOMB_BYTES, 1000):
            chunk = Chunk(packing, data, 2, 1, 0, claimed)
            path = tmp_path / f"bomb-{number}-{claimed}.mcap"
            path.write_bytes(write(chunk, bytes_of(chunk)))
            folder = tmp_path / f"out-{number}-{claimed}"
            folder.mkdir()
            lines += [
                [word.replace("FILE", str(path)).replace("FOLDER", str(folder)) for word in command.split()]
                for command in COMMANDS
            ]
    run = subprocess.run(
        [sys.executable, "-P", "-c", RUN_ALL, json.dumps(lines)],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
    )
    results = [json.loads(line) for line in run.stdout.splitlines()]
    assert len(results) == len(lines)
    for line, code, shown, peak_bytes in results:
        assert peak_bytes < LARGEST_BYTES < BOMB_BYTES, line
        if "recover" in line or " info " in f" {line} ":  # these show what is whole
            assert code in (None, 0, 1, 2), line
        else:
            assert (code, shown.count("\n")) == (2, 1), (line, shown)
        assert "Traceback" not in shown
