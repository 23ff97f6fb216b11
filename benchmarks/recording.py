"""Throughput of the recorder, and its cost over the bare MCAP library.

Printed are ratios measured in one run, because machines differ in speed: recorded over published at 20,000
messages/s through a real router; writing and reading over the bare library's.

    python benchmarks/recording.py
"""

import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar

from mcap.reader import make_reader
from mcap.writer import Writer

from benchmarks.harness.site import Heard, Tokens, connect_client, recorder_process
from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Encoded, Publication, decode, encode
from reactorwatch.runtime.bus_zenoh import router
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.http_pages import free_endpoint
from reactorwatch.runtime.node_main import configure_log
from recorder import RecordedMessage
from recorder.config import RecorderConfig
from recorder.core import Recorder
from recorder.files.recording import Recording
from recorder.files.writer import PartFile, RecordingWriter
from recorder.keep import Fsync
from recorder.node import RecorderNode
from recorder.recording_files import RecordingFiles
from recorder.tools.convert import read_record

RATE_PER_S = 20_000
SECONDS = 5
MESSAGES = 200_000
SIGNALS = ("qc", "C", "T")
FSYNC_RATE_PER_S, FSYNC_SECONDS = 5_000, 30


def samples(count: int) -> list[Encoded]:
    """A number of samples, a tenth of a minute apart, signal by signal."""
    out = []
    for number in range(count):
        row, signal_number = divmod(number, len(SIGNALS))
        sample = messages.Sample(
            time_ns=row * 6_000_000_000,
            sequence=row,
            value=number / 7,
            unit="K",
            quality=messages.QUALITY_GOOD,
        )
        out.append(encode(Publication(keys.key("cstr", keys.SAMPLE, SIGNALS[signal_number]), sample)))
    return out


def through_a_router(folder: Path, sent: list[Encoded], rate_per_s: float | None) -> tuple[float, float, float]:
    """(messages/s at which was published, share of them recorded, longest lag in s that the recorder reports)."""
    config = BusConfig(endpoint=free_endpoint())
    hub, plant, observer = router(config), connect_client(config), connect_client(config)
    heard = Heard(observer)
    with recorder_process(folder, config.endpoint, Tokens(observer)):
        start = time.perf_counter()
        for number, message in enumerate(sent):
            if rate_per_s and number % 20 == 0:
                time.sleep(max(0.0, start + number / rate_per_s - time.perf_counter()))
            plant.publish(message)
        plant.close()
        rate = len(sent) / (time.perf_counter() - start)
        heard.wait(len(sent))
    observer.close()
    hub.close()
    entries = list(Recording(folder).messages())
    lags = [decode(entry.payload, entry.encoding) for entry in entries if keys.HEALTH in entry.key]
    longest_s = max(report.lag_ms for report in lags if isinstance(report, messages.Health)) / 1e3
    return rate, sum("/sample/" in entry.key for entry in entries) / len(sent), longest_s


def bare_write(path: Path, entries: list[RecordedMessage]) -> None:
    """The library alone: one schema, a channel a key."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("reactorwatch.v1.Sample", "protobuf", b"")
        channels: dict[str, int] = {}
        for entry in entries:
            if entry.key not in channels:
                channels[entry.key] = writer.register_channel(entry.key, "protobuf", schema)
            writer.add_message(channels[entry.key], entry.log_time_ns, entry.payload, entry.publish_time_ns)
        writer.finish()  # type: ignore[no-untyped-call]


def record(path: Path, sent: list[Encoded]) -> None:
    """Process each message as the recorder does between the bus and the file."""
    core = Recorder("cstr", 0)
    with RecordingWriter(path, {}) as writer:
        for number, message in enumerate(sent):
            kept = core.on_message(message, number)
            assert kept is not None
            writer.append(kept)


def exhaust(items: Iterable[Any]) -> None:
    """Read to the end."""
    for _ in items:
        pass


def rate_of(work: Any) -> float:
    """Messages/s, the best of two."""
    best = 0.0
    for _ in range(2):
        start = time.perf_counter()
        work()
        best = max(best, MESSAGES / (time.perf_counter() - start))
    return best


def files(folder: Path) -> None:
    """Writing and reading, over the bare library."""
    sent = samples(MESSAGES)
    entries = [RecordedMessage(*item[:3], number, number) for number, item in enumerate(sent)]
    bare, path = folder / "bare.mcap", folder / "recorded.mcap"

    def write_recording() -> None:
        path.unlink(missing_ok=True)
        record(path, sent)

    def read_bare(*, in_order: bool) -> None:
        with path.open("rb") as stream:
            exhaust(make_reader(stream).iter_messages(log_time_order=in_order))

    bare_rate, recorder_rate = rate_of(lambda: bare_write(bare, entries)), rate_of(write_recording)
    print(
        f"recording / bare writer                  {recorder_rate / bare_rate:5.2f}   ({recorder_rate:,.0f} messages/s)"
    )
    ordered, unordered = rate_of(lambda: read_bare(in_order=True)), rate_of(lambda: read_bare(in_order=False))
    reading = rate_of(lambda: exhaust(Recording(path).messages()))
    decoded = rate_of(lambda: exhaust(decode(entry.payload, entry.encoding) for entry in Recording(path).messages()))
    record_rate = rate_of(lambda: read_record(path))
    print(f"reading / bare reader, in order          {reading / ordered:5.2f}   ({reading:,.0f} messages/s)")
    print(f"reading / bare reader, in file order     {reading / unordered:5.2f}")
    print(f"reading decoded / bare reader, in order  {decoded / ordered:5.2f}   ({decoded:,.0f} messages/s)")
    print(f"reading as a record / bare, in order     {record_rate / ordered:5.2f}   ({record_rate:,.0f} messages/s)")
    assert Recording(path).metadata


class Timed(PartFile):
    """A file that knows how long it was waited for."""

    waits_s: ClassVar[list[float]] = []

    def sync(self) -> None:
        """See `PartFile`."""
        start = time.perf_counter()
        super().sync()
        self.waits_s.append(time.perf_counter() - start)


def fsync(folder: Path) -> None:
    """Cost of waiting for the disk, for each second of traffic at 5,000 messages/s."""
    sent = samples(FSYNC_RATE_PER_S * FSYNC_SECONDS)
    step_ns = 1_000_000_000 // FSYNC_RATE_PER_S
    policies: tuple[Fsync, ...] = ("never", "second", "chunk")
    for policy in policies:
        config = RecorderConfig(out=str(folder / f"{policy}.mcap"), fsync=policy)
        Timed.waits_s.clear()
        start = time.perf_counter()
        with RecordingFiles(config, Timed) as recorded:
            node = RecorderNode(config, recorded, 0)
            for number, message in enumerate(sent):
                node.on_message(message, number * step_ns)
        took_ms = (time.perf_counter() - start) * 1e3 / FSYNC_SECONDS
        waited_ms = sum(Timed.waits_s) * 1e3 / FSYNC_SECONDS
        longest_ms = max(Timed.waits_s, default=0.0) * 1e3
        print(
            f"fsync {policy:6s} of a second of traffic   {waited_ms:5.1f} ms waited, {longest_ms:.0f} ms the longest, "
            f"{took_ms:.0f} ms work in all"
        )


def main() -> None:
    """Print the table."""
    configure_log()  # to standard error
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sent = samples(RATE_PER_S * SECONDS)
        for rate in (float(RATE_PER_S), None):
            own = folder / str(rate)
            own.mkdir()
            got, share, lag_s = through_a_router(own, sent, rate)
            asked = f"at {rate:,.0f}/s" if rate else "flat out"
            print(f"recorded / published, {asked:18s} {share:5.3f}   ({got:,.0f} messages/s, lag up to {lag_s:.2f} s)")
        files(folder)
        fsync(folder)


if __name__ == "__main__":
    main()
