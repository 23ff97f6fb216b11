"""Make a plant from its settings, and simulate its record without a bus."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from msgspec.structs import replace as with_changes

from plant_node.config import PlantConfig, fit_settings
from plant_node.core import Plant
from plant_node.scenario import FromFile, HeldRecord, Scenario
from reactorwatch.description.process import Process
from reactorwatch.description.read import (
    ProcessChoice,
    build_process,
    convert_to_process,
    find_process,
    read_extended_model,
)
from reactorwatch.process.effect import TIMING
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.read import SignalColumn, read_table
from reactorwatch.records.record import Record


def plant_from(
    config: PlantConfig, process: Process | ProcessModel | None = None, driver: Record | None = None
) -> Plant:
    """Make the simulated plant; reads the files that its settings name.

    Args:
        config: settings.
        process: the process; None: that of the settings.
        driver: a record whose inputs drive the plant, instead of the scenario of `config`.

    Raises:
        InputError: settings that do not fit the process, a process without equations, or an invalid file.
    """
    config, found = load_process(config) if process is None else (config, find_process(process))
    settings = fit_settings(config, found)
    scenarios: dict[str, Scenario] = {}
    for item in settings.equations.inputs:
        programme = settings.scenarios[item.name]
        if driver is not None:
            scenarios[item.name] = HeldRecord.of(driver, item)
        elif isinstance(programme, FromFile):
            scenarios[item.name] = HeldRecord.of(_read_input(Path(programme.path), item.name, found), item)
        else:
            scenarios[item.name] = programme
    return Plant(config, found, settings, scenarios)


def load_process(config: PlantConfig) -> tuple[PlantConfig, Process]:
    """Load the process of the settings; timing effects of an extended model become faults."""
    choice = ProcessChoice(config.process)
    if choice.file is None or choice.file.suffix.lower() != ".json":
        return config, choice.load()
    loaded = read_extended_model(choice.file)
    timing = [item for item in loaded.effects if item.effect.location == TIMING]
    physical = replace(loaded, effects=tuple(item for item in loaded.effects if item not in timing))
    faults = (*config.faults, *(str(item) for item in timing))
    return with_changes(config, faults=faults), build_process(physical)


def _read_input(path: Path, name: str, process: Process) -> Record:
    """Read an input from a record of a process, which may hold no other signal of it."""
    signals = [
        SignalColumn(
            signal.name,
            signal.unit,
            signal.role,
            None if signal.column is None else str(signal.column),
            required=signal.name == name,
        )
        for signal in process.signals
    ]
    return convert_to_process(read_table(path, signals, process.file_format), process)


def simulate_record(
    config: PlantConfig,
    rows: int | None = None,
    process: Process | ProcessModel | None = None,
    driver: Record | None = None,
) -> Record:
    """Simulate the record that a plant of these settings publishes.

    Args:
        config: settings; those about pace are not used.
        rows: number of rows; None: those of the configured duration.
        process: see `plant_from`.
        driver: see `plant_from`.

    Raises:
        ValueError: neither rows nor a duration is given, or fewer than one row.
        InputError: as `plant_from`.
    """
    rows = config.rows if rows is None else rows
    if rows is None or rows < 1:
        raise ValueError(f"rows must be at least 1, or the configuration must have a duration, got {rows}")
    plant = plant_from(config, process, driver)
    measured = [plant.next_row() for _ in range(rows)]
    columns = {signal: np.array([row.readings[signal] for row in measured]) for signal in plant.units}
    times = np.array([row.time_min for row in measured])
    return Record(times, columns, f"simulated {config.name}", units=plant.units)
