"""Publisher, recorder, router and links of a site under load, which can be killed and cut.

A publisher sends samples through a router to a recorder. The link of one of them may go through a proxy, which cuts it
for a while: either it is closed and refused, as when a machine is switched off, or nothing passes any more, as when a
cable is pulled. The router and the recorder may be processes of their own, which can be killed.
"""

import contextlib
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from reactorwatch.cli.processes import write_settings
from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Encoded, Publication, decode, encode
from reactorwatch.runtime.bus_zenoh import ZenohBus, connect
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal
from reactorwatch.runtime.http_pages import free_port
from recorder.config import RecorderConfig

Manner = Literal["closed", "stalled"]

RATE_PER_S = 5_000
SIGNALS = 5
BATCHES_PER_S = 100
PATIENCE_S = 60.0
HEALTH_S = 0.2
HISTORY_S = 600.0  # a process takes a minute to start where much else runs
LIVE_LAG_MS = 100.0
LIVE_RATES = 0.8, 1.2
"""Received of published samples, between two reports of health that are both live: history comes faster."""

_BLOCK = 65_536


class Proxy:
    """A relay of TCP between this machine's loopback and a router, which can be interrupted."""

    def __init__(self, endpoint: str) -> None:
        host, port = endpoint.partition("/")[2].rsplit(":", 1)
        self._target = (host, int(port))
        self._port = free_port()
        self.endpoint = f"tcp/127.0.0.1:{self._port}"
        self._open = threading.Event()
        self._open.set()
        self._closed = False
        self._links: list[socket.socket] = []
        self._lock = threading.Lock()
        self._listener = self._listen()

    @contextlib.contextmanager
    def cut(self, manner: Manner) -> Iterator[None]:
        """Interrupt it, while the context lasts."""
        if manner == "stalled":
            self._open.clear()
            yield
            self._open.set()
            return
        self._refuse()
        yield
        self._listener = self._listen()

    def close(self) -> None:
        """End it."""
        self._closed = True
        self._open.set()
        self._refuse()

    def _refuse(self) -> None:
        """Listen no more, and end what is connected."""
        self._listener.shutdown(socket.SHUT_RDWR)  # a thread that waits for a link holds it open otherwise
        self._listener.close()
        self._drop_links()

    def _listen(self) -> socket.socket:
        listener = socket.create_server(("127.0.0.1", self._port))
        threading.Thread(target=self._accept, args=(listener,), daemon=True).start()
        return listener

    def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                near, _ = listener.accept()
            except OSError:
                return  # it is closed
            try:
                far = socket.create_connection(self._target)
            except OSError:
                near.close()  # the router is gone
                continue
            with self._lock:
                self._links += [near, far]
            for source, sink in ((near, far), (far, near)):
                threading.Thread(target=self._relay, args=(source, sink), daemon=True).start()

    def _relay(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while block := source.recv(_BLOCK):
                self._open.wait()
                sink.sendall(block)
        for end in (source, sink):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def _drop_links(self) -> None:
        with self._lock:
            links, self._links = self._links, []
        for link in links:
            with contextlib.suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()


class Router:
    """A router in a process of its own, which can be killed."""

    def __init__(self, endpoint: str) -> None:
        self.config = BusConfig(endpoint=endpoint)
        self._code = (
            "from reactorwatch.runtime import bus_zenoh, config; import sys; "
            f"bus = bus_zenoh.router(config.BusConfig(endpoint={endpoint!r})); sys.stdin.read()"
        )
        self._process = self._start()

    @property
    def pid(self) -> int:
        """Process ID of the router."""
        return self._process.pid

    def kill(self) -> None:
        """End it as a crash does."""
        self._process.kill()
        self._process.communicate()

    def restart(self) -> None:
        """Start another one at the same address."""
        self._process = self._start()

    close = kill

    def _start(self) -> "subprocess.Popen[bytes]":
        return subprocess.Popen([sys.executable, "-c", self._code], stdin=subprocess.PIPE, stderr=subprocess.DEVNULL)


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


class Heard:
    """Counts the messages of others that the recorder has received or reports as lost."""

    def __init__(self, bus: ZenohBus, plant: str = "cstr") -> None:
        self._changed = threading.Condition()
        self._count = 0
        bus.subscribe(keys.key(plant, keys.HEALTH, "recorder"), self._on_health)

    def wait(self, count: int) -> bool:
        """Wait for a number of messages; False if they did not come in time."""
        with self._changed:
            return self._changed.wait_for(lambda: self._count >= count, PATIENCE_S)

    def _on_health(self, message: Encoded) -> None:
        health = decode(message.payload, message.encoding)
        assert isinstance(health, messages.Health)
        with self._changed:
            own = health.published - 1  # its reports come back to it, but for this one
            self._count = health.received + health.lost - own
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


def connect_client(config: BusConfig) -> ZenohBus:
    """Connect a client to the router."""
    bus = connect(config, "cuts", StopSignal())
    assert bus is not None
    return bus


@contextlib.contextmanager
def recorder_process(
    folder: Path,
    endpoint: str,
    tokens: Tokens,
    plant: str = "cstr",
    *,
    history_s: float = HISTORY_S,
    black_box_min: float = 0.0,
) -> Iterator["subprocess.Popen[bytes]"]:
    """A recorder in a process of its own, which is alive and ends by being asked to; the one before must be gone."""
    config = RecorderConfig(plant=plant, out=str(folder), health_period_s=HEALTH_S, black_box_min=black_box_min)
    bus = BusConfig(endpoint=endpoint, history_s=history_s)
    write_settings(folder / "settings.toml", {"bus": bus, "recorder": config})
    tokens.wait(alive=False)
    command = [sys.executable, "-m", "recorder", str(folder / "settings.toml")]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        tokens.wait(alive=True)
        yield process
    finally:
        process.terminate()
        process.wait(PATIENCE_S)
