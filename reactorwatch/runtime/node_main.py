"""Entry of a node's process: `python -m NODE [settings.toml]`."""

import os
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import msgspec

from reactorwatch.runtime import logs
from reactorwatch.runtime.config import BusConfig, LogConfig, MetricsConfig, read_settings, section
from reactorwatch.runtime.crash import UNUSABLE, guard, print_error

Config = TypeVar("Config", bound=msgspec.Struct)

SUPERVISED = "--supervised"
"""Last argument of a node that ends, as by SIGTERM, when its standard input does: its supervisor has ended."""


def main(module: str, table: str, kind: type[Config], run: Callable[[Config, BusConfig, MetricsConfig], object]) -> int:
    """Read the settings file that the command line names, and run the node.

    Args:
        module: module of the node, for the usage line.
        table: name of the node's table in the settings file.
        kind: class of its settings.
        run: runs the node.

    Returns:
        The exit code, see `crash`.
    """
    arguments = sys.argv[1:]
    if arguments[-1:] == [SUPERVISED]:
        arguments.pop()
        threading.Thread(target=_end_with_supervisor, name="supervisor", daemon=True).start()
    if len(arguments) > 1:
        print_error(table, f"usage: python -m {module} [settings.toml]")
        return UNUSABLE
    logs.configure()

    def run_node() -> int:
        tables = read_settings(Path(arguments[0]) if arguments else None)
        logs.configure(as_json=section(LogConfig, "log", tables, {}).format == "json")
        run(
            section(kind, table, tables, {}),
            section(BusConfig, "bus", tables, {}),
            section(MetricsConfig, "metrics", tables, {}),
        )
        return 0

    return guard(table, run_node)


def _end_with_supervisor() -> None:
    while os.read(sys.stdin.fileno(), 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
