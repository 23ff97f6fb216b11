"""Read tables (`.csv` and others) and `.mcap` files as a record or as messages.

A folder is one recording of all the files in it; in a list of files it stands for each of them (`expand_folder`).
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from reactorwatch.contract.codec import Encoded, encode
from reactorwatch.contract.keys import DEFAULT_PLANT, check_plant
from reactorwatch.description.read import DEFAULT_CHOICE, ProcessChoice
from reactorwatch.errors import InputError
from reactorwatch.records.decode import TABLE_SUFFIXES, check_workbook, is_table, list_files
from reactorwatch.records.file_format import GUESS, FileFormat
from reactorwatch.records.record import Record, join_files

if TYPE_CHECKING:
    from reactorwatch.description.process import Process


def record(
    files: Path | Sequence[Path],
    plant: str | None = None,
    columns: dict[str, str] | None = None,
    process: "Process | None" = None,
    stated: FileFormat = GUESS,
) -> Record:
    """Read a file, or several in a row, as a record.

    Args:
        files: a table, an .mcap or a folder of recordings; or several.
        plant: plant in a recording.
        columns: names of a table's columns, by signal.
        process: process whose signals are read; None: the reactor.
        stated: statements about the form of a table, beside those of the process; the rows of a recording may be
            resampled, too.

    Raises:
        InputError: the file is neither a table nor an .mcap, or is malformed.
    """
    from reactorwatch.description.read import convert_to_process, find_process, read_process_table, resample_rows

    described, paths = process or find_process(), [files] if isinstance(files, Path) else list(files)
    if all(file_kind(path) == "table" for path in paths):
        return read_process_table(paths, described, columns, stated)
    from recorder.tools.convert import read_record

    parts = []
    for path in paths:
        if file_kind(path) == "table":
            parts.append(read_process_table(path, described, columns, replace(stated, resample=None)))
            continue
        check_workbook(path, stated.sheet)
        recorded = read_record(path, plant, described)
        parts.append(recorded if process is None else convert_to_process(recorded, process))
    return resample_rows(join_files(parts), described, stated)


def described_process(path: Path, plant: str | None = None, choice: ProcessChoice = DEFAULT_CHOICE) -> "Process":
    """Process of a file: the chosen one; else the one that a recording describes; else the reactor.

    Args:
        path: a table, an .mcap or a folder of recordings.
        plant: plant in a recording.
        choice: the choice.

    Raises:
        InputError: as `ProcessChoice.load`, or the recording is damaged.
    """
    if not choice.is_default or file_kind(path) == "table":
        return choice.load()
    from recorder.files.recording import Recording

    return Recording(path).process(plant) or choice.load()


def record_of_process(
    path: Path, plant: str | None, columns: dict[str, str], choice: ProcessChoice, stated: FileFormat
) -> tuple[Record, "Process"]:
    """Read a file as a record of its process, and load the process on the clock of the record.

    Args:
        path: see `record`.
        plant: see `record`.
        columns: see `record`.
        choice: see `described_process`; the minutes of an extended model are counted from the record's zero.
        stated: see `record`.

    Raises:
        InputError: as `record` and `described_process`.
    """
    described = described_process(path, plant, choice)
    measured = record(path, plant, columns, described, stated)
    return measured, described if choice.is_default else choice.load(measured.zero_ns)


class MessageSource(NamedTuple):
    """Messages of a file.

    Attributes:
        messages: messages in the order of receipt; those of a table are its samples.
        zero_ns: time from which the file's minutes are counted; None: that of the first sample.
        has_clock: True if the times of the messages are clock times.
        read_as: guesses about the form of a table; empty: none.
        process: process of the messages' plant; None: unknown.
        measured: the record, of a table or of resampled rows.
    """

    messages: Iterator[Encoded]
    zero_ns: int | None
    has_clock: bool
    read_as: str = ""
    process: "Process | None" = None
    measured: Record | None = None


def open_messages(
    path: Path,
    plant: str | None = None,
    columns: dict[str, str] | None = None,
    stated: FileFormat = GUESS,
    choice: ProcessChoice = DEFAULT_CHOICE,
    *,
    for_equations: bool = False,
) -> MessageSource:
    """Open a file as messages.

    Args:
        path: a table, an .mcap or a folder of recordings.
        plant: plant in a recording.
        columns: names of a table's columns, by signal.
        stated: statements about the form of a table, and the period to which rows are resampled.
        choice: process of the plant; the default: as recorded, and of a table the reactor.
        for_equations: True to read a table in the units of the equations of the chosen process, if it has any; columns
            of unknown units are taken to be in these.

    Raises:
        InputError: as `record`.
    """
    from recorder.files.recording import ZERO_NS, Recording, has_clock, zero_from

    of_table = file_kind(path) == "table"
    if of_table or stated.resample is not None:
        from recorder.tools.player import samples_of

        process = choice.load() if of_table or not choice.is_default else Recording(path).process(plant)
        shown = process or choice.load()
        if not for_equations or (of_table and choice.is_default):
            shown = shown.without_equations()  # any rig may be watched under the reactor's names, in units of its own
        measured = record(path, plant, columns, shown, stated)
        if shown.model is not None:
            measured = replace(measured, units={**measured.units, **shown.model.units})
        publications = samples_of(measured, plant or DEFAULT_PLANT, measured.stored_zero_ns)
        encoded = (encode(item) for item in publications)
        zero_ns, has_clock_time = measured.stored_zero_ns, bool(measured.zero_ns)
        return MessageSource(encoded, zero_ns, has_clock_time, measured.read_as, process, measured)

    check_workbook(path, stated.sheet)
    recording = Recording(path)
    read, metadata = (Encoded(*entry[:4]) for entry in recording.messages(plant=plant)), recording.metadata
    given_ns = zero_from(metadata, 0) if ZERO_NS in metadata else None
    process = recording.process(plant) if choice.is_default else choice.load()
    return MessageSource(read, given_ns, has_clock(metadata), process=process)


def expand_folder(folder: Path) -> list[Path]:
    """List the records (.csv) and recordings (.mcap) in a folder.

    Files that a recorder wrote one after the other, and cut or merged ones, are one recording, named by the folder.
    With recordings of another origin, such as imported ones, each file is a recording.

    Raises:
        InputError: the folder holds neither.
    """
    from recorder.files.recording import FILE_INDEX, Recording, live_file

    one_recording = {FILE_INDEX, "cut", "merged"}
    records, recordings = (list_files(folder, suffix) for suffix in (".csv", ".mcap"))
    if not records and not recordings and live_file(folder) is not None:
        return [folder]
    if not records and not recordings:
        raise InputError(f"{folder}: holds no record (.csv) and no recording (.mcap)")
    origins = []
    for file in recordings:
        with suppress(InputError):  # a damaged one is reported when it is read
            origins.append(Recording(file).metadata)
    if origins and all(one_recording & origin.keys() for origin in origins):
        return [folder, *records]
    return sorted([*records, *recordings])


def resolve_plant(path: Path, plant: str | None) -> str:
    """Name of the plant in a file: the given one, or the only one.

    Raises:
        InputError: as `Recording.one_plant`; or the name is invalid.
    """
    if file_kind(path) == "table":
        return plant or DEFAULT_PLANT
    from recorder.files.recording import Recording

    name = Recording(path).one_plant(plant)
    try:
        return check_plant(name)
    except ValueError as error:
        cure = "export it, and use the record"
        raise InputError(f"{path}: {error}; {cure}") from error


def file_kind(path: Path) -> str:
    """Kind of a file by its suffix, `table` or `mcap`; a folder is of recordings.

    Raises:
        InputError: the suffix is another one.
    """
    if path.is_dir():
        return "mcap"
    if is_table(path):
        return "table"
    if path.suffix.lower() != ".mcap":
        others = ", ".join(suffix for suffix in TABLE_SUFFIXES if suffix != ".csv")
        raise InputError(
            f"{path}: must be a .csv or .mcap file, or another table ({others}), got {path.suffix or 'no ending'}"
        )
    return "mcap"
