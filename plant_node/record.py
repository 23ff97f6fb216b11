"""Make a plant from its settings, and simulate its record without a bus; sample records with their known truth."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace as with_changes

from plant_node.config import PlantConfig, fit_settings
from plant_node.core import Plant
from plant_node.scenario import FromFile, HeldRecord, Scenario
from reactorwatch.description.choice import ProcessChoice
from reactorwatch.description.find import build_process, find_process
from reactorwatch.description.process import Process
from reactorwatch.description.read import convert_to_process
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.process import MODELS, OPERATIONS, effects_of
from reactorwatch.process.effect import TIMING
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.operation import Example
from reactorwatch.records.read_table import SignalColumn, read_table
from reactorwatch.records.record import Record
from reactorwatch.runtime.model_file import read_extended_model


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
    """Load the process of the settings; timing effects of an extended model become faults.

    Raises:
        InputError: as `find_process`.
    """
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


EXAMPLES: dict[str, Example] = {
    name: example for operation in OPERATIONS.values() for name, example in operation.examples.items()
}
"""The sample records, by name."""


def make_example(name: str, seed: int) -> tuple[Record, dict[str, Any]]:
    """Simulate a sample record; returns it and its truth, as `FILE.truth.json` has it.

    Args:
        name: name in `EXAMPLES`.
        seed: seed of the input and the noise.

    Raises:
        InputError: there is no such example, or the seed is out of range.
    """
    if name not in EXAMPLES:
        raise InputError(describe_unknown("example", name, EXAMPLES))
    example = EXAMPLES[name]
    model = next(item for item in (make() for make in MODELS) if name in OPERATIONS[item.name].examples)
    config = msgspec.convert({**example.settings, "seed": seed, "faults": example.faults}, PlantConfig)
    simulated = model if example.with_law is None else example.with_law(model)
    record = simulate_record(config, example.rows, simulated)
    faults = [parse_fault(text, effects_of(model)) for text in example.faults]
    causes = [
        {
            "cause": fault.effect.name,
            "profile": fault.profile.name,
            "size": fault.values["size"],
            "unit": fault.effect.unit,
            "onset_min": fault.values["onset"],
        }
        for fault in faults
    ]
    truth: dict[str, Any] = {"process": model.name, "seed": seed, "causes": causes}
    return record, truth if example.law is None else truth | {"law": example.law}
