"""The processes of a soak, their disturbances, and an observer on a link that is never cut.

A router, two monitors with a shard of the fleet each, two processes of plants, a source of garbage.
The links of both monitors and of the second half of the plants go through proxies.
"""

import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from benchmarks.harness.site import Proxy, Router, connect_client
from benchmarks.soak import garbage, publisher
from benchmarks.soak.findings import Judged, Taken, own_memory_mb
from benchmarks.soak.plan import Blow, Plan
from monitor_node.fleet import FleetConfig
from monitor_node.health import NODE
from reactorwatch.cli.processes import write_settings
from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, decode
from reactorwatch.contract.messages_pb2 import Alarm, Health
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.http_pages import LOOPBACK, free_endpoint

ROOT = Path(__file__).parents[2]
MONITORS = PARTS = 2
FLEET = f"{keys.ROOT}/*"
PATIENCE_S = 300.0
KEPT_S = 60.0
"""Time span of messages that each publisher keeps: longer than any blow lasts."""


class Lines:
    """Lines that a process prints."""

    def __init__(self, process: "subprocess.Popen[str]", on_line: Callable[[str], None] = lambda _: None) -> None:
        self._changed = threading.Condition()
        self._on_line = on_line
        self.lines: list[str] = []
        self._ended = False
        self._thread = threading.Thread(target=self._read, args=(process,), daemon=True)
        self._thread.start()

    def wait_for(self, condition: Callable[[list[str]], bool]) -> None:
        """Wait until the lines fulfil a condition."""
        with self._changed:
            self._changed.wait_for(lambda: condition(self.lines) or self._ended, PATIENCE_S)
            assert condition(self.lines), f"said no more after {self.lines[-1:]}"

    def close(self) -> None:
        """Wait for the last line of a process that was ended."""
        self._thread.join()

    def _read(self, process: "subprocess.Popen[str]") -> None:
        assert process.stdout is not None
        with process.stdout as said:
            for line in said:
                self._on_line(line)
                with self._changed:
                    self.lines.append(line.rstrip("\n"))
                    self._changed.notify_all()
        with self._changed:
            self._ended = True
            self._changed.notify_all()


class Site:
    """The processes, as long as the context lasts."""

    def __init__(self, plan: Plan, folder: Path, zero_ns: int, address: str = LOOPBACK) -> None:
        self._plan, self._folder, self._zero_ns = plan, folder, zero_ns
        endpoint = free_endpoint().replace(LOOPBACK, address)
        self.bus = BusConfig(endpoint=endpoint, cache_messages=round(KEPT_S * plan.rows_per_s), history_s=KEPT_S)
        self.router = Router(endpoint)
        self._proxies = [Proxy(endpoint) for _ in range(MONITORS + 1)]
        self._monitors: list[subprocess.Popen[bytes]] = []
        self._plants: list[subprocess.Popen[str]] = []
        self._garbage: subprocess.Popen[str] | None = None
        self._said: dict[str, Lines] = {}
        self.memory: dict[str, list[Taken]] = {}
        """Memory of each process in the course of the run."""

    # --- start and end ---------------------------------------------------------------------------------------

    def start_monitors(self) -> None:
        """Start both."""
        self._monitors = [self._monitor(number) for number in range(MONITORS)]

    def start_plants(self) -> None:
        """Start the plants, which wait for permission to publish, and the source of garbage."""
        plan = self._plan
        for part in range(PARTS):
            bus = self._via(MONITORS) if part else self.bus
            task = publisher.Task(
                plan.seed, len(plan.plants), plan.rows, plan.rows_per_s, part, PARTS, self._zero_ns, bus
            )
            process = self._start(publisher, task)
            self._plants.append(process)
            self._said[f"plants {part + 1}"] = Lines(process, self._measure if part == 0 else lambda _: None)
        if not plan.shards:  # on a cluster, what is late or lost was lost by the placement
            self._garbage = self._start(garbage, garbage.Task(plan.seed, plan.plants, self._zero_ns, self.bus))
            self._said["garbage"] = Lines(self._garbage)
        for said in self._said.values():
            said.wait_for(lambda lines: bool(lines))

    def allow(self, rows: int) -> None:
        """Let the plants publish up to a row."""
        for process in self._plants:
            _tell(process, str(rows))

    def wait_for_row(self, row: int) -> None:
        """Wait until all plants have published it."""
        for part in range(PARTS):
            self._said[f"plants {part + 1}"].wait_for(lambda lines: lines[-1] != "ready" and int(lines[-1]) >= row)

    @property
    def row(self) -> int:
        """Newest row of the first plants."""
        last = self._said["plants 1"].lines[-1]
        return -1 if last == "ready" else int(last)

    def begin_disturbances(self) -> None:
        """The plants are known; begin the garbage."""
        assert self._garbage is not None
        _tell(self._garbage, "begin")

    def end_garbage(self) -> int:
        """End the garbage; returns the number of its messages."""
        if self._garbage is None:
            return 0
        assert self._garbage.stdin is not None
        self._garbage.stdin.close()
        self._garbage.wait(PATIENCE_S)
        self._said["garbage"].wait_for(lambda lines: lines[-1].isdigit())
        return int(self._said["garbage"].lines[-1])

    def __enter__(self) -> "Site":
        """The site itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """End all of it."""
        others = self._plants if self._garbage is None else [*self._plants, self._garbage]
        processes: list[subprocess.Popen[Any]] = [*self._monitors, *others]
        for process in processes:
            process.kill()
            process.wait()
            if process.stdin is not None:
                process.stdin.close()
        for said in self._said.values():
            said.close()
        for proxy in self._proxies:
            proxy.close()
        self.router.close()

    def _via(self, proxy: int) -> BusConfig:
        return msgspec.structs.replace(self.bus, endpoint=self._proxies[proxy].endpoint)

    def _monitor(self, number: int) -> "subprocess.Popen[bytes]":
        states = self._folder / f"states{number + 1}"
        fleet = FleetConfig(plants=FLEET, shard=f"{number + 1}/{MONITORS}", state=str(states))
        settings = self._folder / f"monitor{number + 1}.toml"
        write_settings(settings, {"bus": self._via(number), "monitor": self._plan.monitor, "fleet": fleet})
        command = [sys.executable, "-m", "reactorwatch", "monitor", "--config", str(settings)]
        with settings.with_suffix(".log").open("ab") as said:
            return subprocess.Popen(command, stderr=said)

    def _start(self, module: Any, task: msgspec.Struct) -> "subprocess.Popen[str]":
        command = [sys.executable, "-m", module.__name__, msgspec.json.encode(task).decode()]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT)

    # --- disturbances ---------------------------------------------------------------------------------------

    def disturb(self, blow: Blow, witness: "Witness") -> None:
        """Strike a blow, and wait until all processes are there again."""
        end = blow.row + blow.rows
        self.allow(end + 1)
        if blow.kind == "kill monitor":
            self._monitors[blow.monitor].kill()
            self._monitors[blow.monitor].wait()
            witness.wait_for_monitors(MONITORS - 1)
            self.wait_for_row(end)
            self._monitors[blow.monitor] = self._monitor(blow.monitor)
        elif blow.kind == "kill router":
            self.router.kill()
            self.wait_for_row(end)
            self.router.restart()
        elif blow.kind == "flood":
            assert self._garbage is not None
            floods = self._said["garbage"].lines.count("flooded")
            _tell(self._garbage, "flood")
            self._said["garbage"].wait_for(lambda lines: lines.count("flooded") > floods)
        else:
            with self._proxies[blow.monitor if blow.kind == "cut monitor" else MONITORS].cut(blow.manner):
                self.wait_for_row(end)
        witness.wait_for_monitors(MONITORS)

    # --- memory ----------------------------------------------------------------------------------------------

    def _measure(self, line: str) -> None:
        """Record the memory of each process, at every row that the first plants publish."""
        if not line.strip().isdigit():
            return
        numbers = {"router": self.router.pid}
        numbers |= {f"monitor {number + 1}": process.pid for number, process in enumerate(self._monitors)}
        numbers |= {f"plants {part + 1}": process.pid for part, process in enumerate(self._plants)}
        for name, pid in numbers.items():
            taken = own_memory_mb(pid)
            if taken:
                self.memory.setdefault(name, []).append(Taken(int(line), pid, taken))


def _tell(process: "subprocess.Popen[str]", line: str) -> None:
    assert process.stdin is not None
    process.stdin.write(f"{line}\n")
    process.stdin.flush()


class Witness:
    """Collects alarms, health and tokens of the monitors."""

    def __init__(self, config: BusConfig) -> None:
        self._changed = threading.Condition()
        self.tokens: set[str] = set()
        self.alarms: dict[str, list[Alarm]] = {}
        self.health: dict[str, Health] = {}
        self.longest_lag_ms = 0.0
        self.judged: dict[str, list[Judged]] = {}
        """Number of judged rows of each plant, whenever its health arrived."""
        self._bus = connect_client(config)
        self._bus.subscribe_liveliness(f"{keys.ROOT}/{keys.FLEET}/**", self._on_token)
        self._bus.subscribe(f"{FLEET}/{keys.ALARM}/**", self._on_message)
        self._bus.subscribe(f"{FLEET}/{keys.HEALTH}/{NODE}", self._on_message)

    def wait_for_monitors(self, count: int) -> None:
        """Wait for a number of live monitors."""
        assert self.wait(lambda: len(self.tokens) == count), f"not {count} monitors, but {self.tokens}"

    def wait(self, condition: Callable[[], bool], within_s: float = PATIENCE_S) -> bool:
        """Wait for a condition on the messages; returns True if it holds."""
        with self._changed:
            return self._changed.wait_for(condition, within_s)

    def close(self) -> None:
        """Close the link."""
        self._bus.close()

    def _on_token(self, key: str, is_alive: bool) -> None:
        with self._changed:
            (self.tokens.add if is_alive else self.tokens.discard)(key)
            self._changed.notify_all()

    def _on_message(self, message: Encoded) -> None:
        topic = keys.parse(message.key)
        try:
            body = decode(message.payload, message.encoding)
        except DecodeError:
            return  # garbage
        if topic is None:
            return
        with self._changed:
            if isinstance(body, Health):
                self.health[topic.plant] = body
                self.longest_lag_ms = max(self.longest_lag_ms, body.lag_ms)
                start_s = body.time_ns / 1e9 - body.uptime_s
                self.judged.setdefault(topic.plant, []).append(Judged(time.time(), body.rows, start_s))
            elif isinstance(body, Alarm) and body.alarm == topic.name:
                self.alarms.setdefault(topic.plant, []).append(body)
            self._changed.notify_all()
