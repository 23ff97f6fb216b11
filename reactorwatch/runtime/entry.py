"""How a node begins as a process of its own: `python -m NODE [settings.toml]`."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import msgspec

from reactorwatch.errors import InputError
from reactorwatch.runtime import logs
from reactorwatch.runtime.config import BusConfig, LogConfig, MetricsConfig, read_settings, section
from reactorwatch.terminal import printable

Config = TypeVar("Config", bound=msgspec.Struct)


def main(module: str, table: str, kind: type[Config], run: Callable[[Config, BusConfig, MetricsConfig], object]) -> int:
    """Read the settings file that the command line names, and run the node.

    Args:
        module: the node's, for the usage line.
        table: of the settings file that is the node's.
        kind: the structure of its settings.
        run: the node.

    Returns:
        The exit code: 2 if something that was given cannot be used.
    """
    arguments = sys.argv[1:]
    if len(arguments) > 1:
        sys.stderr.write(f"usage: python -m {module} [settings.toml]\n")
        return 2
    logs.configure()
    try:
        tables = read_settings(Path(arguments[0]) if arguments else None)
        logs.configure(as_json=section(LogConfig, "log", tables, {}).format == "json")
        run(
            section(kind, table, tables, {}),
            section(BusConfig, "bus", tables, {}),
            section(MetricsConfig, "metrics", tables, {}),
        )
    except InputError as error:
        sys.stderr.write(f"{table}: {printable(str(error))}\n")
        return 2
    return 0
