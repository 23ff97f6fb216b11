"""Make a plant from its settings, and simulate its record without a bus."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from msgspec.structs import replace as with_changes

from plant_node.config import PlantConfig
from plant_node.core import Plant
from plant_node.scenario import FromFile, HeldRecord
from reactorwatch.process.effect import TIMING
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.read_table import SignalColumn, read_table
from reactorwatch.records.record import Record
from reactorwatch.runtime.model_file import read_extended_model


def plant_from(config: PlantConfig, model: ProcessModel | None = None, driver: Record | None = None) -> Plant:
    """Make the simulated plant; reads the record that drives it, if there is one.

    Args:
        config: settings.
        model: the process; None: that of the settings.
        driver: a record whose input drives the plant, instead of the scenario of `config`.

    Raises:
        InputError: settings that do not fit the model, or an invalid file.
    """
    scenario = config.scenario_settings()
    if model is None:
        config, model = _load_model(config)
    if driver is not None:
        return Plant(config, model, HeldRecord.of(driver))
    if isinstance(scenario, FromFile):
        signals = [SignalColumn(name, unit, required=name in model.input_names) for name, unit in model.units.items()]
        return Plant(config, model, HeldRecord.of(read_table(Path(scenario.path), signals)))
    return Plant(config, model, scenario)


def _load_model(config: PlantConfig) -> tuple[PlantConfig, ProcessModel]:
    """Load the process of the settings; its timing effects become faults."""
    if config.model is None:
        return config, cstr()
    loaded = read_extended_model(Path(config.model))
    timing = [item for item in loaded.effects if item.effect.location == TIMING]
    physical = replace(loaded, effects=tuple(item for item in loaded.effects if item not in timing))
    faults = (*config.faults, *(str(item) for item in timing))
    return with_changes(config, faults=faults), physical.build()


def simulate_record(
    config: PlantConfig, rows: int | None = None, model: ProcessModel | None = None, driver: Record | None = None
) -> Record:
    """Simulate the record that a plant of these settings publishes.

    Args:
        config: settings; those about pace are not used.
        rows: number of rows; None: those of the configured duration.
        model: see `plant_from`.
        driver: see `plant_from`.

    Raises:
        ValueError: neither rows nor a duration is given, or fewer than one row.
        InputError: as `plant_from`.
    """
    rows = config.rows if rows is None else rows
    if rows is None or rows < 1:
        raise ValueError(f"rows must be at least 1, or the configuration must have a duration, got {rows}")
    plant = plant_from(config, model, driver)
    measured = [plant.next_row() for _ in range(rows)]
    columns = {signal: np.array([row.readings[signal] for row in measured]) for signal in plant.units}
    times = np.array([row.time_min for row in measured])
    return Record(times, columns, f"simulated {config.name}", units=plant.units)
