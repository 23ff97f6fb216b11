"""Machines of a site in small: namespaces of the network that can be cut off, and services under a supervisor."""

import contextlib
import os
import signal
import subprocess
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple


class Network:
    """A bridge of this machine to namespaces of the network, each of which can be cut off.

    Args:
        count: number of namespaces.

    Attributes:
        address: address of this machine in this network.
        failure: reason why there is none, as only root can make it; then all machines are this one, on its loopback.
    """

    def __init__(self, count: int) -> None:
        subnet, self._name = f"10.213.{os.getpid() % 256}", f"rw{os.getpid()}"  # there may be others on this machine
        self._namespaces = [f"{self._name}-{number}" for number in range(count)]
        self.address, self.failure = f"{subnet}.1", ""
        try:
            _ip("link", "add", self._name, "type", "bridge")
            _ip("addr", "add", f"{self.address}/24", "dev", self._name)
            _ip("link", "set", self._name, "up")
            for number, name in enumerate(self._namespaces):
                _ip("netns", "add", name)
                _ip("link", "add", name, "master", self._name, "type", "veth", "peer", "name", "eth0", "netns", name)
                _ip("-n", name, "addr", "add", f"{subnet}.{number + 2}/24", "dev", "eth0")
                for command in (("-n", name, "link", "set", "lo"), ("-n", name, "link", "set", "eth0")):
                    _ip(*command, "up")
                self.cut(number, is_cut=False)
        except (OSError, subprocess.CalledProcessError) as error:
            self.close()
            self.address, self.failure = "127.0.0.1", str(getattr(error, "stderr", error)).strip()

    def command(self, number: int) -> list[str]:
        """Beginning of a command line that runs in a namespace."""
        return [] if self.failure else ["ip", "netns", "exec", self._namespaces[number]]

    def cut(self, number: int, *, is_cut: bool) -> None:
        """Pull the cable of a namespace at the bridge, or plug it in."""
        _ip("link", "set", self._namespaces[number], "down" if is_cut else "up")

    def close(self) -> None:
        """Remove the namespaces, whose processes have ended, and the bridge."""
        for command in (*(["netns", "del", name] for name in self._namespaces), ["link", "del", self._name]):
            with contextlib.suppress(OSError, subprocess.CalledProcessError):
                _ip(*command)


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


class Service:
    """A process in a process group of its own, started again a second after it ends by itself, as by a supervisor.

    Args:
        command: its command line.
        log: file to which its output is appended.
        environment: variables beside those of this process.

    Attributes:
        groups: number of the process group of each start, which is that of its first process.
    """

    def __init__(self, command: Sequence[str], log: Path, environment: Mapping[str, str]) -> None:
        self._command, self._log, self._environment = list(command), log, {**os.environ, **environment}
        self.groups: list[int] = []
        self._closed = threading.Event()
        self.start()
        threading.Thread(target=self._supervise, daemon=True).start()

    @property
    def group(self) -> int:
        """Number of its present or last process group."""
        return self.groups[-1]

    def start(self) -> None:
        """Start it."""
        with self._log.open("ab") as said:
            self._process = subprocess.Popen(
                self._command, env=self._environment, stdout=said, stderr=said, process_group=0, cwd=self._log.parent
            )
        self.groups.append(self._process.pid)
        self._is_down = False

    def signal(self, number: int) -> None:
        """Send a signal to all processes of the group."""
        os.killpg(self.group, number)

    def kill(self) -> None:
        """End the group, as the end of its machine does; it stays down until it is started."""
        self._is_down = True
        with contextlib.suppress(ProcessLookupError):
            self.signal(signal.SIGKILL)
        self._process.wait()

    def close(self) -> None:
        """End it and all that its earlier processes have left behind."""
        self._closed.set()
        self.kill()
        for group in self.groups:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(group, signal.SIGKILL)

    def _supervise(self) -> None:
        while not self._closed.wait(1.0):
            if not self._is_down and self._process.poll() is not None:
                self.start()


class ProcessInfo(NamedTuple):
    """A running process."""

    pid: int
    parent: int
    command: str
    cpu_s: float  # user and system time


def processes_of(group: int) -> Iterator[ProcessInfo]:
    """Processes of a group."""
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended
            _state, parent, own, *fields = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(own) == group:
                command = (folder / "cmdline").read_text().replace("\0", " ")
                cpu_s = sum(map(int, fields[8:10])) / os.sysconf("SC_CLK_TCK")
                yield ProcessInfo(int(folder.name), int(parent), command, cpu_s)


def is_running(pid: int) -> bool:
    """True if a process has not ended."""
    try:
        return (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
