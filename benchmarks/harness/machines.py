"""Machines of a site in small: namespaces of the network that can be cut off, and services under a supervisor."""

import contextlib
import os
import signal
import subprocess
import threading
from pathlib import Path


class Network:
    """A bridge of this machine, with an address, to namespaces of the network, each of which can be cut off.

    Only root can make it. `failure` says why there is none; then all processes are on the loopback.
    """

    def __init__(self, count: int) -> None:
        subnet, self._bridge = f"10.213.{os.getpid() % 256}", f"rw{os.getpid()}"  # there may be others on this machine
        self._namespaces = [f"{self._bridge}-{number}" for number in range(count)]
        self.address, self.failure = f"{subnet}.1", ""
        try:
            _ip(f"link add {self._bridge} type bridge")
            _ip(f"addr add {self.address}/24 dev {self._bridge}")
            _ip(f"link set {self._bridge} up")
            for number, name in enumerate(self._namespaces):
                _ip(f"netns add {name}")
                _ip(f"link add {name} master {self._bridge} type veth peer name eth0 netns {name}")
                _ip(f"-n {name} addr add {subnet}.{number + 2}/24 dev eth0")
                _ip(f"-n {name} link set lo up")
                _ip(f"-n {name} link set eth0 up")
                self.set_link(number, "up")
        except (OSError, subprocess.CalledProcessError) as error:
            self.close()
            self.address, self.failure = "127.0.0.1", str(getattr(error, "stderr", error)).strip()

    def command(self, number: int) -> list[str]:
        """Beginning of a command line that runs in a namespace."""
        return [] if self.failure else ["ip", "netns", "exec", self._namespaces[number]]

    def set_link(self, number: int, state: str) -> None:
        """Pull the cable of a namespace at the bridge (`down`), or plug it in (`up`)."""
        _ip(f"link set {self._namespaces[number]} {state}")

    def close(self) -> None:
        """Remove the namespaces, whose processes have ended, and the bridge."""
        for command in (*(f"netns del {name}" for name in self._namespaces), f"link del {self._bridge}"):
            with contextlib.suppress(OSError, subprocess.CalledProcessError):
                _ip(command)


def _ip(arguments: str) -> None:
    subprocess.run(["ip", *arguments.split()], check=True, capture_output=True, text=True)


class Service:
    """A process in a process group of its own, started again a second after it ends by itself, as by a supervisor."""

    def __init__(self, command: list[str], log: Path, environment: dict[str, str]) -> None:
        self._command, self._log, self._environment = command, log, {**os.environ, **environment}
        self.groups: list[int] = []
        self._closed = threading.Event()
        self.start()
        threading.Thread(target=self._supervise, daemon=True).start()

    def start(self) -> None:
        """Start it."""
        with self._log.open("ab") as said:
            self._process = subprocess.Popen(
                self._command, env=self._environment, stdout=said, stderr=said, process_group=0, cwd=self._log.parent
            )
        self.groups.append(self._process.pid)
        self._is_down = False

    def signal(self, number: int) -> None:
        """Send a signal to the group."""
        os.killpg(self.groups[-1], number)

    def kill(self) -> None:
        """End it as the end of its machine does, with all that earlier processes have left; it stays down."""
        self._is_down = True
        for group in self.groups:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(group, signal.SIGKILL)
        self._process.wait()

    def close(self) -> None:
        """End it for good."""
        self._closed.set()
        self.kill()

    def _supervise(self) -> None:
        while not self._closed.wait(1.0):
            if not self._is_down and self._process.poll() is not None:
                self.start()
