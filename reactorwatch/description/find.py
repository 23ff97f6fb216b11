"""Find a process: by name in the catalogue, or in a file that describes it (`.toml`, `.py`, `extended.json`).

Only a user chooses a file, by an option, a settings file or an argument (`find_process`). A name that data state, such
as the settings in a recording, is looked up in the catalogue (`find_in_catalogue`) and never opened as a path.
"""

import runpy
from dataclasses import replace
from pathlib import Path

from reactorwatch.description.catalogue import catalogue, check_process
from reactorwatch.description.process import Process, describe_model
from reactorwatch.description.toml_file import parse_process, parse_tables
from reactorwatch.errors import InputError, describe_exception, describe_unknown, prefix_errors
from reactorwatch.process.extended_model import ExtendedModel, parse_extended_model
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.decode import read_regular, wrap_read_errors

FUNCTION = "process"
"""Function of a `.py` file that returns the process."""

DEFAULT_PROCESS = "cstr"

FILE_KINDS = (".toml", ".py", ".json")
"""Suffixes of files that describe a process."""


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
