"""A machine of its own for a page of documentation: its own loopback, with the addresses that pages name.

Network and mounts are namespaces of this process's children, so the router of a page is at its usual port, an example's
address is reached, and what goes to `/var/lib` is gone afterwards.
"""

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

import pytest

ADDRESS = "192.0.2.1"
"""Of another machine on pages (RFC 5737)."""
HOST = "bus.example"
WITHIN_S = 120.0

_BEGIN = f"""
set -e
ip link set lo up
ip address add {ADDRESS}/32 dev lo
mount --bind "$1" /etc/hosts
mount -t tmpfs tmpfs /var/lib
echo ready
exec cat
"""


class Started:
    """A command that runs on, and its output so far."""

    def __init__(self, command: str, process: subprocess.Popen[str]) -> None:
        self.command, self.process = command, process
        self._output, self._ended, self._changed = "", False, threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._changed:
                self._output += line
                self._changed.notify_all()
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def wait_for(self, pattern: str) -> None:
        """Wait until a pattern is found in its output."""
        with self._changed:
            self._changed.wait_for(lambda: bool(re.search(pattern, self._output)) or self._ended, WITHIN_S)
            assert re.search(pattern, self._output), f"{self.command}: no {pattern!r} in its output:\n{self._output}"

    def end(self) -> None:
        """End it as Ctrl-C does; it ends well."""
        self.process.send_signal(signal.SIGINT)
        try:
            code = self.process.wait(WITHIN_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            code = self.process.wait()
        self._reader.join(WITHIN_S)
        assert self.process.stdout is not None
        self.process.stdout.close()
        assert code in (0, 130), f"{self.command}: ended with {code}:\n{self._output}"
        assert "Traceback" not in self._output, f"{self.command}:\n{self._output}"


class Machine:
    """Runs commands in namespaces of their own; a context.

    Args:
        folder: for its list of hosts.
    """

    def __init__(self, folder: Path) -> None:
        hosts = folder / "hosts"
        hosts.write_text(f"127.0.0.1 localhost {HOST}\n", encoding="utf-8")
        self._as_user = [] if os.geteuid() == 0 else ["--user"]
        mapped = [*self._as_user, "--map-root-user"] if self._as_user else []
        self._holder = subprocess.Popen(
            ["unshare", *mapped, "--net", "--mount", "sh", "-c", _BEGIN, "sh", str(hosts)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self._holder.stdout is not None
        self.why = ""
        """Why there is none; empty if there is one."""
        if self._holder.stdout.readline() != "ready\n":
            self.why = "; ".join(self._holder.communicate()[1].splitlines()) or "unshare failed"
        self.started: list[Started] = []

    def _within(self, words: Sequence[str], folder: Path) -> list[str]:
        if self.why:
            pytest.skip(f"namespaces cannot be made here: {self.why}")
        user = [*self._as_user, "--preserve-credentials"] if self._as_user else []
        program = Path(sys.executable).with_name(Path(words[0]).name)
        inside = ["nsenter", f"--target={self._holder.pid}", *user, "--net", "--mount", "env", "-C", str(folder)]
        return [*inside, str(program) if program.exists() else words[0], *words[1:]]

    def run(self, words: Sequence[str], folder: Path) -> subprocess.CompletedProcess[str]:
        """Run a command to its end."""
        command = self._within(words, folder)
        return subprocess.run(command, capture_output=True, text=True, timeout=WITHIN_S, check=False)

    def start(self, words: Sequence[str], folder: Path, until: str) -> None:
        """Start a command and wait for a pattern in its output; it runs on."""
        process = subprocess.Popen(
            self._within(words, folder), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self.started.append(Started(" ".join(words), process))
        self.started[-1].wait_for(until)

    def end_started(self) -> None:
        """End what runs on, the newest first."""
        while self.started:
            self.started[-1].end()
            self.started.pop()

    def close(self) -> None:
        """End everything, whatever state it is in: a supervisor ends its nodes if it is asked to."""
        for started in self.started:
            with contextlib.suppress(AssertionError):
                started.end()
        if self._holder.poll() is None:
            self._holder.communicate()
