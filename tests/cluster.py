"""Dask clusters of this machine, for tests."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from reactorwatch.runtime.http_pages import free_port


@contextmanager
def dask_cluster(workers: int) -> Iterator[str]:
    """The address of its scheduler.

    Args:
        workers: how many, each a process.
    """
    distributed = pytest.importorskip("distributed", reason="Dask (reactorwatch[cluster]) is not installed")
    options = {"threads_per_worker": 1, "host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}  # 0: any free port
    with distributed.LocalCluster(n_workers=workers, **options) as running:
        yield running.scheduler_address


class Cluster:
    """A scheduler and workers for shards, each in a process group of its own, like a machine of its own.

    Args:
        folder: folder of their logs.
        settings: environment variables of the scheduler.
    """

    def __init__(self, folder: Path, settings: Mapping[str, str]) -> None:
        pytest.importorskip("distributed", reason="Dask (reactorwatch[cluster]) is not installed")
        self._folder, self._settings, self._port = folder, settings, free_port()
        self.address = f"tcp://127.0.0.1:{self._port}"
        self.scheduler = self.start_scheduler()
        self.workers: list[subprocess.Popen[bytes]] = []

    def start_scheduler(self) -> "subprocess.Popen[bytes]":
        """Start the scheduler, also in place of one that has ended."""
        options = ("--host", "127.0.0.1", "--port", str(self._port), "--dashboard-address", "127.0.0.1:0")
        self.scheduler = self._start("scheduler", *options)
        return self.scheduler

    def start_worker(self) -> "subprocess.Popen[bytes]":
        """Start a worker for one shard."""
        options = ("--host", "127.0.0.1", "--nthreads", "1", "--no-nanny", "--resources", "monitor=1")
        worker = self._start("worker", self.address, *options, "--no-dashboard")
        self.workers.append(worker)
        return worker

    def close(self) -> None:
        """Kill all of it."""
        for process in (self.scheduler, *self.workers):
            signal_group(process, signal.SIGKILL)
            process.wait()

    def _start(self, *command: str) -> "subprocess.Popen[bytes]":
        shipped = {"DASK_CONFIG": str(Path(__file__).parents[1] / "deploy" / "dask")}
        with (self._folder / f"{command[0]}.log").open("ab") as output:
            return subprocess.Popen(
                [sys.executable, "-m", "dask", *command],
                cwd=self._folder,
                env={**os.environ, **shipped, **self._settings},
                stdout=output,
                stderr=output,
                start_new_session=True,
            )


def signal_group(process: "subprocess.Popen[bytes]", number: int) -> None:
    """Send a signal to a process and its children, as far as they run."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, number)
