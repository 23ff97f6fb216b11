"""Between recordings and records in CSV."""

import itertools
from collections.abc import Mapping
from pathlib import Path

from reactorwatch.contract import keys
from reactorwatch.contract.codec import encode
from reactorwatch.errors import InputError
from reactorwatch.records.atomic import replacing
from reactorwatch.records.csv_file import read_csv, write_csv
from reactorwatch.records.output import refuse_source
from reactorwatch.records.record import Record, to_time_ns
from recorder.entry import Entry
from recorder.mcap_file import ZERO_NS, RecordingWriter, read_record
from recorder.player import samples_of


def import_csv(csv: Path, mcap: Path, plant: str, columns: Mapping[str, str] | None = None, zero_ns: int = 0) -> int:
    """Turn a record into a recording, as if it had been received when it was measured.

    Args:
        csv: the record.
        mcap: the recording; an older file of that name is replaced.
        plant: the name of the plant.
        columns: the file's own names for its columns, as in `read_csv`.
        zero_ns: the time that the record's minutes count from.

    Returns:
        The number of rows.

    Raises:
        InputError: the record is malformed, or has times that a recording cannot hold; or the name cannot be a plant's.
    """
    try:
        keys.checked_plant(plant)
    except ValueError as error:
        raise InputError(str(error)) from error
    refuse_source(mcap, (csv,))
    record = read_csv(csv, columns)
    _check_times(csv, record, zero_ns)
    metadata = {"plant": plant, "source": record.name, ZERO_NS: str(zero_ns)}
    with replacing(mcap) as temporary, RecordingWriter(temporary, metadata) as writer:
        for publication in samples_of(record, plant, zero_ns):
            encoded = encode(publication)
            time_ns = publication.message.time_ns
            writer.write(Entry(encoded.key, encoded.payload, encoded.encoding, time_ns, time_ns))
    return record.rows


def export_csv(mcap: Path, csv: Path, plant: str | None = None) -> int:
    """Turn the samples of a recording into a record.

    Args:
        mcap: the recording.
        csv: the record; an older file of that name is replaced.
        plant: whose samples; may be left out if there is but one plant in it.

    Returns:
        The number of rows.

    Raises:
        InputError: the recording cannot be read, or it is not said of which plant.
    """
    refuse_source(csv, (mcap,))
    record = read_record(mcap, plant)
    write_csv(csv, record)
    return record.rows


def _check_times(csv: Path, record: Record, zero_ns: int) -> None:
    times_ns = [to_time_ns(minutes, zero_ns) for minutes in record.time_min.tolist()]
    for time_ns in (times_ns[0], times_ns[-1]):
        if not 0 <= time_ns < 2**63:
            raise InputError(f"{csv}: times must lie between 1970 and 2262 to be recorded, got {time_ns} ns")
    for row, (before, after) in enumerate(itertools.pairwise(times_ns)):
        if before >= after:
            got = f"{record.time_min[row]} and {record.time_min[row + 1]} min"
            raise InputError(f"{csv}: rows must be at least 1 microsecond apart to be recorded, got {got}")
