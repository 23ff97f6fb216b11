"""Losses of a recorder that is killed (SIGKILL) under load.

A publisher sends 5,000 samples a second through a real router. A recorder of its own process is killed at a random
moment once it has caught up: it has received what publishers remember, and receives at the published rate. It is
started again and killed again; each start recovers what the kill before it left. Afterwards every file is read: its
last sample may be a second older than the kill, and by the sequence numbers nothing may be missing in the recording. A
sample that one file lacks may be in the next one, whose recorder received it from the publisher's cache.

    python benchmarks/recorder_kills.py [how many kills]
"""

import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.harness.site import (
    PATIENCE_S,
    RATE_PER_S,
    SIGNALS,
    CatchUp,
    Publisher,
    Tokens,
    connect_client,
    recorder_process,
)
from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import decode
from reactorwatch.runtime.bus_zenoh import router
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.http_pages import free_endpoint
from reactorwatch.runtime.node_main import configure_log
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


def main() -> None:
    """Print what was lost."""
    configure_log()  # to standard error
    kills = int(sys.argv[1]) if len(sys.argv) > 1 else KILLS
    with tempfile.TemporaryDirectory() as folder:
        found = kill_often(Path(folder), kills, RATE_PER_S, seed=1)
    lost = np.array([killed.lost_s for killed in found])
    print(f"kills at {RATE_PER_S:,} samples/s               {len(found)}, each file recovered")
    print(f"lost before the kill, s               median {np.median(lost):.2f}, longest {lost.max():.2f}")
    print(f"samples missing within the recording  {sum(killed.missing for killed in found)}")
    print(f"samples missing at their beginnings   {sum(killed.late for killed in found)}")
    print(f"samples in the files                  {sum(killed.messages for killed in found):,}")


if __name__ == "__main__":
    main()
