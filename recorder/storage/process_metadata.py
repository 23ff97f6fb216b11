"""Metadata record of a plant's process: its signals with their units and roles, and its equations. Pure.

Equations are stored where they are those of the catalogue: by name, with the constants that differ and the deviations
that the model holds. A recording of any other equations is read with the process named by an option.
"""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, replace

import msgspec
import numpy as np

from reactorwatch.description.process import KnownParameter, Process, Signal, describe_model
from reactorwatch.errors import InputError
from reactorwatch.process import MODELS
from reactorwatch.process.extended_model import extended_model_of, parse_extended_model
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import Record
from recorder.storage.mcap_types import Metadata

PROCESS = "reactorwatch.process"
"""Name of the records."""


def to_metadata(plant: str, process: Process, record: Record | None = None) -> dict[str, str]:
    """Metadata record of the signals of a process.

    Args:
        plant: name of the plant.
        process: the process.
        record: a record, which decides which signals there are, and their units; None: all of them, in their units.
    """
    model_units = {} if process.model is None else process.model.units
    present = []
    for signal in process.signals:
        if record is None:
            present.append(replace(signal, unit=signal.unit or model_units.get(signal.name, ""), column=None))
        elif signal.name in record.columns:
            present.append(replace(signal, unit=record.units.get(signal.name, ""), column=None))
    signals = [{name: value for name, value in asdict(signal).items() if value not in (None, "")} for signal in present]
    found = {"plant": plant, "process": process.name, "signals": msgspec.json.encode(signals).decode()}
    if model_units.keys() <= {signal.name for signal in present}:
        found |= _equations_metadata(process)
    return found


def processes_in(records: Iterable[Metadata]) -> dict[str, Process]:
    """Processes by name of the plant; of several records of a plant the first counts.

    Records that cannot be read, such as those of a later version, are skipped, and so are equations.
    """
    found: dict[str, Process] = {}
    for record in records:
        if record.name == PROCESS and record.metadata.get("plant") not in (None, *found):
            try:
                signals = msgspec.json.decode(record.metadata["signals"], type=tuple[Signal, ...])
                process = Process(record.metadata["process"], signals)
            except (KeyError, msgspec.MsgspecError, InputError):
                continue
            with suppress(KeyError, msgspec.MsgspecError, InputError):
                process = _with_equations(process, record.metadata)
            found[record.metadata["plant"]] = process
    return found


def _equations_metadata(process: Process) -> dict[str, str]:
    """Metadata of the equations and their given constants; empty for equations that are not of the catalogue."""
    model = process.equations
    if model is None or model.breakpoints:  # times of deviations count from a zero that is not known here
        return {}
    extended = extended_model_of(model)
    try:
        if not _are_equal(model, extended.build()):
            return {}
    except InputError:
        return {}
    given = {
        name: item if isinstance(item, KnownParameter) else KnownParameter(*item)
        for name, item in process.parameters.items()
    }
    return {
        "equations": msgspec.json.encode(extended.to_object()).decode(),
        "parameters": msgspec.json.encode(given).decode(),
    }


def _with_equations(process: Process, metadata: dict[str, str]) -> Process:
    """Process with the equations of its metadata and, from the catalogue, their effects and controllers.

    Raises:
        KeyError: there are none.
        InputError: they cannot be built.
        msgspec.MsgspecError: they are no such JSON.
    """
    named = describe_model(parse_extended_model(metadata["equations"], MODELS).build())
    parameters = msgspec.json.decode(metadata["parameters"], type=dict[str, KnownParameter])
    return replace(
        named, name=process.name, signals=process.signals, parameters=parameters, file_format=process.file_format
    )


def _are_equal(one: ProcessModel, other: ProcessModel) -> bool:
    """True if two models have the same names and values, and equal balances and outputs at some points."""
    names = [(item.state_names, item.units, item.parameter_names) for item in (one, other)]
    if names[0] != names[1] or not np.array_equal(one.values(), other.values()):
        return False
    functions = [item.function() for item in (one, other)]
    for share in (0.2, 0.5, 0.7):
        states, inputs = (
            np.array([item.lower + share * (item.upper - item.lower) for item in items])
            for items in (one.states, one.inputs)
        )
        results = [
            np.concatenate([np.array(part) for part in function(states, inputs, one.values(), 0.0, 0.0)])
            for function in functions
        ]
        if not np.array_equal(results[0], results[1], equal_nan=True):
            return False
    return True
