"""Missing messages of a recording after a cut link or a killed router, under load.

A publisher sends 5,000 samples a second through a router to a recorder. The link of one of them goes through a proxy,
which cuts it for a while: either it is closed and refused, as when a machine is switched off, or nothing passes any
more, as when a cable is pulled. Or the router, a process of its own, is killed and another one started. Afterwards the
file is read: by the sequence numbers, is anything missing, and is every stream in its order?

    python benchmarks/link_cuts.py [seconds of the longest cut]
"""

import contextlib
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from benchmarks.harness.site import (
    PATIENCE_S,
    RATE_PER_S,
    SIGNALS,
    Heard,
    Manner,
    Proxy,
    Publisher,
    Router,
    Tokens,
    connect_client,
    recorder_process,
)
from reactorwatch.contract import keys
from reactorwatch.contract.codec import decode
from reactorwatch.contract.messages_pb2 import Sample
from reactorwatch.runtime.bus_zenoh import ZenohBus
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal
from reactorwatch.runtime.http_pages import free_endpoint
from reactorwatch.runtime.node_main import configure_log
from recorder.__main__ import record
from recorder.config import RecorderConfig
from recorder.files.recording import Recording

CUTS_S = (1.0, 5.0, 30.0)
Whose = Literal["recorder", "publisher"]

CASES: tuple[tuple[Whose, Manner], ...] = (
    ("recorder", "closed"),
    ("recorder", "stalled"),
    ("publisher", "closed"),
    ("publisher", "stalled"),
)
ROWS_PER_S = RATE_PER_S // SIGNALS
WARM_UP_S = 0.2
STUCK_S = 7.0  # a publisher that waits for the network waits less


@dataclass(frozen=True)
class Found:
    """Content of a recording."""

    published: int  # number of samples published
    recorded: int  # number of samples recorded
    missing: int  # number of samples missing by sequence number
    twice: int  # number of repeated samples
    out_of_order: int  # number of samples behind one that was published after them
    slowest_put_s: float  # longest time of publishing a batch of samples


@dataclass(frozen=True)
class Load:
    """A publisher and a recorder under load."""

    proxy: Proxy  # proxy on the link of one of them
    publisher: Publisher  # publisher of the samples
    bus: ZenohBus  # link of the publisher
    heard: Heard  # count of the messages that the recorder has received
    found: list[Found]  # content of each recording, after the end

    def wait_for_rows(self, span_s: float) -> None:
        """Wait for the rows of a number of seconds."""
        self.publisher.wait(self.publisher.sequence + round(span_s * self.publisher.rows_per_s))


@contextlib.contextmanager
def under_load(folder: Path, router: str, whose: Whose | None, cache_messages: int, rate_per_s: int) -> Iterator[Load]:
    """A publisher and a recorder at a router."""
    proxy = Proxy(router)
    direct = BusConfig(endpoint=router, cache_messages=cache_messages)
    via = BusConfig(endpoint=proxy.endpoint, cache_messages=cache_messages)
    path, stop = folder / "run.mcap", StopSignal()
    config = RecorderConfig(out=str(path), health_period_s=0.2, black_box_min=0.0)
    recording = threading.Thread(target=record, args=(config, via if whose == "recorder" else direct, stop))
    observer = connect_client(direct)
    heard, tokens = Heard(observer), Tokens(observer)
    recording.start()
    bus = connect_client(via if whose == "publisher" else direct)
    try:
        tokens.wait(alive=True)
        publisher = Publisher(bus, rate_per_s)
        load = Load(proxy, publisher, bus, heard, [])
        load.wait_for_rows(WARM_UP_S)
        yield load
        publisher.close()
        assert heard.wait(publisher.sequence * SIGNALS), "the recorder does not keep up"
    finally:
        stop.set()
        recording.join(PATIENCE_S)
        bus.close()
        observer.close()
        proxy.close()
    load.found.append(read_content([path], publisher))


def cut(
    folder: Path,
    whose: Whose,
    manner: Manner,
    span_s: float,
    *,
    cache_messages: int = 10_000,
    rate_per_s: int = RATE_PER_S,
) -> Found:
    """Cut a link for a time."""
    with (
        contextlib.closing(Router(endpoint := free_endpoint())),
        under_load(folder, endpoint, whose, cache_messages, rate_per_s) as load,
        load.proxy.cut(manner),
    ):
        load.wait_for_rows(span_s)
    return load.found[0]


def kill_router(folder: Path, span_s: float, *, cache_messages: int = 10_000, rate_per_s: int = RATE_PER_S) -> Found:
    """Kill the router, and start another one after a time."""
    with (
        contextlib.closing(Router(endpoint := free_endpoint())) as router,
        under_load(folder, endpoint, None, cache_messages, rate_per_s) as load,
    ):
        router.kill()
        load.wait_for_rows(span_s)
        router.restart()
    return load.found[0]


def read_content(files: Sequence[Path], publisher: Publisher) -> Found:
    """Read the content of consecutive recordings."""
    numbers: dict[str, list[int]] = {}
    behind, newest = 0, 0
    for entry in (entry for path in files for entry in Recording(path).messages({keys.SAMPLE})):
        sample = decode(entry.payload, entry.encoding)
        assert isinstance(sample, Sample)
        numbers.setdefault(entry.key, []).append(sample.sequence)
        behind += sample.sequence < newest
        newest = max(newest, sample.sequence)
    recorded = sum(map(len, numbers.values()))
    different = sum(len(set(found)) for found in numbers.values())
    published = publisher.sequence * SIGNALS
    return Found(published, recorded, published - different, recorded - different, behind, publisher.slowest_s)


def stick(
    folder: Path, span_s: float, *, cache_messages: int = 20_000, rate_per_s: int = RATE_PER_S
) -> tuple[Found, Found]:
    """Freeze one of two recorders, as a broken disk would; returns the content of both recordings."""
    stuck = folder / "stuck"
    stuck.mkdir()
    with (
        contextlib.closing(Router(endpoint := free_endpoint())),
        under_load(folder, endpoint, None, cache_messages, rate_per_s) as load,
    ):
        heard = Heard(load.bus, "stuck")
        with recorder_process(stuck, endpoint, Tokens(load.bus, "stuck"), plant="stuck") as process:
            process.send_signal(signal.SIGSTOP)
            load.wait_for_rows(span_s)
            assert load.heard.wait(load.publisher.sequence * SIGNALS), "one that is stuck holds the other up"
            process.send_signal(signal.SIGCONT)
            load.publisher.close()
            assert heard.wait(load.publisher.sequence * SIGNALS), "the recorder that was stuck does not keep up"
    return load.found[0], read_content(Recording(stuck).files, load.publisher)


def main() -> None:
    """Print what was found."""
    configure_log()
    longest_s = float(sys.argv[1]) if len(sys.argv) > 1 else CUTS_S[-1]
    print(f"{RATE_PER_S:,} samples/s              published   missing  twice  out of order  slowest batch, ms")
    for span_s in (span for span in CUTS_S if span <= longest_s):
        cache = round(2 * (span_s + 10.0) * ROWS_PER_S)
        for whose, manner in CASES:
            with tempfile.TemporaryDirectory() as folder:
                _tell(f"{whose}, {manner} {span_s:g} s", cut(Path(folder), whose, manner, span_s, cache_messages=cache))
        with tempfile.TemporaryDirectory() as folder:
            _tell(f"router killed {span_s:g} s", kill_router(Path(folder), span_s, cache_messages=cache))
    with tempfile.TemporaryDirectory() as folder:
        other, stuck = stick(Path(folder), STUCK_S)
        _tell(f"beside one stuck {STUCK_S:g} s", other)
        _tell(f"stuck {STUCK_S:g} s", stuck)


def _tell(name: str, found: Found) -> None:
    print(
        f"{name:30s} {found.published:9,d} {found.missing:9d} {found.twice:6d} {found.out_of_order:13d} "
        f"{1000 * found.slowest_put_s:18.1f}"
    )


if __name__ == "__main__":
    main()
