"""How a command that looks on, or asks, begins: its log, its settings, and where the bus is.

What it logs is for the person at the terminal, whatever the settings say of the log of the nodes.
"""

import logging
from pathlib import Path
from typing import Any

from reactorwatch.runtime.config import BusConfig, read_settings, section
from reactorwatch.runtime.logs import configure
from recorder.config import RecorderConfig


def begin(
    config: Path | None, endpoint: str | None, level: int = logging.WARNING
) -> tuple[dict[str, dict[str, Any]], BusConfig]:
    """Set the log up; the tables of the settings, and of them the bus.

    Args:
        config: settings file, or None.
        endpoint: the router's address, or None.
        level: what is less is not logged.

    Raises:
        InputError: settings that cannot be used.
    """
    configure(level)
    tables = read_settings(config)
    return tables, section(BusConfig, "bus", tables, {"endpoint": endpoint})


def begin_beside_recorder(
    config: Path | None, endpoint: str | None, plant: str | None, level: int = logging.WARNING
) -> tuple[BusConfig, RecorderConfig]:
    """Where the bus is, and the settings of the recorder, which name the plant.

    Args:
        config: as for `begin`.
        endpoint: likewise.
        plant: its name; None: that of the settings.
        level: as for `begin`.

    Raises:
        InputError: settings that cannot be used.
    """
    tables, bus = begin(config, endpoint, level)
    return bus, section(RecorderConfig, "recorder", tables, {"plant": plant})
