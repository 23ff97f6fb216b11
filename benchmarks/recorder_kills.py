"""Losses of a recorder that is killed (SIGKILL) under load.

A publisher sends 5,000 samples a second through a real router. A recorder of its own process is killed at a random
moment once it has caught up: it has received what publishers remember, and receives at the published rate. It is
started again and killed again; each start recovers what the kill before it left. Afterwards every file is read: its
last sample may be a second older than the kill, and by the sequence numbers nothing may be missing in the recording. A
sample that one file lacks may be in the next one, whose recorder received it from the publisher's cache.

    python benchmarks/recorder_kills.py [how many kills]
"""

import contextlib
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Encoded, Publication, decode, encode
from reactorwatch.runtime import logs
from reactorwatch.runtime.bus_zenoh import ZenohBus, connect, router
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal
from reactorwatch.runtime.loopback import free_endpoint
from recorder.files.recording import Recording

KILLS = 50
RATE_PER_S = 5_000
SIGNALS = 5
BATCHES_PER_S = 100
SOONEST_S, LATEST_S = 0.5, 4.0
PATIENCE_S = 60.0
HEALTH_S = 0.2
LIVE_LAG_MS = 100.0
LIVE_RATES = 0.8, 1.2
"""Received of published samples, between two reports of health that are both live: history comes faster."""
KEPT = 30 * RATE_PER_S // SIGNALS
"""Messages on a key that the publisher remembers: of half a minute, as a busy machine is slow to start a recorder."""


@dataclass(frozen=True)
class Killed:
    """Recording after a kill."""

    messages: int  # number of samples in the recovered file
    lost_s: float  # time from the last sample in the file to the kill
    missing: int  # number of samples between the first and the last of the file, by sequence number, that no file holds
    late: int


class Publisher:
    """Publishes samples at a rate, each with the time at which it was published, until it is closed."""

    def __init__(self, bus: ZenohBus, rate_per_s: int) -> None:
        self._bus = bus
        self._rows = rate_per_s // SIGNALS // BATCHES_PER_S
        self._ended = threading.Event()
        self._changed = threading.Condition()
        self.sequence = 0
        """Sequence number of the next samples."""
        self.slowest_s = 0.0
        """The longest that publishing a batch took."""
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    @property
    def rows_per_s(self) -> int:
        """Number of rows published in a second."""
        return self._rows * BATCHES_PER_S

    def wait(self, rows: int) -> None:
        """Wait until so many rows were published."""
        with self._changed:
            assert self._changed.wait_for(lambda: self.sequence >= rows, PATIENCE_S), "nothing is published"

    def close(self) -> None:
        """Publish no more."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        due = time.monotonic()
        while not self._ended.wait(max(0.0, due - time.monotonic())):
            due += 1.0 / BATCHES_PER_S
            began = time.monotonic()
            for _ in range(self._rows):
                for number in range(SIGNALS):
                    sample = messages.Sample(
                        time_ns=time.time_ns(), sequence=self.sequence, value=1.0, quality=messages.QUALITY_GOOD
                    )
                    self._bus.publish(encode(Publication(keys.key("cstr", keys.SAMPLE, f"x{number}"), sample)))
                self.sequence += 1
            self.slowest_s = max(self.slowest_s, time.monotonic() - began)
            with self._changed:
                self._changed.notify_all()


class Tokens:
    """Watches the liveliness token of a recorder."""

    def __init__(self, bus: ZenohBus, plant: str = "cstr") -> None:
        self._changed = threading.Condition()
        self._alive = False
        bus.subscribe_liveliness(keys.key(plant, keys.ALIVE, "recorder"), self._on_token)

    def wait(self, *, alive: bool) -> None:
        """Wait until the token is there, or gone."""
        with self._changed:
            assert self._changed.wait_for(lambda: self._alive == alive, PATIENCE_S), "no recorder, or no end of it"

    def _on_token(self, _key: str, alive: bool) -> None:
        with self._changed:
            self._alive = alive
            self._changed.notify_all()


class CatchUp:
    """Watches the health of a recorder until it has caught up with a publisher."""

    def __init__(self, bus: ZenohBus, rate_per_s: int) -> None:
        self._changed = threading.Condition()
        self._rate_per_s = rate_per_s
        self._before: messages.Health | None = None
        self._live = 0  # reports in a row
        bus.subscribe(keys.key("cstr", keys.HEALTH, "recorder"), self._on_health)

    def wait(self) -> None:
        """Wait until two reports in a row from now on are live."""
        with self._changed:
            self._before, self._live = None, 0
            assert self._changed.wait_for(lambda: self._live >= 2, PATIENCE_S), "the recorder does not catch up"

    def _on_health(self, message: Encoded) -> None:
        health = decode(message.payload, message.encoding)
        assert isinstance(health, messages.Health)
        with self._changed:
            before, self._before = self._before, health
            if before is None or health.time_ns <= before.time_ns:
                return
            rate_per_s = (health.received - before.received) / ((health.time_ns - before.time_ns) / 1e9)
            lowest, highest = LIVE_RATES
            is_live = lowest <= rate_per_s / self._rate_per_s <= highest and health.lag_ms < LIVE_LAG_MS
            self._live = self._live + 1 if is_live else 0
            self._changed.notify_all()


@contextlib.contextmanager
def recorder(folder: Path, endpoint: str, tokens: "Tokens") -> Iterator[subprocess.Popen[bytes]]:
    """A recorder that is alive, after the one before is known to be gone."""
    settings = folder / "settings.toml"
    settings.write_text(f'[bus]\nendpoint = "{endpoint}"\n[recorder]\nout = "{folder}"\nhealth_period_s = {HEALTH_S}\n')
    tokens.wait(alive=False)
    process = subprocess.Popen([sys.executable, "-m", "recorder", str(settings)], stderr=subprocess.DEVNULL)
    try:
        tokens.wait(alive=True)
        yield process
    finally:
        process.kill()
        process.wait()


def kill_often(folder: Path, kills: int, rate_per_s: int, seed: int) -> list[Killed]:
    """Kill a recorder so many times, at random moments, and look at what is there in the end."""
    random = np.random.default_rng(seed)
    config = BusConfig(endpoint=free_endpoint(), cache_messages=KEPT)
    hub = router(config)
    bus = connect(config, "kills", StopSignal())
    assert bus is not None
    tokens = Tokens(bus)  # on the publisher's own link, where the subscription is known before the token
    catch_up = CatchUp(bus, rate_per_s)
    publisher = Publisher(bus, rate_per_s)
    alive_at, killed_ns = [], []
    try:
        for _ in range(kills):
            with recorder(folder, config.endpoint, tokens) as process:
                alive_at.append(publisher.sequence + 1)  # the row that is being published may be half heard
                catch_up.wait()
                time.sleep(random.uniform(SOONEST_S, LATEST_S))
                killed_ns.append(time.time_ns())
                process.send_signal(signal.SIGKILL)
        with recorder(folder, config.endpoint, tokens) as process:
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
    logs.configure()  # to standard error
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
