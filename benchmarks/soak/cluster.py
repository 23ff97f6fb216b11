"""A soak's shards on a Dask cluster: a scheduler, a worker more than shards, and the command that places them.

A worker is a machine in small: worker and monitor are one process group, in a namespace of the network of its own, and
a supervisor starts again what ends. Nothing else knows where a shard runs but its liveliness token.
"""

import os
import re
import signal
import sys
import time
from collections import defaultdict
from collections.abc import Collection
from pathlib import Path

from benchmarks.harness.machines import Network, Service
from benchmarks.soak.findings import Placement, Strike, count_superseded, own_memory_mb
from benchmarks.soak.plan import Blow, Plan
from benchmarks.soak.site import FLEET, PATIENCE_S, ROOT, Site, Witness
from monitor_node.fleet import FleetConfig, shard_of
from reactorwatch.cli.processes import write_settings
from reactorwatch.contract.keys import parse_fleet_token
from reactorwatch.runtime.http_pages import free_port

DASK = {"DASK_CONFIG": str(ROOT / "deploy" / "dask")}
END_WITHIN_S = 60.0


class Cluster(Site):
    """The processes, as long as the context lasts."""

    def __init__(self, plan: Plan, folder: Path, zero_ns: int) -> None:
        self._network = Network(plan.shards + 1)
        super().__init__(plan, folder, zero_ns, self._network.address)
        self._address = f"tcp://{self._network.address}:{free_port()}"
        self._services: dict[str, Service] = {}
        self._began_s = 0.0
        self._cpu_s: dict[str, float] = {}
        self._cpu_percent: dict[str, float] = {}
        self._strikes: list[Strike] = []
        self._ends: list[tuple[str, float | None]] = []

    def start_monitors(self) -> None:
        """Start the cluster, and the command that places the shards on it."""
        settings = self._folder / "settings.toml"
        fleet = FleetConfig(state=str(self._folder / "states"))
        write_settings(settings, {"bus": self.bus, "monitor": self._plan.monitor, "fleet": fleet})
        dask = [sys.executable, "-m", "dask"]
        host, port = self._address.removeprefix("tcp://").split(":")
        self._start_service("scheduler", [*dask, "scheduler", "--host", host, "--port", port, "--no-dashboard"])
        options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--resources", "monitor=1"]
        for number in range(self._plan.shards + 1):
            command = [*self._network.command(number), *dask, "worker", self._address, *options]
            self._start_service(f"worker {number + 1}", command)
        command = [sys.executable, "-m", "reactorwatch", "monitor", "--plants", FLEET, "--config", str(settings)]
        self._start_service("client", [*command, "--shards", str(self._plan.shards), "--scheduler", self._address])

    def begin_disturbances(self) -> None:
        """Measure the share of a core from now until the first blow."""
        self._began_s, self._cpu_s = time.monotonic(), self._read_cpu_s()

    def disturb(self, blow: Blow, witness: Witness) -> None:
        """Strike a blow, and wait until all shards are there again, and a worker to spare."""
        if not self._cpu_percent:
            percent = 100.0 / (time.monotonic() - self._began_s)
            self._cpu_percent = {
                name: percent * (taken_s - self._cpu_s[name]) for name, taken_s in self._read_cpu_s().items()
            }
        verb, name = blow.kind.split()
        if verb == "cut" and self._network.failure:
            return
        end, shard, monitors, plants = blow.row + blow.rows, blow.monitor + 1, _monitors(witness), self._plan.plants
        self.allow(end + 1)
        if name == "worker":
            monitors = {shard: monitors[shard]}
            plants = tuple(plant for plant in plants if shard_of(plant, self._plan.shards) == shard)
            group = os.getpgid(monitors[shard])
            name = next(name for name, service in self._services.items() if service.groups[-1] == group)
        service, machine = self._services[name], list(self._services).index(name) - 1
        begin, undo = {
            "kill": (service.kill, service.start),
            "stop": (lambda: service.signal(signal.SIGSTOP), lambda: service.signal(signal.SIGCONT)),
            "cut": (lambda: self._network.set_link(machine, "down"), lambda: self._network.set_link(machine, "up")),
        }[verb]
        begin()
        self._strikes.append(Strike(blow.kind, self.row, time.time(), plants, name == "scheduler"))
        self.wait_for_row(end)
        undo()
        if blow.kind not in ("kill worker", "kill client"):  # its monitors must end by themselves
            self._ends.append((blow.kind, _wait_for_end(monitors.values())))
        self._wait_until_whole(witness)

    def placement(self, witness: Witness) -> Placement:
        """Findings about the placement."""
        return Placement(
            recoveries=[(strike.kind, strike.recovery_s(witness.judged)) for strike in self._strikes],
            ends=self._ends,
            cpu_percent=self._cpu_percent,
            superseded=count_superseded(witness.judged),
            starts={name: len(service.groups) for name, service in self._services.items()},
            skipped=self._network.failure,
        )

    def __exit__(self, *exception: object) -> None:
        """End all of it."""
        for service in reversed(self._services.values()):
            service.close()
        super().__exit__(*exception)
        self._network.close()

    def _start_service(self, name: str, command: list[str]) -> None:
        self._services[name] = Service(command, self._folder / f"{name.replace(' ', '')}.log", DASK)

    def _read_cpu_s(self) -> dict[str, float]:
        """User and system time of client, scheduler and all workers, without their children, the monitors."""
        taken: dict[str, float] = defaultdict(float)
        for name, service in self._services.items():
            fields = Path(f"/proc/{service.groups[-1]}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
            taken[name.split()[0]] += sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")
        return taken

    def _wait_until_whole(self, witness: Witness) -> None:
        from distributed import Client

        shards = self._plan.shards
        assert witness.wait(lambda: len(witness.tokens) == len(_monitors(witness)) == shards), witness.tokens
        with Client(self._address, timeout=PATIENCE_S, set_as_default=False) as client:
            client.wait_for_workers(shards + 1, timeout=PATIENCE_S)


def _monitors(witness: Witness) -> dict[int, int]:
    """Process of each shard's monitor, by the liveliness tokens."""
    tokens = [parse_fleet_token(token) for token in witness.tokens]
    return {int(token.number): int(re.split("[.@]", token.name)[1]) for token in tokens if token is not None}


def _wait_for_end(pids: Collection[int]) -> float | None:
    """Wait for the end of processes; returns the time that it took, None if one did not end."""
    began_s = time.monotonic()
    while any(own_memory_mb(pid) for pid in pids):
        if time.monotonic() - began_s > END_WITHIN_S:
            return None
        time.sleep(0.1)
    return time.monotonic() - began_s
