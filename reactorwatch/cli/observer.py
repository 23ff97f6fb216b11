"""Set-up of a command that observes a run or sends commands: log and settings.

Its log is text for the terminal, independent of the nodes' log settings.
"""

import logging
from typing import Any

from reactorwatch.cli.options import BusOptions, PlantOptions
from reactorwatch.description.find import find_process
from reactorwatch.description.plants import PlantProcesses
from reactorwatch.description.process import Process
from reactorwatch.runtime.config import BusConfig, read_settings, section
from reactorwatch.runtime.logs import configure
from recorder.config import RecorderConfig


def load_settings(target: BusOptions, level: int = logging.WARNING) -> tuple[dict[str, dict[str, Any]], BusConfig]:
    """Configure the log; returns the tables of the settings, and the bus settings.

    Args:
        target: options of the command.
        level: the least severe level that is logged.

    Raises:
        InputError: invalid settings.
    """
    configure(level)
    tables = read_settings(target.config)
    return tables, section(BusConfig, "bus", tables, {"endpoint": target.endpoint})


def load_recorder_settings(target: PlantOptions, level: int = logging.WARNING) -> tuple[BusConfig, RecorderConfig]:
    """Configure the log; returns the settings of the bus, and of the recorder, which name the plant.

    Args:
        target: options of the command; without a plant, that of the settings.
        level: see `load_settings`.

    Raises:
        InputError: invalid settings.
    """
    tables, bus = load_settings(target, level)
    return bus, section(RecorderConfig, "recorder", tables, {"plant": target.name})


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
