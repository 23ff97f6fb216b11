"""Convert between recordings (MCAP) and records (tables)."""

import itertools
from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from reactorwatch.contract import keys
from reactorwatch.contract.codec import encode
from reactorwatch.contract.messages_pb2 import Sample
from reactorwatch.description.process import Process
from reactorwatch.description.read import DEFAULT_CHOICE, ProcessChoice, convert_to_process, read_signals, resample_rows
from reactorwatch.errors import InputError
from reactorwatch.records.decode import check_workbook, is_table
from reactorwatch.records.file_format import GUESS, FileFormat
from reactorwatch.records.record import LONGEST_MIN, MINUTE_NS, Record, join_runs, to_time_ns
from reactorwatch.records.write import atomic_write, refuse_source, write_table
from recorder import RecordedMessage
from recorder.files.recording import (
    CLOCK,
    NO_CLOCK,
    PROCESS,
    ZERO_NS,
    Recording,
    has_clock,
    process_metadata,
    zero_from,
)
from recorder.files.writer import RecordingWriter
from recorder.panels.signals import signal_roles
from recorder.samples import RunSplitter, SampleSeries, decode_messages
from recorder.tools.player import samples_of


def import_csv(
    csv: Path | Sequence[Path],
    mcap: Path,
    plant: str | None = None,
    columns: Mapping[str, str] | None = None,
    zero_ns: int = 0,
    stated: FileFormat = GUESS,
    choice: ProcessChoice = DEFAULT_CHOICE,
) -> Record:
    """Convert a record to a recording; the time of receipt is the sample time.

    A recording holds no times before 1970. Where a record without clock time has some, all its times are shifted, and
    the recording's `zero_ns` holds the shift. A run that starts before the end of the run before is received after it.

    Args:
        csv: the record, or the files of it in a row.
        mcap: the recording; an existing file is replaced.
        plant: name of the plant; None: that of the process.
        columns: column names of the file by signal, as in `read_process_table`.
        zero_ns: time that the minutes of a record without clock time count from; 0 if unknown.
        stated: statements about the form of the file.
        choice: process of which the record is; its signals with their roles are described in the recording.

    Returns:
        The record.

    Raises:
        InputError: the record is malformed, or has times that a recording cannot hold; or the plant's name is invalid.
    """
    process = choice.load()
    plant = plant_name(plant, process)
    files = [csv] if isinstance(csv, Path) else list(csv)
    refuse_source(mcap, files)
    record = read_signals(files, choice, columns, stated)
    metadata = {"plant": plant, "source": record.name}
    zero_ns = record.zero_ns or zero_ns
    if not zero_ns:
        metadata[CLOCK] = NO_CLOCK
        zero_ns = record.stored_zero_ns
    _check_times(files[0], record, zero_ns)
    received = RunSplitter()
    with (
        atomic_write(mcap) as temporary,
        RecordingWriter(temporary, {**metadata, ZERO_NS: str(zero_ns)}) as writer,
    ):
        writer.add_metadata(PROCESS, process_metadata(plant, process, record))
        for publication in samples_of(record, plant, zero_ns):
            encoded = encode(publication)
            received_ns = received.continuous_ns(*publication)
            time_ns = publication.message.time_ns
            writer.write(RecordedMessage(encoded.key, encoded.payload, encoded.encoding, received_ns, time_ns))
    return record


def export_csv(
    mcap: Path,
    csv: Path,
    plant: str | None = None,
    *,
    clock: bool = False,
    stated: FileFormat = GUESS,
    choice: ProcessChoice = DEFAULT_CHOICE,
) -> Record:
    """Convert the samples of a recording, or a table of another form, to a record.

    Args:
        mcap: the recording, or the table.
        csv: the record, in the form of its suffix (see `write_table`); an existing file is replaced.
        plant: name of the plant; None if the recording has only one.
        clock: add a column with the clock time.
        stated: statements about the form of the table that is read.
        choice: process whose signals are exported, in its units; the default: all recorded signals, as recorded, and
            of a table those of the reactor.

    Returns:
        The record.

    Raises:
        InputError: the recording cannot be read, or has several plants and `plant` is None; or the record cannot be
            written, see `write_table`.
    """
    refuse_source(csv, (mcap,))
    check_workbook(mcap, stated.sheet)
    if is_table(mcap) and not mcap.is_dir():
        record = read_signals(mcap, choice, None, stated)
    else:
        process = None if choice.is_default else choice.load().without_equations()
        record = read_record(mcap, plant, process)
        if process is not None:
            record = convert_to_process(record, process)
        if stated.resample is not None:
            record = resample_rows(record, process or Recording(mcap).process(plant) or choice.load(), stated)
    write_table(csv, record, clock=clock)
    return record


def read_record(path: Path, plant: str | None = None, process: Process | None = None) -> Record:
    """Samples of one plant as rows of equal sample time; runs are split by `RunSplitter`.

    Args:
        path: the recording.
        plant: name of the plant; None if the recording has only one.
        process: process whose signals are read, its inputs and outputs in any case; None: all recorded signals.

    Returns:
        The signals in the units in which they were published, in the order of their process if there is one; NaN where
        a signal has no sample at the time of another one, or no valid one. The first of duplicate samples in a run
        counts, and stray samples are counted as `strays`. Time counts from `zero_ns` of the metadata, else from the
        first sample of the first run.

    Raises:
        InputError: as `Recording` and its `one_plant`; or there are no samples of the process.
    """
    recording = Recording(path)
    plant = recording.one_plant(plant)
    wanted = None if process is None else {signal.name for signal in process.signals}
    series = SampleSeries()
    for topic, sample in decode_messages(recording.messages({keys.SAMPLE}, plant)):
        if isinstance(sample, Sample) and (wanted is None or topic.name in wanted):
            series.add(topic.name, sample)
    runs, splitter, units = series.runs, series.splitter, series.units
    if not runs:
        sought = "that can be used" if process is None else f"of {', '.join(item.name for item in process.signals)}"
        raise InputError(f"{path}: holds no samples {sought} of plant {plant!r}")
    metadata, live = recording.metadata, recording.live
    zero_ns = zero_from(metadata, splitter.runs[0].first_ns)
    present = {name: units.get(name, "") for of_run in runs for name in of_run}
    needed = () if process is None else (*process.inputs, *process.outputs)
    if process is None and (process := recording.process(plant)) is not None:
        needed = tuple(signal.name for signal in process.signals)
    columns = signal_roles({**dict.fromkeys(needed, ""), **present}, process)
    full = [of_run for of_run in runs if any(times for times, _ in of_run.values())]
    rows = [_rows(of_run, columns, zero_ns, path.name) for of_run in full]
    clock_ns = zero_ns if has_clock(metadata) else 0
    read_as = "" if live is None else f"the intact part of {live.name}, which is still being recorded"
    return replace(join_runs(rows), zero_ns=clock_ns, strays=splitter.strays, units=units, read_as=read_as)


def _rows(
    series: dict[str, tuple["array[int]", "array[float]"]], names: Iterable[str], zero_ns: int, name: str
) -> Record:
    """Rows of one run, from times and values by signal."""
    all_times = np.unique(np.concatenate([np.asarray(times, np.int64) for times, _ in series.values()]))
    columns = {signal: np.full(all_times.size, np.nan) for signal in names}
    for signal, (times, values) in series.items():
        own_times, first = np.unique(np.asarray(times, np.int64), return_index=True)
        columns[signal][np.searchsorted(all_times, own_times)] = np.asarray(values)[first]
    return Record((all_times - zero_ns) / MINUTE_NS, columns, name)


def plant_name(plant: str | None, process: Process) -> str:
    """Name of a record's plant: the given one, else that of its process.

    Raises:
        InputError: it cannot be the name of a plant.
    """
    try:
        return keys.check_plant(plant or process.name)
    except ValueError as error:
        cure = "" if plant else f"; the name of process {process.name!r} is none, choose one by --plant"
        raise InputError(f"{error}{cure}") from error


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
