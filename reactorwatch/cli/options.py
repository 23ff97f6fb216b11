"""Options that several commands share, and parsers of their values."""

import re
from collections.abc import Iterable
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reactorwatch.errors import InputError
from reactorwatch.records.output import check_output_file

if TYPE_CHECKING:
    from reactorwatch.description.choice import ProcessChoice

Settings = Annotated[
    Path | None, typer.Option("--config", help="Settings file (TOML), a table for each node.", show_default=False)
]
Endpoint = Annotated[str | None, typer.Option(help="Address of the router [tcp/127.0.0.1:7447].", show_default=False)]
Plant = Annotated[str | None, typer.Option("--plant", help="Name of the plant [cstr].", show_default=False)]
Json = Annotated[bool, typer.Option("--json", help="One JSON object, for machines.")]
MAX_WAIT_S = 86_400.0
"""Largest timeout: the system's clocks take no infinite times."""

Columns = Annotated[
    list[str] | None,
    typer.Option("--column", help="A column of another name, as signal=column: --column T=reactor_temp."),
]

Model = Annotated[
    Path | None,
    typer.Option("--model", help="An extended model, as diagnose -o writes it [the nominal].", show_default=False),
]

Process = Annotated[
    str | None,
    typer.Option(
        "--process",
        "--model",
        help="A process: a name in the catalogue, or a .toml, .py or extended.json file [cstr].",
        show_default=False,
    ),
]
Inputs = Annotated[
    list[str] | None,
    typer.Option(
        "--input", help="A column that is an input, without a process (repeatable, or with commas).", show_default=False
    ),
]
Outputs = Annotated[
    list[str] | None,
    typer.Option(
        "--output", help="A column to watch, without a process (repeatable, or with commas).", show_default=False
    ),
]
Modes = Annotated[
    list[str] | None,
    typer.Option(
        "--mode",
        help="A column that says how the plant is operated, without a process (repeatable, or with commas).",
        show_default=False,
    ),
]
TrainingMin = Annotated[
    float | None,
    typer.Option("--training", help="Minutes to learn from [cstr: 100; else see --training-rows].", show_default=False),
]
TrainingRows = Annotated[
    int | None,
    typer.Option(
        "--training-rows",
        help="Rows to learn from, instead of minutes [1000, or a third of a record if that is fewer].",
        show_default=False,
    ),
]
Reference = Annotated[
    str | None,
    typer.Option(help="Model that predicts each row: auto, equations, black-box or arx [auto].", show_default=False),
]
Force = Annotated[
    bool, typer.Option("--force", help="Replace a file that is there and is of another kind than its name says.")
]

Diagnose = Annotated[
    Path | None,
    typer.Option(
        "--diagnose", help="After an alarm, diagnose the recent rows into a folder in this one.", show_default=False
    ),
]

Files = Annotated[
    list[Path],
    typer.Argument(
        help="Records (.csv or other tables) or recordings (.mcap), folders of them, or patterns such as 'runs/*.csv'.",
        show_default=False,
    ),
]
Processes = Annotated[
    int | None,
    typer.Option("--jobs", help="How many at a time, each in a process [one a core].", min=1, show_default=False),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        help="Of a Dask cluster to do it, such as tcp://127.0.0.1:8786 (reactorwatch[cluster]).", show_default=False
    ),
]


def check_encodable(text: str | None) -> str | None:
    """Check that a text can be sent in a message; returns it.

    Raises:
        BadParameter: the terminal sent bytes that are no UTF-8.
    """
    try:
        (text or "").encode()
    except UnicodeEncodeError as error:
        raise typer.BadParameter(f"must be UTF-8, got {text!r}") from error
    return text


def choose_process(
    process: str | None, inputs: list[str] | None, outputs: list[str] | None, modes: list[str] | None = None
) -> "ProcessChoice":
    """Choice of a process by `--process`, or by `--input`, `--output` and `--mode`.

    Raises:
        InputError: as `ProcessChoice`.
    """
    from reactorwatch.description.choice import ProcessChoice

    given = (inputs, outputs, modes)
    named = [tuple(name.strip() for text in texts or () for name in text.split(",")) for texts in given]
    return ProcessChoice(process, *named)


def training_flags(
    tables: dict[str, dict[str, Any]], minutes: float | None, rows: int | None
) -> dict[str, float | int | None]:
    """Flags of the length of a training; one that is given takes the place of a length in the settings file.

    Args:
        tables: tables of the settings file, from which a length is removed.
        minutes: duration in minutes; None: not given.
        rows: duration in rows; None: not given.
    """
    flags = {"training_min": minutes, "training_rows": rows}
    if minutes is not None or rows is not None:
        for name in flags:
            tables.get("monitor", {}).pop(name, None)
    return flags


def parse_columns(pairs: list[str] | None) -> dict[str, str]:
    """Parse `signal=column` pairs to names of columns by signal.

    Raises:
        InputError: a text is no such pair.
    """
    names = {}
    for pair in pairs or []:
        signal, equals, column = pair.partition("=")
        if not (signal and equals and column):
            raise InputError(f"--column must be signal=column, such as T=reactor_temp, got {pair!r}")
        names[signal] = column
    return names


def split_names(texts: list[str] | None) -> tuple[str, ...]:
    """Split values of an option that is repeatable or comma separated to names, each once.

    >>> split_names(["h1,h2", "h3", "h1"])
    ('h1', 'h2', 'h3')
    """
    names = (name.strip() for text in texts or () for name in text.split(","))
    return tuple(dict.fromkeys(filter(None, names)))


def parse_tolerances(text: str | None) -> dict[str, float]:
    """Parse `C=0.002,T=0.5` to tolerances by output.

    Raises:
        InputError: the text has another form.
    """
    tolerances = {}
    for part in text.split(",") if text is not None else ():
        output, _, value = (item.strip() for item in part.partition("="))
        try:
            tolerances[output] = float(value)
        except ValueError:
            raise InputError(f"--tolerance must be output=number, such as C=0.002,T=0.5, got {part!r}") from None
    return tolerances


def parse_limits(text: str | None) -> dict[str, tuple[float, float]]:
    """Parse `qc=85..115,T=425..455` to the lowest and highest values in an experiment, by signal.

    Raises:
        InputError: the text has another form.
    """
    limits = {}
    for part in text.split(",") if text is not None else ():
        signal, _, ends = (item.strip() for item in part.partition("="))
        low, _, high = ends.partition("..")
        try:
            limits[signal] = (float(low), float(high))
        except ValueError:
            raise InputError(
                f"--limits must be signal=lowest..highest, such as qc=85..115,T=425..455, got {part!r}"
            ) from None
    return limits


def parse_pace(text: str | None, option: str) -> float | None:
    """Parse a speed or a rate: a positive number, or `max` for infinity.

    Raises:
        InputError: the text is neither.
    """
    if text is None:
        return None
    if text == "max":
        return inf
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < inf:
        raise InputError(f"{option} must be a positive number or 'max', got {text!r}")
    return value


_SECONDS = {"s": 1, "min": 60, "h": 3600}


def parse_span_ns(text: str, option: str) -> int:
    """Parse a span of time, such as `90s`, `10min`, `1.5h` or `-20min`, to nanoseconds.

    Raises:
        InputError: the text has another form.
    """
    match = re.fullmatch(r"(-?\d+(?:\.\d+)?)(s|min|h)", text)
    if match is None:
        raise InputError(f"{option} must be a number with s, min or h, such as 10min, got {text!r}")
    from reactorwatch.records.record import LONGEST_MIN

    span_s = float(match[1]) * _SECONDS[match[2]]
    if span_s > LONGEST_MIN * 60:
        raise InputError(f"{option} must be at most 146 years ({LONGEST_MIN / 60:,.0f}h), got {text}")
    return round(span_s * 1e9)


def check_recording(path: Path) -> Path:
    """Check that an input file, or a folder of recordings, exists; returns its path.

    Raises:
        InputError: it does not.
    """
    return path if path.is_dir() else check_input(path)


def check_input(path: Path) -> Path:
    """Check that an input file exists; returns its path.

    Raises:
        InputError: it does not, or is a folder.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder, a file was expected")
    if not path.exists():
        raise InputError(f"{path}: there is no such file")
    return path


def check_output(path: Path, suffix: str | tuple[str, ...], sources: Iterable[Path | None], *, force: bool) -> Path:
    """Check that an output file may be written and has the right suffix; returns its path.

    Args:
        path: the file.
        suffix: the required suffix, or those of which it must have one.
        sources: see `check_output_file`.
        force: see `check_output_file`.

    Raises:
        InputError: as `check_output_file`; or its name has another suffix.
    """
    check_output_file(path, sources, force=force)
    suffixes = (suffix,) if isinstance(suffix, str) else suffix
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: the name must end in {' or '.join(suffixes)}, got {path.suffix or 'no ending'}")
    return path
