"""A soak's shards on a Dask cluster: a scheduler, a worker more than shards, and the command that places them.

A worker is a machine in small: worker and monitor are one process group, in a namespace of the network of its own, and
a supervisor starts again what ends. Nothing else knows where a shard runs but its liveliness token.
"""

import os
import re
import signal
import sys
import threading
import time
from collections.abc import Iterable
from pathlib import Path

from benchmarks.harness.machines import Network, Service, is_running, processes_of
from benchmarks.soak.findings import Placement, Strike
from benchmarks.soak.plan import Blow, Plan
from benchmarks.soak.site import FLEET, PATIENCE_S, Site, Witness
from monitor_node.fleet import FleetConfig, shard_of
from reactorwatch.cli.processes import write_settings
from reactorwatch.contract.keys import parse_fleet_token
from reactorwatch.runtime.http_pages import free_port

DASK = {
    "DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "5s",
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "false",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "2s",
    "DASK_DISTRIBUTED__ADMIN__SYSTEM_MONITOR__INTERVAL": "10s",
}
"""Settings of Dask for scheduler and workers that docs/fleet.md recommends."""

END_WITHIN_S = 60.0
MONITOR = "monitor_node"
"""What the command line of a monitor has, and no process of Dask's."""


class Cluster(Site):
    """The processes, as long as the context lasts."""

    def __init__(self, plan: Plan, folder: Path, zero_ns: int) -> None:
        self._network = Network(plan.shards + 1)
        super().__init__(plan, folder, zero_ns, self._network.address)
        self._address = f"tcp://{self._network.address}:{free_port()}"
        self._services: dict[str, Service] = {}
        self._strikes: list[Strike] = []
        self._began_s = 0.0
        self._cpu_s: dict[str, float] = {}
        self._cpu_percent: dict[str, float] = {}
        self._ends: list[float | None] = []
        self._lingered_s: list[float | None] = []

    def start_monitors(self) -> None:
        """Start the cluster, and the command that places the shards on it."""
        settings = self._folder / "settings.toml"
        fleet = FleetConfig(state=str(self._folder / "states"))
        write_settings(settings, {"bus": self.bus, "monitor": self._plan.monitor, "fleet": fleet})
        host, port = self._address.removeprefix("tcp://").split(":")
        dask = [sys.executable, "-m", "dask"]
        self._add("scheduler", [*dask, "scheduler", "--host", host, "--port", port, "--no-dashboard"])
        options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--resources", "monitor=1", "--memory-limit", "0"]
        for number in range(self._plan.shards + 1):
            command = [*self._network.command(number), *dask, "worker", self._address, *options]
            self._add(f"worker {number + 1}", command)
        command = [sys.executable, "-m", "reactorwatch", "monitor", "--plants", FLEET, "--config", str(settings)]
        self._add("client", [*command, "--shards", str(self._plan.shards), "--scheduler", self._address])

    def begin_disturbances(self) -> None:
        """Measure the share of a core from now until the first blow."""
        self._began_s, self._cpu_s = time.monotonic(), self._read_cpu_s()

    def disturb(self, blow: Blow, witness: Witness) -> None:
        """Strike a blow, and wait until all shards are there again, and a worker to spare."""
        if not self._cpu_percent:
            over_s = time.monotonic() - self._began_s
            self._cpu_percent = {
                name: 100.0 * (cpu_s - self._cpu_s[name]) / over_s for name, cpu_s in self._read_cpu_s().items()
            }
        verb, name = blow.kind.split()
        if verb == "cut" and self._network.failure:
            return
        end = blow.row + blow.rows
        self.allow(end + 1)
        monitors = _monitors(witness)
        struck = [monitors[blow.monitor + 1]] if name == "worker" else []
        if struck:
            name = next(name for name, service in self._services.items() if service.group == os.getpgid(*struck))
        service = self._services[name]
        match verb:
            case "kill":
                service.kill()
            case "stop":
                service.signal(signal.SIGSTOP)
            case "cut":
                self._network.cut(int(name.split()[1]) - 1, is_cut=True)
        plants = [
            plant for plant in self._plan.plants if not struck or shard_of(plant, self._plan.shards) == blow.monitor + 1
        ]
        self._strikes.append(Strike(blow.kind, self.row, time.time(), plants, name == "scheduler"))
        if name == "scheduler":
            threading.Thread(target=lambda: self._ends.append(_wait_for_end(monitors.values())), daemon=True).start()
        self.wait_for_row(end)
        match verb:
            case "kill":
                service.start()
            case "stop":
                service.signal(signal.SIGCONT)
            case "cut":
                self._network.cut(int(name.split()[1]) - 1, is_cut=False)
        if verb != "kill":
            self._lingered_s.append(_wait_for_end(struck))
        self._wait_until_whole(witness)

    def placement(self, witness: Witness) -> Placement:
        """Findings about the placement."""
        return Placement(
            recoveries=[(strike.kind, strike.recovery_s(witness.judged)) for strike in self._strikes],
            cpu_percent=self._cpu_percent,
            monitors_ended_s=self._ends[0] if self._ends else None,
            lingered_s=self._lingered_s,
            superseded=witness.superseded,
            starts={name: len(service.groups) for name, service in self._services.items()},
            skipped=self._network.failure,
        )

    def __exit__(self, *exception: object) -> None:
        """End all of it."""
        for service in reversed(self._services.values()):
            service.close()
        super().__exit__(*exception)
        self._network.close()

    def _add(self, name: str, command: list[str]) -> None:
        self._services[name] = Service(command, self._folder / f"{name.replace(' ', '')}.log", DASK)

    def _start_garbage(self) -> None:
        """There is none: what is late or lost here was lost by the placement."""

    def _watched_pids(self) -> dict[str, int]:
        return {name: self._services[name].group for name in ("client", "scheduler")}

    def _read_cpu_s(self) -> dict[str, float]:
        """Time that client, scheduler and all workers have taken, without the monitors and their processes."""
        taken = dict.fromkeys(("client", "scheduler", "workers"), 0.0)
        for name, service in self._services.items():
            processes = list(processes_of(service.group))
            monitors = {item.pid for item in processes if MONITOR in item.command}
            taken[name if name in taken else "workers"] += sum(
                item.cpu_s for item in processes if not monitors & {item.pid, item.parent}
            )
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


def _wait_for_end(pids: Iterable[int]) -> float | None:
    """Wait for the end of processes; returns the time that it took, None if one did not end."""
    began_s = time.monotonic()
    while any(is_running(pid) for pid in pids):
        if time.monotonic() - began_s > END_WITHIN_S:
            return None
        time.sleep(0.1)
    return time.monotonic() - began_s
