"""Nodes as processes, under one supervisor that is also their router.

A node is started as `python -m plant_node SETTINGS`, in a session of its own, so that Ctrl-C on the terminal reaches
the supervisor only. It then stops the nodes one after the other: the plant first, the recorder last. Each node reads a
pipe of which the supervisor alone holds the other end, and ends when it closes, by whatever end of the supervisor.
"""

import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
import structlog

from reactorwatch.records.write import atomic_write
from reactorwatch.runtime.node_main import SUPERVISED

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
    """Running nodes, as a context that ends them.

    Args:
        settings: settings file by node.
        logs: folder for their output; None: this process's standard error.
    """

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
