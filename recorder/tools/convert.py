"""Convert between recordings (MCAP) and records (CSV)."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

from reactorwatch.contract import keys
from reactorwatch.contract.codec import encode
from reactorwatch.errors import InputError
from reactorwatch.records.atomic import atomic_write
from reactorwatch.records.csv_file import read_csv
from reactorwatch.records.file_format import GUESS, FileFormat
from reactorwatch.records.output import refuse_source
from reactorwatch.records.record import LONGEST_MIN, MINUTE_NS, Record, to_time_ns
from reactorwatch.records.several_files import join_files
from reactorwatch.records.write_table import write_table
from recorder.columns.run_splitter import ContinuousTime
from recorder.message import RecordedMessage
from recorder.tools.mcap_file import CLOCK, NO_CLOCK, ZERO_NS, RecordingWriter, read_record
from recorder.tools.player import samples_of


def import_csv(
    csv: Path | Sequence[Path],
    mcap: Path,
    plant: str,
    columns: Mapping[str, str] | None = None,
    zero_ns: int = 0,
    stated: FileFormat = GUESS,
) -> Record:
    """Convert a record to a recording; the time of receipt is the sample time.

    A recording holds no times before 1970. Where a record without clock time has some, all its times are shifted, and
    the recording's `zero_ns` holds the shift. A run that starts before the end of the run before is received after it.

    Args:
        csv: the record, or the files of it in a row.
        mcap: the recording; an existing file is replaced.
        plant: name of the plant.
        columns: column names of the file by signal, as in `read_csv`.
        zero_ns: time that the minutes of a record without clock time count from; 0 if unknown.
        stated: statements about the form of the file.

    Returns:
        The record.

    Raises:
        InputError: the record is malformed, or has times that a recording cannot hold; or the plant's name is invalid.
    """
    try:
        keys.check_plant(plant)
    except ValueError as error:
        raise InputError(str(error)) from error
    files = [csv] if isinstance(csv, Path) else list(csv)
    refuse_source(mcap, files)
    record = join_files([read_csv(file, columns, stated=stated) for file in files])
    metadata = {"plant": plant, "source": record.name}
    zero_ns = record.zero_ns or zero_ns
    if not zero_ns:
        metadata[CLOCK] = NO_CLOCK
        zero_ns = record.stored_zero_ns
    _check_times(files[0], record, zero_ns)
    received = ContinuousTime()
    with (
        atomic_write(mcap) as temporary,
        RecordingWriter(temporary, {**metadata, ZERO_NS: str(zero_ns)}) as writer,
    ):
        for publication in samples_of(record, plant, zero_ns):
            encoded = encode(publication)
            received_ns = received.continuous_ns(*publication)
            time_ns = publication.message.time_ns
            writer.write(RecordedMessage(encoded.key, encoded.payload, encoded.encoding, received_ns, time_ns))
    return record


def export_csv(mcap: Path, csv: Path, plant: str | None = None, *, clock: bool = False) -> Record:
    """Convert the samples of a recording to a record.

    Args:
        mcap: the recording.
        csv: the record, in the form of its suffix (see `write_table`); an existing file is replaced.
        plant: name of the plant; None if the recording has only one.
        clock: add a column with the clock time.

    Returns:
        The record.

    Raises:
        InputError: the recording cannot be read, or has several plants and `plant` is None.
    """
    refuse_source(csv, (mcap,))
    record = read_record(mcap, plant)
    write_table(csv, record, clock=clock)
    return record


def _check_times(csv: Path, record: Record, zero_ns: int) -> None:
    for minutes in (float(record.time_min.min()), float(record.continuous_min.max())):
        if not 0 <= minutes + zero_ns / MINUTE_NS < LONGEST_MIN:
            raise InputError(f"{csv}: times must lie between 1970 and 2262 to be recorded, got {minutes:g} min")
    for run in record.split_runs():
        times_ns = [to_time_ns(minutes, zero_ns) for minutes in run.time_min.tolist()]
        for row, (before, after) in enumerate(itertools.pairwise(times_ns)):
            if before >= after:
                got = f"{run.time_min[row]} and {run.time_min[row + 1]} min"
                raise InputError(f"{csv}: rows must be at least 1 microsecond apart to be recorded, got {got}")
