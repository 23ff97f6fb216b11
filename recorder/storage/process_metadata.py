"""Metadata record of a plant's process: its signals with their units and roles. Pure."""

from collections.abc import Iterable
from dataclasses import asdict, replace

import msgspec

from reactorwatch.description.process import Process, Signal
from reactorwatch.errors import InputError
from reactorwatch.records.record import Record
from recorder.storage.mcap_types import Metadata

PROCESS = "reactorwatch.process"
"""Name of the records."""


def to_metadata(plant: str, process: Process, record: Record) -> dict[str, str]:
    """Metadata record of the signals that a record of a process holds.

    Args:
        plant: name of the plant.
        process: the process.
        record: decides which signals there are, and their units.
    """
    signals = []
    for signal in process.signals:
        if signal.name in record.columns:
            recorded = replace(signal, unit=record.units.get(signal.name, ""), column=None)
            signals.append({name: value for name, value in asdict(recorded).items() if value not in (None, "")})
    return {"plant": plant, "process": process.name, "signals": msgspec.json.encode(signals).decode()}


def processes_in(records: Iterable[Metadata]) -> dict[str, Process]:
    """Processes by name of the plant; of several records of a plant the first counts.

    Records that cannot be read, such as those of a later version, are skipped.
    """
    found: dict[str, Process] = {}
    for record in records:
        if record.name == PROCESS and record.metadata.get("plant") not in (None, *found):
            try:
                signals = msgspec.json.decode(record.metadata["signals"], type=tuple[Signal, ...])
                found[record.metadata["plant"]] = Process(record.metadata["process"], signals)
            except (KeyError, msgspec.MsgspecError, InputError):
                continue
    return found
