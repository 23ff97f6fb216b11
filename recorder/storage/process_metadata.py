"""Metadata record of a plant's process: its signals with their units and roles, and its equations. Pure.

Equations of the catalogue are stored by name, with the constants that differ and the deviations that the model holds,
and other ones as data (`stored_equations`). Effects of a user's code are neither: a recording of a process that has
some is read with the process named by an option.
"""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, replace

import msgspec

from reactorwatch.description.process import KnownParameter, Process, Signal, describe_model
from reactorwatch.errors import InputError
from reactorwatch.process import EFFECTS_OF
from reactorwatch.process.extended_model import ExtendedModel, extended_model_of, is_complete, parse_extended_model
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
    """Metadata of the equations and their given constants; empty if its effects are code of the user."""
    model = process.equations
    if model is None or model.breakpoints:  # times of deviations count from a zero that is not known here
        return {}
    extended = extended_model_of(model)
    if not (is_complete(extended, model) and process.effects == EFFECTS_OF.get(model.name, ())):
        if process.effects:
            return {}
        extended = ExtendedModel(model.name, equations=model, uncertain=model.uncertain)
    given = {name: KnownParameter.of(item) for name, item in process.parameters.items()}
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
    named = describe_model(parse_extended_model(metadata["equations"]).build())
    parameters = msgspec.json.decode(metadata["parameters"], type=dict[str, KnownParameter])
    return replace(
        named, name=process.name, signals=process.signals, parameters=parameters, file_format=process.file_format
    )
