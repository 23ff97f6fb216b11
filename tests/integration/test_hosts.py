"""Two hosts, each with a router, as namespaces of the network: a link between them that is cut costs nothing."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from queue import SimpleQueue
from threading import Thread

import pytest

NAMES = (f"rw-n-{os.getpid()}", f"rw-s-{os.getpid()}")  # others may run these tests on this machine, too
LINKS = (f"rwn{os.getpid()}", f"rws{os.getpid()}")
ADDRESSES = ("10.213.77.1", "10.213.77.2")
ENDPOINTS = tuple(f"tcp/{address}:7447" for address in ADDRESSES)
WITHIN_S = 60.0
BURST = 300

ROUTER = """
import sys, threading
from reactorwatch.runtime.bus_zenoh import router
from reactorwatch.runtime.config import BusConfig
bus = router(BusConfig(endpoint=sys.argv[1], routers=tuple(sys.argv[2:])))
print("ready", flush=True)
threading.Event().wait()
"""
PLANT = """
import sys
from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime.bus_zenoh import connect
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal
bus = connect(BusConfig(endpoint=sys.argv[1]), "plant", StopSignal())
bus.declare_token("reactor/x/alive/plant")
print("ready", flush=True)
number = 0
for line in sys.stdin:
    for number in range(number, number + int(line)):
        bus.publish(Encoded(f"reactor/x/sample/{'CT'[number % 2]}", str(number).encode(), ""))
    number += 1
    print("published", flush=True)
"""
LISTENER = """
import sys, threading
from reactorwatch.runtime.bus_zenoh import connect
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal
bus = connect(BusConfig(endpoint=sys.argv[1]), "listener", StopSignal())
heard = []
def on_messages(messages):
    for message in messages:
        heard.append(int(message.payload))
        if len(heard) % int(sys.argv[2]) == 0:
            print("in order" if heard == list(range(len(heard))) else "out of order", len(heard), flush=True)
bus.subscribe_batched("reactor/*/sample/**", on_messages)
bus.subscribe_liveliness("reactor/*/alive/plant", lambda key, alive: print("came" if alive else "went", flush=True))
print("ready", flush=True)
threading.Event().wait()
"""


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


@pytest.fixture
def hosts() -> Iterator[None]:
    """Two namespaces with a link between them."""
    if os.geteuid() != 0:
        pytest.skip("namespaces of the network are root's to make")
    try:
        for name in NAMES:
            ip("netns", "add", name)
        ip("link", "add", LINKS[0], "netns", NAMES[0], "type", "veth", "peer", "name", LINKS[1], "netns", NAMES[1])
        for name, link, address in zip(NAMES, LINKS, ADDRESSES, strict=True):
            ip("-n", name, "addr", "add", f"{address}/24", "dev", link)
            ip("-n", name, "link", "set", "lo", "up")
            ip("-n", name, "link", "set", link, "up")
    except (OSError, subprocess.CalledProcessError) as error:
        remove()
        pytest.skip(f"no namespaces of the network here: {getattr(error, 'stderr', error)}")
    yield
    remove()


def remove() -> None:
    for name in NAMES:
        subprocess.run(["ip", "netns", "del", name], check=False, capture_output=True)


class Process:
    """A program on a host, and what it says, line by line."""

    def __init__(self, host: int, program: str, *arguments: str) -> None:
        command = ["ip", "netns", "exec", NAMES[host], sys.executable, "-c", program, *arguments]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        self._lines: SimpleQueue[str] = SimpleQueue()
        self._reader = Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(line.strip())

    def line(self) -> str:
        """The next line."""
        return self._lines.get(timeout=WITHIN_S)

    def until(self, wanted: str) -> list[str]:
        """Lines up to the one that is wanted."""
        lines = [self.line()]
        while lines[-1] != wanted:
            lines.append(self.line())
        return lines

    def send_line(self, line: str) -> None:
        """Give it a line."""
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        self._reader.join()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()


@contextmanager
def running(host: int, program: str, *arguments: str) -> Iterator[Process]:
    process = Process(host, program, *arguments)
    try:
        process.until("ready")
        yield process
    finally:
        process.kill()


@pytest.mark.slow
def test_two_routers_are_one_bus_and_a_cut_between_them_loses_and_disorders_nothing(hosts: None) -> None:
    with ExitStack() as stack:
        stack.enter_context(running(0, ROUTER, ENDPOINTS[0]))
        stack.enter_context(running(1, ROUTER, ENDPOINTS[1], ENDPOINTS[0]))
        listener = stack.enter_context(running(1, LISTENER, ENDPOINTS[1], str(BURST)))
        plant = stack.enter_context(running(0, PLANT, ENDPOINTS[0]))
        listener.until("came")
        plant.send_line(str(BURST))
        listener.until(f"in order {BURST}")
        ip("-n", NAMES[0], "link", "set", LINKS[0], "down")
        listener.until("went")  # when the lease of the link is over
        plant.until("published")
        plant.send_line(str(BURST))  # which nobody on the other side hears
        plant.until("published")
        ip("-n", NAMES[0], "link", "set", LINKS[0], "up")
        listener.until("came")
        plant.send_line(str(BURST))
        listener.until(f"in order {3 * BURST}")
