"""Set-up of a command that observes a run or sends commands: log and settings.

Its log is text for the terminal, independent of the nodes' log settings.
"""

import logging
from pathlib import Path
from typing import Any

from reactorwatch.description.find import find_process
from reactorwatch.description.plants import PlantProcesses
from reactorwatch.description.process import Process
from reactorwatch.runtime.config import BusConfig, read_settings, section
from reactorwatch.runtime.logs import configure
from recorder.config import RecorderConfig


def load_settings(
    config: Path | None, endpoint: str | None, level: int = logging.WARNING
) -> tuple[dict[str, dict[str, Any]], BusConfig]:
    """Configure the log; returns the tables of the settings, and the bus settings.

    Args:
        config: settings file, or None.
        endpoint: the router's address, or None.
        level: the least severe level that is logged.

    Raises:
        InputError: invalid settings.
    """
    configure(level)
    tables = read_settings(config)
    return tables, section(BusConfig, "bus", tables, {"endpoint": endpoint})


def load_recorder_settings(
    config: Path | None, endpoint: str | None, plant: str | None, level: int = logging.WARNING
) -> tuple[BusConfig, RecorderConfig]:
    """Configure the log; returns the settings of the bus, and of the recorder, which name the plant.

    Args:
        config: see `load_settings`.
        endpoint: see `load_settings`.
        plant: name of the plant; None: that of the settings.
        level: see `load_settings`.

    Raises:
        InputError: invalid settings.
    """
    tables, bus = load_settings(config, endpoint, level)
    return bus, section(RecorderConfig, "recorder", tables, {"plant": plant})


def observed_process(process: str | None, recorder: RecorderConfig) -> Process | None:
    """Process of the plant that is observed.

    Args:
        process: name or file of the process; None: the one that the recorder's settings name.
        recorder: settings of the recorder, which name the plant.

    Returns:
        The process; None: it is not stated.

    Raises:
        InputError: it cannot be loaded.
    """
    return PlantProcesses(recorder.processes).find(recorder.plant) if process is None else find_process(process)
