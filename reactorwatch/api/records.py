"""Measured records and their processes, from files, data frames and arrays."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from reactorwatch import html
from reactorwatch.api.files import described_process
from reactorwatch.api.files import record as read_file
from reactorwatch.api.shown import Drawn, page_of
from reactorwatch.description.process import Process
from reactorwatch.description.read import convert_to_process, find_process
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.figures import Line, Mark, Panel
from reactorwatch.optional import make_frame
from reactorwatch.process import DEFAULT_PROCESS, MODELS
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.record import LONGEST_MIN
from reactorwatch.records.record import Record as MeasuredRecord
from reactorwatch.records.write import write_frame

if TYPE_CHECKING:
    from pandas import DataFrame

ProcessLike: TypeAlias = str | Path | Process | ProcessModel

processes: Mapping[str, Callable[[], ProcessModel]] = {make().name: make for make in MODELS}
"""The processes that are shipped, by name: functions that build their models.

>>> import reactorwatch as rw
>>> sorted(rw.processes)
['cstr', 'tanks', 'three_tanks']
"""


FRAME = "data frame"
"""Name of a record that was read from one."""


@dataclass(frozen=True, init=False)
class Record(Drawn, MeasuredRecord):
    """A measured record with its process.

    Attributes:
        process: name, path or description of the process; None: the functions that take the record use the reactor.

    >>> record = Record(time_min=[0, 1, 2], signals={"u": [3.0, 3.0, 3.1], "x2": [5.0, 5.1, 5.0]}, process="tanks")
    >>> record.rows, record.signals["u"].max()
    (3, np.float64(3.1))
    """

    process: ProcessLike | None = None

    def __init__(
        self,
        time_min: Any,
        signals: Mapping[str, Any] | None = None,
        process: ProcessLike | None = None,
        **about: Any,
    ) -> None:
        """Make a record from arrays.

        Args:
            time_min: times in minutes, shape (rows,); where they step back, a new run of the plant begins.
            signals: values by signal, each of shape (rows,); NaN: not measured.
            process: the process; values are in the units of its signals unless `units` says otherwise.
            about: other fields of the record, such as `units` (by signal), `name` and `zero_ns`.

        Raises:
            InputError: a rule about times or shapes is broken, or a unit does not convert.
        """
        about.setdefault("name", "record")
        if signals is not None:
            about |= _check_arrays(time_min, signals, process, about)
            time_min = about.pop("time_min")
        super().__init__(time_min=time_min, **about)
        object.__setattr__(self, "process", process)

    @property
    def signals(self) -> dict[str, Any]:
        """Values by signal."""
        return self.columns

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the signals that are inputs of the process."""
        described = find_process(process_of(self, None))
        return tuple(name for name in described.inputs if name in self.columns)

    def _repr_html_(self) -> str:
        return record_html(self)

    def to_frame(self) -> "DataFrame":
        """Rows as a pandas data frame, with the clock time as index, or `time_min` where it is unknown.

        Raises:
            InputError: pandas is not installed.
        """
        return record_frame(self)

    def _panels(self) -> list[Panel]:
        return signal_panels(self, self.inputs)

    def _page(self) -> str:
        return page_of(self.name, self._repr_html_(), self._panels(), self.name)


def _check_arrays(
    time_min: Any, signals: Mapping[str, Any], process: ProcessLike | None, about: Mapping[str, Any]
) -> dict[str, Any]:
    """Fields of a record of arrays, converted to the units of its process."""
    name = about["name"]
    times = _array(time_min, f"{name}: time_min")
    if not times.size or not np.all(np.abs(times) <= LONGEST_MIN):
        raise InputError(f"{name}: time_min must be at least one finite number of minutes, got {times.size} values")
    columns = {signal: _array(values, f"{name}: signal {signal!r}") for signal, values in signals.items()}
    for signal, values in columns.items():
        if values.shape != times.shape:
            raise InputError(
                f"{name}: signal {signal!r} must have as many rows as time_min, {times.size}, got {values.size}"
            )
    steps = np.diff(times)
    if np.any(steps == 0):
        row = int(np.argmax(steps == 0))
        raise InputError(
            f"{name}: each row must have a time of its own, got {times[row]:g} min in rows {row} and {row + 1}"
        )
    runs = 1 + np.cumsum(np.diff(times, prepend=times[0]) < 0) if np.any(steps < 0) else None
    given = MeasuredRecord(times, columns, **{"runs": runs, **about})
    record = given if process is None else convert_to_process(given, find_process(process, given.zero_ns))
    return measured_fields(record)


def _array(values: Any, what: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} must be numbers: {error}") from error
    if array.ndim != 1:
        raise InputError(f"{what} must be one row of numbers, got an array of shape {array.shape}")
    return array


def measured_fields(record: MeasuredRecord) -> dict[str, Any]:
    """Fields of a measured record, by name."""
    return {item.name: getattr(record, item.name) for item in fields(MeasuredRecord)}


def read_record(
    file: Any,
    process: ProcessLike | None = None,
    *,
    plant: str | None = None,
    columns: Mapping[str, str] | None = None,
    **form: Any,
) -> Record:
    """Read a measured record.

    Args:
        file: a table (`.csv`, `.xlsx`, `.parquet` and others), a recording (`.mcap`), a folder of recordings, several
            files in a row, or a data frame (pandas, polars, Arrow).
        process: decides which signals the file must have, and how it is read; the functions that take the record use
            it. None: the one that a recording describes, else the reactor.
        plant: name of the plant in a recording; None: the only one in it.
        columns: names of the columns in a table, by signal, where they differ.
        form: what is not to be guessed about a table: `time`, `time_unit`, `time_format`, `dates`, `zone`, `period`,
            `missing`, `separator`, `decimal`, `header`, `transposed`, `tag`, `value`, `sheet`, `quality_good`
            and `resample`, like the options of the commands.

    Returns:
        The record; `read_as` has the guesses about a table.

    Raises:
        InputError: the file cannot be read, a signal is missing, or `form` has another name.
    """
    known = [item.name for item in fields(FileFormat)]
    for name in form:
        if name not in known:
            raise InputError(describe_unknown("argument", name, known))
    for name in {"missing", "quality_good"} & form.keys():
        words = (form[name],) if isinstance(form[name], str | float | int) else form[name]
        form[name] = tuple(map(str, words))
    for name in {"time", "tag", "value", "sheet"} & form.keys():
        form[name] = form[name] if form[name] is None else str(form[name])
    stated = FileFormat(**form)
    names = dict(columns or {})
    if hasattr(file, "__arrow_c_stream__") or hasattr(file, "__dataframe__"):
        described = find_process(process or DEFAULT_PROCESS)
        read = _read_frame(file, described, names, stated)
    else:
        files = [Path(item) for item in ([file] if isinstance(file, str | Path) else file)]
        described = described_process(files[0], plant) if process is None else find_process(process)
        read = read_file(files, plant, names, described, stated)
    if process is None and described.name != DEFAULT_PROCESS:
        process = described  # as the recording has it
    return Record(**measured_fields(read), process=process)


def _read_frame(frame: Any, process: Process, columns: dict[str, str], stated: FileFormat) -> MeasuredRecord:
    """Read a data frame by way of a file, so that it is read like one."""
    with TemporaryDirectory() as folder:
        file = write_frame(frame, Path(folder) / "frame.parquet")
        try:
            read = read_file(file, None, columns, process, stated)
        except InputError as error:
            raise InputError(str(error).replace(str(file), FRAME)) from error
    return replace(read, name=FRAME, read_as=read.read_as.removeprefix("Parquet").removeprefix(", "))


def process_of(record: MeasuredRecord, process: ProcessLike | None) -> ProcessLike:
    """The process that is named, else that of the record, else the reactor."""
    if process is not None:
        return process
    return getattr(record, "process", None) or DEFAULT_PROCESS


def model_of(record: MeasuredRecord, process: ProcessLike | None) -> ProcessModel:
    """Equations of the process of a record, their clock that of the record.

    Raises:
        InputError: there is no such process, its file cannot be read, it has no equations, or the record lacks a signal
            of them.
    """
    model = find_process(process_of(record, process), record.zero_ns).require_model()
    check_signals(record, model)
    return model


def check_signals(record: MeasuredRecord, model: ProcessModel) -> None:
    """Check that a record has the inputs and outputs of a model.

    Raises:
        InputError: it lacks one.
    """
    missing = [name for name in (*model.input_names, *model.output_names) if name not in record.columns]
    if missing:
        raise InputError(
            f"{record.name}: must have the signals of {model.name}, {', '.join(missing)} missing, got "
            f"{', '.join(record.columns) or 'none'}; read it with the process that it is of"
        )


def effects(process: ProcessLike = DEFAULT_PROCESS) -> tuple[Effect, ...]:
    """The effects of a process: what can be injected into its simulation and named as a cause.

    Args:
        process: name, path of a file that describes it, description or model.

    >>> effects("tanks")[0].name
    'pump_gain'
    """
    return find_process(process).causes


def record_frame(record: MeasuredRecord) -> "DataFrame":
    """Rows of a record with the index `time_min`, or with the clock time if it is known."""
    columns = {"run": record.runs, **record.columns} if record.runs is not None else dict(record.columns)
    if not record.zero_ns:
        return make_frame({"time_min": record.time_min, **columns}, "time_min")
    times = record.zero_ns + np.round(record.time_min * 60e6).astype(np.int64) * 1000
    return make_frame({"time": times.astype("datetime64[ns]"), "time_min": record.time_min, **columns}, "time")


def record_html(record: MeasuredRecord) -> str:
    """Rows, span and remarks of a record, and the range of each signal."""
    since = f", minutes since {record.zero}" if record.zero else ""
    rows = []
    for name, values in record.columns.items():
        known = values[np.isfinite(values)]
        low, high = (f"{known.min():.6g}", f"{known.max():.6g}") if known.size else ("", "")
        rows.append((name, record.units.get(name, ""), low, high, record.rows - known.size or ""))
    return "".join(
        [
            html.headline(f"{record.name}: {record.rows} rows over {record.span_min:g} min{since}"),
            *map(html.sentence, record.remarks),
            html.table(("signal", "unit", "lowest", "highest", "missing"), rows),
        ]
    )


def signal_panels(
    record: MeasuredRecord,
    inputs: tuple[str, ...],
    simulated: MeasuredRecord | None = None,
    names: tuple[str, ...] | None = None,
    marks: tuple[Mark, ...] = (),
) -> list[Panel]:
    """A panel for each signal, outputs first, with their simulation.

    Args:
        record: the measured record.
        inputs: names of its inputs.
        simulated: simulation in the same rows; None: there is none.
        names: signals that are shown; None: all.
        marks: moments and spans in all panels.
    """
    shown = [name for name in record.columns if names is None or name in names]
    panels, x_title = [], f"min since {record.zero}" if record.zero else "min"
    for name in sorted(shown, key=lambda item: item in inputs):
        unit, is_input = record.units.get(name, ""), name in inputs
        kind, label = ("input", name) if is_input else ("after" if simulated is None else "measured", "measured")
        lines = [Line(label, record.continuous_min, record.columns[name], kind, is_input)]
        if simulated is not None and not is_input and name in simulated.columns:
            lines.append(Line("simulated", simulated.continuous_min, simulated.columns[name], "before"))
        panels.append(Panel(f"{name}, {unit}" if unit else name, tuple(lines), marks, x_title))
    return panels
