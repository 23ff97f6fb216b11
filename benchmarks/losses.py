"""Losses of a recorder that is killed, or whose link is cut, under load.

A publisher sends 5,000 samples a second through a real router to a recorder.

- `make kills`: the recorder, a process of its own, is killed (SIGKILL) at a random moment once it has caught up. It is
  started again and killed again; each start recovers what the kill before it left. Afterwards every file is read: its
  last sample may be a second older than the kill, and by the sequence numbers nothing may be missing in the recording.
  A sample that one file lacks may be in the next one, whose recorder received it from the publisher's cache.
- `make cuts`: the link of publisher or recorder goes through a proxy, which cuts it for a while: it is closed and
  refused, as when a machine is switched off, or nothing passes any more, as when a cable is pulled. Or the router is
  killed and another one started, or one of two recorders freezes. Afterwards the file is read: by the sequence numbers,
  is anything missing, and is every stream in its order?

    python benchmarks/losses.py kills [how many kills]
    python benchmarks/losses.py cuts [seconds of the longest cut]
"""

import contextlib
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.harness.site import (
    PATIENCE_S,
    RATE_PER_S,
    SIGNALS,
    CatchUp,
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
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import decode
from reactorwatch.contract.messages_pb2 import Sample
from reactorwatch.runtime.bus_zenoh import ZenohBus, router
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal
from reactorwatch.runtime.http_pages import free_endpoint
from reactorwatch.runtime.node_main import configure_log
from recorder.__main__ import record
from recorder.config import RecorderConfig
from recorder.files.recording import Recording

KILLS = 50
start_recorder = partial(
    recorder_process, history_s=BusConfig().history_s, black_box_min=RecorderConfig().black_box_min
)
"""The recorder as it is configured by default."""

SOONEST_S, LATEST_S = 0.5, 4.0
KEPT = 30 * RATE_PER_S // SIGNALS
"""Messages on a key that the publisher remembers: of half a minute, as a busy machine is slow to start a recorder."""


@dataclass(frozen=True)
class Killed:
    """Recording after a kill."""

    messages: int  # number of samples in the recovered file
    lost_s: float  # time from the last sample in the file to the kill
    missing: int  # number of samples between the first and the last of the file, by sequence number, that no file holds
    late: int


def kill_often(folder: Path, kills: int, rate_per_s: int, seed: int) -> list[Killed]:
    """Kill a recorder so many times, at random moments, and look at what is there in the end."""
    random = np.random.default_rng(seed)
    config = BusConfig(endpoint=free_endpoint(), cache_messages=KEPT)
    hub = router(config)
    bus = connect_client(config)
    tokens = Tokens(bus)  # on the publisher's own link, where the subscription is known before the token
    catch_up = CatchUp(bus, rate_per_s)
    publisher = Publisher(bus, rate_per_s)
    alive_at, killed_ns = [], []
    try:
        for _ in range(kills):
            with start_recorder(folder, config.endpoint, tokens) as process:
                alive_at.append(publisher.sequence + 1)  # the row that is being published may be half heard
                catch_up.wait()
                time.sleep(random.uniform(SOONEST_S, LATEST_S))
                killed_ns.append(time.time_ns())
                process.send_signal(signal.SIGKILL)
        with start_recorder(folder, config.endpoint, tokens) as process:
            catch_up.wait()
            process.terminate()  # the last start recovers, too
            process.wait(PATIENCE_S)
    finally:
        publisher.close()
        bus.close()
        hub.close()
    left = [path.name for path in folder.iterdir() if path.suffix not in (".mcap", ".toml")]
    assert not left, f"not recovered: {left}"
    files = [_numbers_and_end(path) for path in Recording(folder).files]
    recorded = {key: set[int]().union(*(numbers.get(key, ()) for numbers, _ in files)) for key in files[0][0]}
    found = []
    for (numbers, last_ns), at_ns, alive in zip(files, killed_ns, alive_at, strict=False):
        spans = {key: range(min(held), max(held) + 1) for key, held in numbers.items()}
        found.append(
            Killed(
                messages=sum(map(len, numbers.values())),
                lost_s=(at_ns - last_ns) / 1e9,
                missing=sum(len(set(span) - recorded[key]) for key, span in spans.items()),
                late=sum(len(set(range(alive, span.start)) - recorded[key]) for key, span in spans.items()),
            )
        )
    return found


def _numbers_and_end(path: Path) -> tuple[dict[str, list[int]], int]:
    """Sequence numbers of the samples in a file, by key, and the time from which not every key has one."""
    numbers: dict[str, list[int]] = {}
    last_ns: dict[str, int] = {}
    for entry in Recording(path).messages({keys.SAMPLE}):
        sample = decode(entry.payload, entry.encoding)
        assert isinstance(sample, messages.Sample)
        numbers.setdefault(entry.key, []).append(sample.sequence)
        last_ns[entry.key] = sample.time_ns
    assert len(numbers) == SIGNALS, f"{path}: holds {len(numbers)} signals"
    return numbers, min(last_ns.values())


def print_kills(kills: int = KILLS) -> None:
    """Print what was lost."""
    with tempfile.TemporaryDirectory() as folder:
        found = kill_often(Path(folder), kills, RATE_PER_S, seed=1)
    lost = np.array([killed.lost_s for killed in found])
    print(f"kills at {RATE_PER_S:,} samples/s               {len(found)}, each file recovered")
    print(f"lost before the kill, s               median {np.median(lost):.2f}, longest {lost.max():.2f}")
    print(f"samples missing within the recording  {sum(killed.missing for killed in found)}")
    print(f"samples missing at their beginnings   {sum(killed.late for killed in found)}")
    print(f"samples in the files                  {sum(killed.messages for killed in found):,}")


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


def print_cuts(longest_s: float = CUTS_S[-1]) -> None:
    """Print what was found."""
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
    configure_log()  # to standard error
    kind, *numbers = sys.argv[1:]
    if kind == "kills":
        print_kills(*map(int, numbers))
    else:
        print_cuts(*map(float, numbers))
