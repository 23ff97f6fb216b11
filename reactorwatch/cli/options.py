"""Options that several commands share, and how their values are read."""

import re
from collections.abc import Iterable
from math import inf
from pathlib import Path
from typing import Annotated

import typer

from reactorwatch.errors import InputError
from reactorwatch.records.output import check_output_file

Settings = Annotated[
    Path | None, typer.Option("--config", help="Settings file (TOML), a table for each node.", show_default=False)
]
Endpoint = Annotated[str | None, typer.Option(help="Address of the router [tcp/127.0.0.1:7447].", show_default=False)]
Plant = Annotated[str | None, typer.Option("--plant", help="Name of the plant [cstr].", show_default=False)]
Json = Annotated[bool, typer.Option("--json", help="One JSON object, for machines.")]
MAX_WAIT_S = 86_400.0
"""The system's clocks count no endless times."""

Columns = Annotated[
    list[str] | None,
    typer.Option("--column", help="A column of another name, as signal=column: --column T=reactor_temp."),
]

Model = Annotated[
    Path | None,
    typer.Option("--model", help="An extended model, as diagnose -o writes it [the nominal].", show_default=False),
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
        help="Records (.csv) or recordings (.mcap), folders of them, or patterns such as 'runs/*.csv'.",
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


def check_encodable(text: str) -> str:
    """A text that a message can carry.

    Raises:
        BadParameter: the terminal sent bytes that are no UTF-8.
    """
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise typer.BadParameter(f"must be UTF-8, got {text!r}") from error
    return text


def parse_columns(pairs: list[str] | None) -> dict[str, str]:
    """The columns' names by signal, from `signal=column` pairs.

    Raises:
        InputError: not such a pair.
    """
    named = {}
    for pair in pairs or []:
        signal, equals, column = pair.partition("=")
        if not (signal and equals and column):
            raise InputError(f"--column must be signal=column, such as T=reactor_temp, got {pair!r}")
        named[signal] = column
    return named


def parse_tolerances(text: str | None) -> dict[str, float]:
    """The differences that do not matter, by output, from `C=0.002,T=0.5`.

    Raises:
        InputError: not such a text.
    """
    found = {}
    for part in text.split(",") if text is not None else ():
        output, _, value = (item.strip() for item in part.partition("="))
        try:
            found[output] = float(value)
        except ValueError:
            raise InputError(f"--tolerance must be output=number, such as C=0.002,T=0.5, got {part!r}") from None
    return found


def parse_limits(text: str | None) -> dict[str, tuple[float, float]]:
    """The lowest and highest values that an experiment may lead to, by signal, from `qc=85..115,T=425..455`.

    Raises:
        InputError: not such a text.
    """
    found = {}
    for part in text.split(",") if text is not None else ():
        signal, _, ends = (item.strip() for item in part.partition("="))
        low, _, high = ends.partition("..")
        try:
            found[signal] = (float(low), float(high))
        except ValueError:
            raise InputError(
                f"--limits must be signal=lowest..highest, such as qc=85..115,T=425..455, got {part!r}"
            ) from None
    return found


def parse_pace(text: str | None, option: str) -> float | None:
    """A speed or a rate: a positive number, or `max` for as fast as it goes.

    Raises:
        InputError: neither.
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
    """A span of time, such as `90s`, `10min`, `1.5h` or `-20min`, in nanoseconds.

    Raises:
        InputError: no such span.
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
    """The path of a file that is to be read, or of a folder of recordings.

    Raises:
        InputError: there is none.
    """
    return path if path.is_dir() else check_input(path)


def check_input(path: Path) -> Path:
    """The path of a file that is to be read.

    Raises:
        InputError: there is none, or it is a folder.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder, a file was expected")
    if not path.exists():
        raise InputError(f"{path}: there is no such file")
    return path


def check_output(path: Path, suffix: str, sources: Iterable[Path | None], *, force: bool) -> Path:
    """The path of a file that is to be written.

    Args:
        path: the file.
        suffix: that its name must have, by which it is opened.
        sources: as for `check_output_file`.
        force: as for `check_output_file`.

    Raises:
        InputError: as `check_output_file`; or its name has another suffix.
    """
    check_output_file(path, sources, force=force)
    if path.suffix.lower() != suffix:
        raise InputError(f"{path}: the name must end in {suffix}, got {path.suffix or 'no ending'}")
    return path
