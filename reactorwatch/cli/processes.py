"""Nodes as processes, under one supervisor that is also their router; their settings files; the progress of a run.

A node is started as `python -m plant_node SETTINGS`, in a session of its own, so that Ctrl-C on the terminal reaches
the supervisor only. It then stops the nodes one after the other: the plant first, the recorder last. Each node reads a
pipe of which the supervisor alone holds the other end, and ends when it closes, by whatever end of the supervisor. In a
site each node has its own certificate, and so its own settings file with a `[bus]` table; the settings file beside them
is for observers, with the site's role viewer.
"""

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
import structlog

from reactorwatch.cli.options import check_input
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, decode
from reactorwatch.contract.messages_pb2 import Estimate, Sample
from reactorwatch.errors import InputError
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.records.write import atomic_write
from reactorwatch.runtime.bus_zenoh import ZenohBus, log_refusals, router, router_from_file
from reactorwatch.runtime.config import BusConfig, read_settings, section
from reactorwatch.runtime.node_main import SUPERVISED
from reactorwatch.runtime.provisioning import ROUTER, ROUTER_SETTINGS, SETTINGS
from recorder.config import RecorderConfig

log = structlog.get_logger()

MODULES = {
    "plant": "plant_node",
    "replay": "recorder.tools.replay",
    "monitor": "monitor_node",
    "diagnosis": "diagnosis_node",
    "recorder": "recorder",
}

STOP_WITHIN_S = 60.0
"""A stopping node drains its inbox for up to 5 s, and its bus closes within 11 s; longer on a busy machine."""


class Processes:
    """Running nodes, as a context that ends them."""

    def __init__(self, settings: Mapping[str, Path], logs: Path | None = None) -> None:
        self._settings = settings
        self._logs = logs
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, node: str) -> subprocess.Popen[bytes]:
        """Start a node, also one that has ended."""
        if node in self.exit_codes():
            self.stop([node])
        command = [sys.executable, "-P", "-m", MODULES[node], str(self._settings[node]), SUPERVISED]
        with nullcontext() if self._logs is None else (self._logs / f"{node}.log").open("wb") as output:
            process = subprocess.Popen(  # noqa: S603 (our own modules)
                command,
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=None if output is None else subprocess.STDOUT,
                start_new_session=True,
            )
        self._running[node] = process
        return process

    def exit_codes(self) -> dict[str, int]:
        """Exit codes of the nodes that ended by themselves."""
        codes = {node: process.poll() for node, process in self._running.items()}
        return {node: code for node, code in codes.items() if code is not None}

    def stop(self, nodes: Sequence[str]) -> dict[str, int]:
        """Ask nodes to end, one after the other, and wait for each; returns their exit codes."""
        codes = {}
        for node in nodes:
            process = self._running.pop(node, None)
            if process is None:
                continue
            if process.poll() is None:
                process.terminate()
            try:
                codes[node] = process.wait(STOP_WITHIN_S)
            except subprocess.TimeoutExpired:
                log.warning("did not stop when asked, killed", node=node, after_s=STOP_WITHIN_S)
                process.kill()
                codes[node] = process.wait()
            if process.stdin is not None:
                process.stdin.close()
        return codes

    def __enter__(self) -> Self:
        """Return the processes."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the running nodes, the recorder last."""
        self.stop([*(node for node in MODULES if node != "recorder"), "recorder"])


def write_settings(path: Path, tables: dict[str, msgspec.Struct]) -> None:
    """Write settings as TOML with every value, so that the file documents the run."""
    with atomic_write(path) as temporary:
        temporary.write_text(settings_text(tables), encoding="utf-8")


def settings_text(tables: dict[str, msgspec.Struct]) -> str:
    """Format settings as TOML with every value."""
    import tomli_w

    return tomli_w.dumps({name: _without_none(msgspec.to_builtins(table)) for name, table in tables.items()})


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    return value


VIEWER = "viewer"

ROLES = {
    "plant": "plant",
    "replay": "plant",
    "monitor": "monitor",
    "diagnosis": "monitor",
    "recorder": "recorder",
    VIEWER: VIEWER,
}
"""Roles in a site, by node; and the role of an observer."""

BusSettings = Mapping[str, BusConfig]
"""Bus settings by node, and of an observer."""


def load_bus_settings(
    site: Path | None, plant: str, tables: dict[str, dict[str, Any]], endpoint: str | None = None
) -> BusSettings:
    """Load the bus settings of each node."""
    if site is None:
        return dict.fromkeys(ROLES, section(BusConfig, "bus", tables, {"endpoint": endpoint}))
    if endpoint is not None:
        raise InputError(f"--endpoint {endpoint}: with --site the site has the address of its router; leave it out")
    settings = {}
    for node, role in ROLES.items():
        file = site.absolute() / plant / role / SETTINGS
        if not file.is_file():
            raise InputError(
                f"--site {site}: there is no {plant}/{role}/{SETTINGS} in it; "
                f"make it with: reactorwatch certify {site} --plant {plant}"
            )
        of_site = read_settings(file).get("bus", {})
        settings[node] = section(BusConfig, "bus", {"bus": {**tables.get("bus", {}), **of_site}}, {})
    return settings


@contextmanager
def open_router(site: Path | None, join: BusSettings) -> Iterator[ZenohBus]:
    """Run the nodes' router while the context lasts; that of a site logs refusals."""
    with nullcontext() if site is None else log_refusals():
        if site is None:
            bus = router(join[VIEWER])
        else:
            bus = router_from_file(check_input(site.absolute() / ROUTER / ROUTER_SETTINGS))
        try:
            yield bus
        finally:
            bus.close()


def restrict_to_plant(recorder: RecorderConfig, site: Path | None) -> RecorderConfig:
    """Restrict a recorder in a site to its plant: a wider subscription would be refused as a whole."""
    if site is None or recorder.key_expression != keys.EVERYTHING:
        return recorder
    return msgspec.structs.replace(recorder, key_expression=f"{keys.ROOT}/{recorder.plant}/**")


def write_node_settings(
    path: Path, recorder: RecorderConfig, tables: dict[str, msgspec.Struct], join: BusSettings, nodes: Sequence[str]
) -> dict[str, Path]:
    """Write the settings files of a run."""
    about = dict(recorder.about)
    about.setdefault("settings", settings_text({"bus": join[VIEWER], **tables}))
    tables = {**tables, "recorder": msgspec.structs.replace(recorder, about=about)}
    write_settings(path, {"bus": join[VIEWER], **tables})
    files = {}
    for node in nodes:
        files[node] = path
        if join[node] != join[VIEWER]:
            files[node] = path.with_suffix(f".{node}.toml")
            write_settings(files[node], {"bus": join[node], **tables})
    return files


DRAIN_WITHIN_S = 60.0
"""Time without another evaluated row after which a monitor is not waited for."""

POLL_S = 0.1
STEADY_POLLS = 5
"""Polls with every received row evaluated, after which no more rows are on their way."""


class RunProgress:
    """Progress of source and monitor."""

    def __init__(self, bus: ZenohBus, plant: str, span_ns: int | None = None) -> None:
        self._span_ns = span_ns
        self._lock = threading.Lock()
        self._first_ns: int | None = None
        self._newest_ns = 0
        self._evaluated_ns = 0
        bus.subscribe(keys.all_keys(plant, keys.SAMPLE), self._on_sample)
        bus.subscribe(keys.all_keys(plant, keys.ESTIMATE), self._on_estimate)

    @property
    def started(self) -> bool:
        """True once a sample has arrived."""
        return self._first_ns is not None

    @property
    def plant_min(self) -> float:
        """Plant time since the first sample, in minutes."""
        with self._lock:
            return 0.0 if self._first_ns is None else (self._newest_ns - self._first_ns) / MINUTE_NS

    def wait_until_evaluated(self, wait: Callable[[float], bool]) -> None:
        """Wait until the monitor has evaluated the last row; call it when all samples are published."""
        before, since, steady = -1, time.monotonic(), 0
        while not wait(POLL_S):
            evaluated_ns, all_evaluated = self._state()
            if all_evaluated and self._span_ns is not None:
                return
            steady = steady + 1 if all_evaluated else 0
            if evaluated_ns != before:
                before, since = evaluated_ns, time.monotonic()
            if steady >= STEADY_POLLS or time.monotonic() - since > DRAIN_WITHIN_S:
                return

    def _state(self) -> tuple[int, bool]:
        """Time of the newest evaluated row, and whether it is the last row, as far as that is known."""
        with self._lock:
            last_ns = self._newest_ns
            if self._span_ns is not None and self._first_ns is not None:
                last_ns = self._first_ns + self._span_ns
            return self._evaluated_ns, self._first_ns is not None and self._evaluated_ns >= last_ns

    def _on_sample(self, message: Encoded) -> None:
        sample = decode(message.payload, message.encoding)
        assert isinstance(sample, Sample)
        with self._lock:
            self._first_ns = sample.time_ns if self._first_ns is None else self._first_ns
            self._newest_ns = max(self._newest_ns, sample.time_ns)

    def _on_estimate(self, message: Encoded) -> None:
        estimate = decode(message.payload, message.encoding)
        assert isinstance(estimate, Estimate)
        with self._lock:
            self._evaluated_ns = max(self._evaluated_ns, estimate.time_ns)
