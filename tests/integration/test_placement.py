"""Shards of a fleet on a Dask cluster: they are placed, found again by a client that was killed, moved and fenced."""

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import msgspec
import pytest

from benchmarks.soak.site import Lines
from reactorwatch.cli.processes import write_settings
from reactorwatch.contract import keys
from reactorwatch.runtime.bus_zenoh import ZenohBus
from reactorwatch.runtime.config import BusConfig
from tests.cluster import Cluster, signal_group
from tests.unit.monitor_node.fleets import QUICK

from .client import client

START_WITHIN_S = 240.0
"""Workers import this software, and where no monitor of a fleet ever ran, the first one compiles before it joins."""


class Monitors:
    """Living monitors of a fleet by shard, by their liveliness tokens."""

    def __init__(self, bus: ZenohBus) -> None:
        self._changed = threading.Condition()
        self._tokens: set[str] = set()
        bus.subscribe_liveliness(keys.FLEET_TOKENS, self._on_token)

    def wait_for(self, condition: Callable[[dict[str, int]], bool]) -> dict[str, int]:
        """Wait until the process numbers of the shards' monitors fulfil a condition, and return them."""
        with self._changed:
            assert self._changed.wait_for(lambda: condition(self._processes()), START_WITHIN_S), self._tokens
            return self._processes()

    def _processes(self) -> dict[str, int]:
        shards = {}
        for token in self._tokens:
            fleet = keys.parse_fleet_token(token)
            process = re.search(r"\.(\d+)@", token)
            assert fleet is not None
            assert process is not None
            shards[f"{fleet.number}/{fleet.of}"] = int(process[1])
        return shards

    def _on_token(self, key: str, is_alive: bool) -> None:
        with self._changed:
            (self._tokens.add if is_alive else self._tokens.discard)(key)
            self._changed.notify_all()


class Site:
    """A cluster, and the command that places the shards on it."""

    def __init__(self, bus: BusConfig, folder: Path, shards: int, settings: dict[str, str]) -> None:
        self._folder = folder
        write_settings(folder / "settings.toml", {"bus": bus, "monitor": QUICK})
        self.cluster = Cluster(folder, settings)
        self.command, self.log = self.start(shards)

    def start(self, shards: int = 2) -> "tuple[subprocess.Popen[str], Lines]":
        """Start the command; returns it with the lines of its log."""
        where = ("--scheduler", self.cluster.address, "--state", str(self._folder / "states"))
        what = ("--plants", "reactor/*", "--shards", str(shards), "--config", str(self._folder / "settings.toml"))
        command = [sys.executable, "-m", "reactorwatch", "monitor", *what, *where]
        pipe = subprocess.PIPE
        self.command = subprocess.Popen(command, stdout=pipe, stderr=subprocess.STDOUT, text=True)
        self.log = Lines(self.command)
        return self.command, self.log

    def worker_of(self, process: int) -> "subprocess.Popen[bytes]":
        """Worker whose task runs a monitor."""
        (worker,) = (worker for worker in self.cluster.workers if os.getpgid(process) == worker.pid)
        return worker

    def close(self) -> None:
        """Kill all of it."""
        self.command.kill()
        self.command.wait()
        self.log.close()
        self.cluster.close()


@contextmanager
def placed(bus: BusConfig, folder: Path, shards: int, workers: int, **settings: str) -> Iterator[tuple[Site, Monitors]]:
    with client(bus) as observer, closing(Site(bus, folder, shards, settings)) as site:
        for _ in range(workers):
            site.cluster.start_worker()
        yield site, Monitors(observer)


def test_a_killed_command_finds_its_shards_again_and_a_stopped_one_ends_them(
    bus_config: BusConfig, tmp_path: Path
) -> None:
    with placed(bus_config, tmp_path, shards=2, workers=3) as (site, monitors):
        first = monitors.wait_for(lambda shards: len(shards) == 2)
        assert set(first) == {"1/2", "2/2"}
        site.command.kill()
        site.command.wait()
        again, log = site.start()
        log.wait_for(lambda lines: sum("placed" in line for line in lines) == 2)
        assert monitors.wait_for(lambda shards: len(shards) == 2) == first
        again.terminate()
        assert again.wait(START_WITHIN_S) == 0
        monitors.wait_for(lambda shards: not shards)
        log.close()
        assert not [line for line in log.lines if "ended" in line]


@pytest.mark.slow
def test_after_a_change_of_the_settings_the_shards_of_a_killed_command_are_replaced(
    bus_config: BusConfig, tmp_path: Path
) -> None:
    with placed(bus_config, tmp_path, shards=2, workers=3) as (site, monitors):
        first = monitors.wait_for(lambda shards: len(shards) == 2)
        site.command.kill()
        site.command.wait()
        site.start(shards=3)
        others = monitors.wait_for(lambda shards: set(shards) == {"1/3", "2/3", "3/3"})
        assert not set(others.values()) & set(first.values())


@pytest.mark.slow
def test_shards_that_wait_for_a_worker_are_replaced_and_ended_like_those_that_run(
    bus_config: BusConfig, tmp_path: Path
) -> None:
    """One worker for two shards; the settings change, but for their number."""
    with placed(bus_config, tmp_path, shards=2, workers=1) as (site, monitors):
        (first,) = monitors.wait_for(lambda shards: len(shards) == 1).items()
        site.log.wait_for(lambda lines: sum("placed" in line for line in lines) == 2)
        site.command.kill()
        site.command.wait()
        bus = msgspec.structs.replace(bus_config, cache_messages=9999)
        write_settings(tmp_path / "settings.toml", {"bus": bus, "monitor": QUICK})
        again, _ = site.start()
        monitors.wait_for(lambda shards: len(shards) == 1 and first not in shards.items())
        again.terminate()
        assert again.wait(START_WITHIN_S) == 0
        monitors.wait_for(lambda shards: not shards)
        site.cluster.start_worker()
        third, log = site.start()
        assert len(monitors.wait_for(lambda shards: len(shards) == 2)) == 2
        third.terminate()
        assert third.wait(START_WITHIN_S) == 0
        log.close()


@pytest.mark.slow
def test_shards_move_from_machines_that_are_lost_or_stalled_and_come_back_after_their_scheduler(
    bus_config: BusConfig, tmp_path: Path
) -> None:
    """No death of a worker is allowed, so the first one makes Dask give its task up."""
    with placed(bus_config, tmp_path, 1, 2, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="0") as (site, monitors):
        (first,) = monitors.wait_for(lambda shards: len(shards) == 1).values()
        signal_group(site.worker_of(first), signal.SIGKILL)
        (second,) = monitors.wait_for(lambda shards: shards not in ({}, {"1/1": first})).values()
        site.cluster.start_worker()
        stalled = site.worker_of(second)
        signal_group(stalled, signal.SIGSTOP)
        (third,) = monitors.wait_for(lambda shards: shards not in ({}, {"1/1": second})).values()
        signal_group(stalled, signal.SIGCONT)
        stalled.wait(START_WITHIN_S)
        signal_group(site.cluster.scheduler, signal.SIGKILL)
        site.cluster.scheduler.wait()
        monitors.wait_for(lambda shards: not shards)  # it ends with its scheduler
        site.cluster.start_scheduler()
        site.cluster.start_worker()
        monitors.wait_for(lambda shards: shards not in ({}, {"1/1": third}))
    assert any("shard=1/1" in line and "worker" in line and "died" in line for line in site.log.lines), site.log.lines


@pytest.mark.slow
def test_a_shard_that_cannot_run_is_tried_again_and_the_reason_logged(bus_config: BusConfig, tmp_path: Path) -> None:
    (tmp_path / "states").mkdir()
    (tmp_path / "states" / "1-of-1").write_text("no folder", encoding="utf-8")
    with placed(bus_config, tmp_path, shards=1, workers=1) as (site, monitors):
        site.log.wait_for(lambda lines: sum("exit_code=2" in line and "1-of-1" in line for line in lines) == 2)
        (tmp_path / "states" / "1-of-1").unlink()
        assert monitors.wait_for(lambda shards: len(shards) == 1)
