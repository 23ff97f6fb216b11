"""Wherever a file is asked for, `.csv` and `.mcap` both serve: this turns either into a record or into messages.

A folder stands for the recordings in it, as one; where many files may be named, for all in it (`stands_for`). And
`--model` is turned into a process model on the record's clock.
"""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from reactorwatch.contract.codec import Encoded, encode
from reactorwatch.contract.keys import checked_plant
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.reading import files_of
from reactorwatch.records.record import UNITS, Record, clock_time

DEFAULT_PLANT = "cstr"


def record(
    path: Path,
    plant: str | None = None,
    columns: dict[str, str] | None = None,
    required: tuple[str, ...] = tuple(UNITS),
    units: Mapping[str, str] | None = None,
) -> Record:
    """The columns of a file.

    Args:
        path: of a .csv, an .mcap or a folder.
        plant: in a recording.
        columns: a .csv's own names, by signal.
        required: signals that a .csv must have.
        units: of the process's signals, if the columns are known to be these; None: see `read_csv`.

    Raises:
        InputError: the file is not one of the two kinds, or is malformed.
    """
    if kind(path) == "csv":
        from reactorwatch.records.csv_file import read_csv

        measured = read_csv(path, columns, required)
        return measured if units is None else replace(measured, units=units)
    from recorder.tools.mcap_file import read_record

    return read_record(path, plant)


class Tape(NamedTuple):
    """The messages of a file.

    Attributes:
        messages: in the order they were received; those of a .csv are its samples.
        zero_ns: the time of the messages that the file's minutes count from; None: the first sample.
        has_clock: whether the times of the messages are clock times.
    """

    messages: Iterator[Encoded]
    zero_ns: int | None
    has_clock: bool

    def zero(self, first_ns: int) -> str | None:
        """The clock time that the minutes count from, as in ISO 8601; None: not known.

        Args:
            first_ns: time of the first sample.
        """
        return clock_time(first_ns if self.zero_ns is None else self.zero_ns) if self.has_clock else None


def tape(
    path: Path,
    plant: str | None = None,
    columns: dict[str, str] | None = None,
    units: Mapping[str, str] | None = None,
) -> Tape:
    """The messages of a file, and what its minutes count from; see `record`.

    Raises:
        InputError: as `record`.
    """
    if kind(path) == "csv":
        from recorder.tools.player import samples_of

        measured = record(path, plant, columns, units=units)
        publications = samples_of(measured, plant or DEFAULT_PLANT, measured.stored_zero_ns)
        return Tape((encode(item) for item in publications), measured.stored_zero_ns, has_clock=False)
    from recorder.tools.mcap_file import ZERO_NS, has_clock, read_messages, read_metadata, zero_from

    read = (Encoded(*entry[:4]) for entry in read_messages(path, plant=plant))
    metadata = read_metadata(path)
    return Tape(read, zero_from(metadata, 0) if ZERO_NS in metadata else None, has_clock(metadata))


def messages(path: Path, plant: str | None = None, columns: dict[str, str] | None = None) -> Iterator[Encoded]:
    """The messages of a file, in the order they were received; those of a .csv are its samples.

    Raises:
        InputError: as `record`.
    """
    return tape(path, plant, columns).messages


def stands_for(folder: Path) -> list[Path]:
    """What a folder stands for where many files may be named: each record (.csv) in it, and its recordings (.mcap).

    What a recorder has written there, one file after the other, is one recording, which the folder itself stands for;
    so is what was cut or merged. Where there are recordings of another origin, such as imported ones, each is one.

    Raises:
        InputError: there is neither in it.
    """
    from recorder.storage.mcap_writer import NUMBER
    from recorder.tools.mcap_file import read_metadata

    of_a_piece = {NUMBER, "cut", "merged"}
    records, recordings = (files_of(folder, suffix) for suffix in (".csv", ".mcap"))
    if not records and not recordings:
        raise InputError(f"{folder}: holds no record (.csv) and no recording (.mcap)")
    origins = []
    for file in recordings:
        with suppress(InputError):  # one that is damaged is told of when it is read
            origins.append(read_metadata(file))
    if origins and all(of_a_piece & origin.keys() for origin in origins):
        return [folder, *records]
    return sorted([*records, *recordings])


def signals_of(path: Path | None) -> tuple[str, ...]:
    """What the model in a file needs of a record: its inputs and outputs.

    Raises:
        InputError: as `process_model`.
    """
    from reactorwatch.process.library.cstr.model import cstr
    from reactorwatch.runtime.model_file import read_extended_model

    model = cstr() if path is None else read_extended_model(path).build()
    return (*model.input_names, *model.output_names)


def process_model(path: Path | None, measured: Record) -> ProcessModel:
    """The model in a file, its clock that of the record; the nominal reactor if there is no file.

    Where either counts its minutes from a moment that nobody knows, they are taken to count from the same.

    Raises:
        InputError: the file cannot be read, or holds no model.
    """
    from reactorwatch.process.library.cstr.model import cstr
    from reactorwatch.runtime.model_file import read_extended_model

    if path is None:
        return cstr()
    model = read_extended_model(path)
    return (model.rebase(measured.zero_ns) if measured.zero_ns else model).build()


def plant_of(path: Path, plant: str | None) -> str:
    """The plant in a file: the one named, or the only one there.

    Raises:
        InputError: as `one_plant_in`; or it has a name that no plant can have.
    """
    if kind(path) == "csv":
        return plant or DEFAULT_PLANT
    from recorder.tools.mcap_file import one_plant_in

    found = one_plant_in(path, plant)
    try:
        return checked_plant(found)
    except ValueError as error:
        cure = "export it, and use the record"
        raise InputError(f"{path}: {error}; {cure}") from error


def kind(path: Path) -> str:
    """`csv` or `mcap`, by the file's ending; a folder is of recordings.

    Raises:
        InputError: neither.
    """
    if path.is_dir():
        return "mcap"
    ending = path.suffix.lower().removeprefix(".")
    if ending not in ("csv", "mcap"):
        raise InputError(f"{path}: must be a .csv or .mcap file, got {path.suffix or 'no ending'}")
    return ending
