"""Metadata records of a recording. Pure.

There is one of the file itself (the version that wrote it, and details of its origin), one of each plant's process (its
signals with their units and roles, and its equations) and one of each gap: messages lost on the bus. Publishers number
their messages (`reactorwatch.runtime.reorder_buffer`), so the number and the range of lost messages is known.

Equations of the catalogue are stored by name, with the constants that differ and the deviations that the model holds,
and other ones as data (`process.extended_model`). Effects of a user's code are neither: a recording of a process that
has some is read with the process named by an option.
"""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import UTC, datetime

import msgspec
from mcap.records import Metadata

from reactorwatch.description.process import KnownParameter, Process, Signal, describe_model
from reactorwatch.errors import InputError
from reactorwatch.limits import parse_json
from reactorwatch.process import EFFECTS_OF
from reactorwatch.process.extended_model import ExtendedModel, extended_model_of, is_complete, parse_extended_model
from reactorwatch.records.record import Record
from reactorwatch.runtime.reorder_buffer import Gap

METADATA = "reactorwatch"
"""Name of the record that a writer of this software starts a file with."""
FILE_INDEX = "file"
"""Key in it: index of the file within its run, from 1, if a recorder wrote it."""
PROCESS = "reactorwatch.process"
"""Name of the records of processes."""
GAP = "reactorwatch.gap"
"""Name of the records of gaps."""
ZERO_NS = "zero_ns"
"""Key of the time that minutes count from, where that is not the first sample."""
CLOCK, NO_CLOCK = "clock", "none"
"""Key and value: the record had no clock time, and its times were shifted so that none is before 1970."""


def own_metadata(records: Iterable[Metadata]) -> dict[str, str]:
    """Metadata that this software wrote, among those of all programs; empty if there are none."""
    return next((record.metadata for record in records if record.name == METADATA), {})


def gap_metadata(gap: Gap) -> dict[str, str]:
    """Metadata record of a gap."""
    noticed = datetime.fromtimestamp(gap.noticed_ns / 1e9, UTC).isoformat(timespec="milliseconds")
    values = {name: str(value) for name, value in gap._asdict().items()}
    return {**values, "publisher": f"{gap.publisher:016x}", "noticed": noticed}


def parse_gap(record: Metadata) -> Gap | None:
    """Gap of a metadata record; None if it is not one of a gap."""
    if record.name != GAP:
        return None
    try:
        stream, publisher, *numbers = (record.metadata[name] for name in Gap._fields)
        return Gap(stream, int(publisher, 16), *map(int, numbers))
    except (KeyError, ValueError):
        return None


def gaps_of(records: Iterable[Metadata]) -> tuple[Gap, ...]:
    """Gaps among metadata records."""
    return tuple(gap for gap in map(parse_gap, records) if gap is not None)


def process_metadata(plant: str, process: Process, record: Record | None = None) -> dict[str, str]:
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
                signals = msgspec.convert(parse_json(record.metadata["signals"]), tuple[Signal, ...])
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
    parameters = msgspec.convert(parse_json(metadata["parameters"]), dict[str, KnownParameter])
    return replace(
        named, name=process.name, signals=process.signals, parameters=parameters, file_format=process.file_format
    )
