"""Find a process, and read measured data of it from tables of any common form.

A process is found by name in the catalogue, in a file that describes it, or by the columns of its signals. The
catalogue holds the processes that are shipped, and installed ones (entry points). A file is a `.toml`, a `.py` or an
`extended.json`. Only a user chooses a file, by an option, a settings file or an argument (`find_process`). A name that
data state, such as the settings in a recording, is looked up in the catalogue (`find_in_catalogue`) and never opened as
a path.
"""

import runpy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.description.process import Process, Signal, describe_model
from reactorwatch.description.toml_file import parse_process, parse_tables
from reactorwatch.errors import InputError, describe_exception, describe_unknown, prefix_errors
from reactorwatch.process import DEFAULT_PROCESS, MODELS
from reactorwatch.process.extended_model import ExtendedModel, parse_extended_model
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.decode import check_workbook, read_regular, wrap_read_errors
from reactorwatch.records.file_format import GUESS, FileFormat
from reactorwatch.records.read import MissingColumnError, SignalColumn, read_table
from reactorwatch.records.record import LARGEST_VALUE, Record, join_files
from reactorwatch.records.resampling import resample
from reactorwatch.records.times import STANDARD
from reactorwatch.units import conversion

FUNCTION = "process"
"""Function of a `.py` file that returns the process."""

FILE_KINDS = (".toml", ".py", ".json")
"""Suffixes of files that describe a process."""

GROUP = "reactorwatch.processes"
"""Group of entry points by which other packages add processes: functions that return a `Process`."""

ALIASES = {"cascaded_tanks": "tanks"}
"""Other names of shipped processes."""


def catalogue() -> dict[str, Callable[[], Process]]:
    """Functions that return processes, by name; a shipped process goes before an installed one of its name."""
    models = [make() for make in MODELS]
    shipped: dict[str, Callable[[], Process]] = {model.name: partial(describe_model, model) for model in models}
    shipped |= {alias: shipped[name] for alias, name in ALIASES.items()}
    installed = {item.name: partial(_load, item) for item in entry_points(group=GROUP)}
    return {**shipped, **{name: load for name, load in installed.items() if name not in shipped}}


def _load(entry: EntryPoint) -> Process:
    """Call the function of an entry point."""
    name = f"process {entry.name!r} of {entry.value}"
    try:
        found = entry.load()()
    except Exception as error:  # code of another package may raise anything
        raise InputError(f"{name}: {describe_exception(error)}") from error
    return check_process(found, name)


def check_process(found: object, name: str) -> Process:
    """Check that what a function of a user's code returned is a process; returns it.

    Raises:
        InputError: it is not.
    """
    if not isinstance(found, Process):
        raise InputError(f"{name}: must return a reactorwatch Process, got {type(found).__name__}")
    return found


def find_process(
    process: str | Path | Process | ProcessModel = DEFAULT_PROCESS, zero_ns: int = 0, *, on_bus: bool = False
) -> Process:
    """Find a process.

    Args:
        process: a name in the catalogue; a path to a `.toml`, to a `.py`, whose function `process()` is run, or to an
            extended model (`.json`); or the process itself.
        zero_ns: time from which the minutes of an extended model's effects are to count, in nanoseconds since
            1970-01-01 UTC; 0: the zero that its file states.
        on_bus: True if the minutes are to count from 1970-01-01 UTC, as those of samples on the bus; `zero_ns` is then
            the zero of a file that states none.

    Raises:
        InputError: there is no such name or file, or the file does not describe a process; the text starts with its
            path.
    """
    if isinstance(process, Process):
        return process
    if isinstance(process, ProcessModel):
        return describe_model(process)
    path = Path(process)
    kind = path.suffix.lower()
    if kind not in FILE_KINDS:
        return _find_by_name(str(process), "process", "a path to a .toml, .py or .json file")
    with wrap_read_errors(path), prefix_errors(f"process file {path}"):
        content = read_regular(path)
    with prefix_errors(f"process file {path}"):
        if kind == ".toml":
            return parse_process(content, lambda name: _find_equations(name, path.parent, zero_ns, on_bus=on_bus))
        if kind == ".py":
            return check_process(_call_function(path), f"{FUNCTION}()")
        extended = parse_extended_model(content)
        if on_bus:
            extended = replace(extended, zero_ns=extended.zero_ns or zero_ns).rebase(0)
        elif zero_ns:
            extended = extended.rebase(zero_ns)
        return build_process(extended)


def find_in_catalogue(name: str, source: str) -> Process:
    """Find a process that data name: in the catalogue only, whatever file the name may be the path of.

    Args:
        name: the name, as the data state it.
        source: the data, for the error.

    Raises:
        InputError: the catalogue has no such process.
    """
    processes = catalogue()
    if name not in processes:
        raise InputError(
            f"{source}: is of process {name!r}, which is in no catalogue here, and a file that data name is not "
            "opened; name its file by --process"
        )
    return processes[name]()


def build_process(extended: ExtendedModel) -> Process:
    """Process of an extended model: as its file describes it, else with the signals of the equations.

    Raises:
        InputError: the model cannot be built, or the description breaks a rule.
    """
    named = describe_model(extended.build())
    if extended.description is None:
        return named
    return parse_tables({**extended.description, "equations": extended.name}, lambda _name: named)


def _find_by_name(name: str, what: str, otherwise: str) -> Process:
    """Process of the catalogue; an error says what the name stands for, and what could be stated otherwise."""
    processes = catalogue()
    if name not in processes:
        raise InputError(f"{describe_unknown(what, name, processes)}, or {otherwise}")
    return processes[name]()


def _find_equations(name: str, folder: Path, zero_ns: int, *, on_bus: bool) -> Process:
    """Process of the catalogue, or the extended model in a file; a relative path counts from a folder."""
    if Path(name).suffix.lower() == ".json":
        return find_process(folder / name, zero_ns, on_bus=on_bus)
    return _find_by_name(name, "equations", "the path of an extended.json")


def _call_function(path: Path) -> object:
    """Run a file of the user, as `python FILE` would, and call its function."""
    try:
        names = runpy.run_path(str(path))
        if FUNCTION in names:
            return names[FUNCTION]()
    except (InputError, KeyboardInterrupt):
        raise
    except BaseException as error:  # the user's code may raise anything, and may call sys.exit
        raise InputError(describe_exception(error)) from error
    raise InputError(f"it must have a function {FUNCTION}() that returns a Process, got none")


@dataclass(frozen=True)
class ProcessChoice:
    """Choice of a process.

    Attributes:
        process: a name in the catalogue or a path, see `find_process`; None: the reactor, unless columns are named.
        inputs: columns that are inputs of a process without a description.
        outputs: columns that are its outputs.
        modes: columns that say how it is operated.

    Raises:
        InputError: a process and columns are named, or inputs or modes without an output.
    """

    process: str | None = None
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    modes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.process is not None and (self.inputs or self.outputs or self.modes):
            raise InputError(
                "--input, --output and --mode describe a process without a file, got them beside --process "
                f"{self.process}; leave one of the two out"
            )
        for role, names in (("mode", self.modes), ("input", self.inputs)):
            if names and not self.outputs:
                raise InputError(f"--{role} needs an --output, got only the {role} {', '.join(names)}")

    @property
    def is_default(self) -> bool:
        """True if neither a process nor columns are named."""
        return self.process is None and not self.outputs

    @property
    def file(self) -> Path | None:
        """File that describes the process; None: it is named otherwise."""
        path = None if self.process is None else Path(self.process)
        return path if path is not None and path.suffix.lower() in FILE_KINDS else None

    def absolute(self) -> "ProcessChoice":
        """Copy with the absolute path of the file."""
        return self if self.file is None else replace(self, process=str(self.file.absolute()))

    def load(self, zero_ns: int = 0, *, on_bus: bool = False) -> Process:
        """Load the process.

        Args:
            zero_ns: time from which the minutes of an extended model count; 0: the one that its file states.
            on_bus: see `find_process`.

        Raises:
            InputError: as `find_process`.
        """
        if self.outputs:
            roles = {"input": self.inputs, "output": self.outputs, "mode": self.modes}
            signals = (Signal(name, role=role) for role, names in roles.items() for name in names)
            return Process("plant", tuple(signals))
        return find_process(self.process or DEFAULT_PROCESS, zero_ns, on_bus=on_bus)


DEFAULT_CHOICE = ProcessChoice()
"""No process and no columns are named: the reactor."""


class PlantProcesses:
    """Processes by plant.

    Args:
        names: name or file of a process by plant, or by a pattern of plants such as `north_*`; a plant's own entry goes
            before patterns, and the first pattern counts.

    Raises:
        InputError: a process cannot be loaded.
    """

    def __init__(self, names: Mapping[str, str]) -> None:
        loaded = {name: ProcessChoice(name).load() for name in dict.fromkeys(names.values())}
        self._processes = {plant: loaded[name] for plant, name in names.items()}

    def find(self, plant: str) -> Process | None:
        """Process of a plant; None: it is not stated."""
        if plant in self._processes:
            return self._processes[plant]
        return next((item for pattern, item in self._processes.items() if fnmatchcase(plant, pattern)), None)


def read_extended_model(path: Path) -> ExtendedModel:
    """Read the model in a file.

    Raises:
        InputError: the file cannot be read, or holds no model; the text starts with its path.
    """
    try:
        return parse_extended_model(read_regular(path))
    except OSError as error:
        raise InputError(f"model file {path}: cannot be read: {error.strerror}") from error
    except InputError as error:
        raise InputError(f"model file {path}: {error}") from error


def read_process_table(
    files: Path | Sequence[Path],
    process: Process,
    columns: Mapping[str, str] | None = None,
    stated: FileFormat = GUESS,
) -> Record:
    """Read the signals of a process from a table, or from several in a row.

    Args:
        files: the file, see `read_table`, or the files.
        process: decides which signals are read, from which columns and in which units; its inputs and outputs must be
            there.
        columns: names of columns with other names, by signal, or by `time_min` or `time_s`. Such a column has the unit
            in brackets at its end, or an unknown one.
        stated: statements about the file, which override those of the process.

    Returns:
        The record, in the units of the equations; without equations, in those of the signals; its rows resampled, if
        that is stated. A value outside the bounds of its signal is NaN, as if it was not measured; `excluded` has it,
        and `read_as` their number.

    Raises:
        InputError: as `read_table`, `join_files` and `resample`; or `columns` names no signal of the process.
    """
    paths = [files] if isinstance(files, Path) else files
    for path in paths:  # the sheet of the process is for its workbooks, and it may have other files too
        check_workbook(path, stated.sheet)
    stated = process.file_format.override(stated)
    return resample_rows(join_files([_read_table(path, process, columns, stated) for path in paths]), process, stated)


def _read_table(path: Path, process: Process, columns: Mapping[str, str] | None, stated: FileFormat) -> Record:
    """Read one table; see `read_process_table`."""
    names = dict(columns or {})
    for name, unit in STANDARD.items():
        if name in names:
            stated = replace(stated, time=names.pop(name), time_unit=unit)
    known = [signal.name for signal in process.signals]
    for name in names:
        if name not in known:
            valid = (*STANDARD, *known)
            raise InputError(f"{path}: --column SIGNAL=NAME: {describe_unknown('signal', name, valid)}")
    signals = [
        SignalColumn(
            signal.name,
            unit="" if names.get(signal.name, signal.name) != signal.name else signal.unit,
            role=signal.role,
            column=names.get(signal.name, None if signal.column is None else str(signal.column)),
            required=signal.role in ("input", "output") or signal.name in names,
        )
        for signal in process.signals
    ]
    try:
        measured = read_table(path, signals, stated)
    except MissingColumnError as error:
        if process.name != DEFAULT_PROCESS:
            raise
        cure = "name its process with --process"
        if process.model is None:
            cure += ", or its columns with --input and --output"
        raise InputError(f"{error}; if it is no record of the reactor, {cure}") from error
    return _to_model_units(_exclude_impossible(measured, process), process)


def resample_rows(record: Record, process: Process | None, stated: FileFormat) -> Record:
    """Resample the rows of a process's record, if that is stated; without a process all signals are outputs.

    Raises:
        InputError: as `resample`.
    """
    rule = stated.resample_rule
    signals = () if process is None else process.signals
    return record if rule is None else resample(record, rule, {item.name: item.role for item in signals})


def read_signals(
    files: Path | Sequence[Path],
    choice: ProcessChoice,
    columns: Mapping[str, str] | None = None,
    stated: FileFormat = GUESS,
) -> Record:
    """Read the signals of a chosen process from tables, in the units of the signals, for use without equations.

    Args:
        files: see `read_process_table`.
        choice: the process.
        columns: see `read_process_table`.
        stated: see `read_process_table`.

    Raises:
        InputError: as `read_process_table`.
    """
    return read_process_table(files, choice.load().without_equations(), columns, stated)


def convert_to_process(record: Record, process: Process) -> Record:
    """Convert recorded signals to the units of a process, and exclude values outside their bounds.

    Args:
        record: samples in the units that they were published in; one without a unit is in that of its signal.
        process: decides the units: those of the equations, else those of the signals.

    Raises:
        InputError: a unit is one of another quantity.
    """
    known = {name: unit for name, unit in process.units.items() if name in record.columns}
    described = replace(record, units={**known, **record.units})
    return _to_model_units(_exclude_impossible(_convert(described, known), process), process)


def _exclude_impossible(record: Record, process: Process) -> Record:
    """Exclude values outside the bounds of their signals.

    Those of an input or output remain samples, since a monitor checks their range.
    """
    columns, excluded = record.raw_columns, dict[str, Array]()
    notes = [record.read_as] if record.read_as else []
    for signal in process.signals:
        if signal.bounds is None or signal.name not in columns:
            continue
        low, high = signal.bounds
        values = columns[signal.name]
        outside = (values < low) | (values > high)
        if outside.any():
            columns[signal.name] = np.where(outside, np.nan, values)
            if signal.role in ("input", "output"):
                excluded[signal.name] = np.where(outside & (np.abs(values) < LARGEST_VALUE), values, np.nan)
            counted = f"{np.count_nonzero(outside)} values of {signal.name} outside {low:g} to {high:g}"
            notes.append(f"{counted} are no measurements")
    return replace(record, columns=columns, read_as=", ".join(notes), excluded=excluded)


def _to_model_units(record: Record, process: Process) -> Record:
    """Convert signals of the equations to their units there."""
    return record if process.model is None else _convert(record, process.model.units)


def _convert(record: Record, wanted_units: Mapping[str, str]) -> Record:
    """Convert signals to units, by name of the signal."""
    columns, units, excluded = dict(record.columns), dict(record.units), dict(record.excluded)
    for name, wanted in wanted_units.items():
        unit = units.get(name, wanted)
        if unit == wanted or name not in columns:
            continue
        scale, offset = conversion(unit, wanted, f"{record.name}, signal {name!r}")
        columns[name], units[name] = scale * columns[name] + offset, wanted
        if name in excluded:
            excluded[name] = scale * excluded[name] + offset
    return replace(record, columns=columns, units=units, excluded=excluded)
