"""Single options that several commands share, and parsers of their values; `option_groups.py` has the groups."""

import re
from collections.abc import Callable, Iterable
from math import inf
from pathlib import Path
from typing import Annotated, TypeVar

import typer
from typer import Argument, Option

from reactorwatch.errors import InputError
from reactorwatch.records.write import check_output_file

Value = TypeVar("Value")
MAX_WAIT_S = 86_400.0
"""Largest timeout: the system's clocks take no infinite times."""

Json = Annotated[bool, Option("--json", help="One JSON object, for machines.")]

Reference = Annotated[
    str | None, Option(help="Model that predicts each row: auto, equations, black-box or arx [auto].")
]

Force = Annotated[
    bool, Option("--force", help="Replace a file that is there and is of another kind than its name says.")
]

Diagnose = Annotated[Path | None, Option(help="After an alarm, diagnose the recent rows into a folder in this one.")]

Files = Annotated[
    list[Path],
    Argument(
        help="Records (.csv or other tables) or recordings (.mcap), folders of them, or patterns such as 'runs/*.csv'."
    ),
]

Recording = Annotated[Path, Argument(help="A recording (.mcap), a folder of them, or a record (.csv).")]
RecordFile = Annotated[Path, Argument(help="A record (.csv) or recording (.mcap).")]
Seed = Annotated[int | None, Option(help="Of the input and the noise.")]
Speed = Annotated[str | None, Option(help="Plant time over wall time: a number, or 'max' [1].")]
Begin = Annotated[str | None, Option("--from", help="Since the start, such as 10min [the start].")]
End = Annotated[str | None, Option("--to", help="Since the start, such as 20min [the end].")]
Jobs = Annotated[int | None, Option(help="How many at a time, each in a process [one a core].", min=1)]

Scheduler = Annotated[
    str | None, Option(help="Of a Dask cluster to do it, such as tcp://127.0.0.1:8786 (reactorwatch[cluster]).")
]

Site = Annotated[
    Path | None, Option(help="Folder that `certify` made: run its router, and each node with its certificate [none].")
]


def check_encodable(text: str | None) -> str | None:
    """Check that a text can be sent in a message; returns it."""
    try:
        (text or "").encode()
    except UnicodeEncodeError as error:
        raise typer.BadParameter(f"must be UTF-8, got {text!r}") from error
    return text


def parse_columns(pairs: list[str] | None) -> dict[str, str]:
    """Parse `signal=column` pairs to names of columns by signal."""
    names = {}
    for pair in pairs or []:
        signal, equals, column = pair.partition("=")
        if not (signal and equals and column):
            raise InputError(f"--column must be signal=column, such as T=reactor_temp, got {pair!r}")
        names[signal] = column
    return names


def split_at_commas(texts: Iterable[str] | None) -> list[str]:
    """Split texts at their commas."""
    return [name.strip() for text in texts or () for name in text.split(",")]


def split_names(texts: list[str] | None) -> tuple[str, ...]:
    """Split values of an option that is repeatable or comma separated to names, each once.

    >>> split_names(["h1,h2", "h3", "h1"])
    ('h1', 'h2', 'h3')
    """
    return tuple(dict.fromkeys(filter(None, split_at_commas(texts))))


def parse_tolerances(text: str | None) -> dict[str, float]:
    """Parse `C=0.002,T=0.5` to tolerances by output."""
    return _parse_values(text, float, "--tolerance must be output=number, such as C=0.002,T=0.5")


def parse_limits(text: str | None) -> dict[str, tuple[float, float]]:
    """Parse `qc=85..115,T=425..455` to the lowest and highest values in an experiment, by signal."""

    def ends(value: str) -> tuple[float, float]:
        low, _, high = value.partition("..")
        return float(low), float(high)

    return _parse_values(text, ends, "--limits must be signal=lowest..highest, such as qc=85..115,T=425..455")


def _parse_values(text: str | None, parse: Callable[[str], Value], rule: str) -> dict[str, Value]:
    """Parse `name=value` with commas between; the rule is what an error says."""
    values = {}
    for part in text.split(",") if text is not None else ():
        name, _, value = (item.strip() for item in part.partition("="))
        try:
            values[name] = parse(value)
        except ValueError:
            raise InputError(f"{rule}, got {part!r}") from None
    return values


def parse_pace(text: str | None, option: str) -> float | None:
    """Parse a speed or a rate: a positive number, or `max` for infinity."""
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
    """Parse a span of time, such as `90s`, `10min`, `1.5h` or `-20min`, to nanoseconds."""
    match = re.fullmatch(r"(-?\d+(?:\.\d+)?)(s|min|h)", text)
    if match is None:
        raise InputError(f"{option} must be a number with s, min or h, such as 10min, got {text!r}")
    from reactorwatch.records.record import LONGEST_MIN

    span_s = float(match[1]) * _SECONDS[match[2]]
    if span_s > LONGEST_MIN * 60:
        raise InputError(f"{option} must be at most 146 years ({LONGEST_MIN / 60:,.0f}h), got {text}")
    return round(span_s * 1e9)


def check_recording(path: Path) -> Path:
    """Check that an input file, or a folder of recordings, exists; returns its path."""
    return path if path.is_dir() else check_input(path)


def check_input(path: Path) -> Path:
    """Check that an input file exists; returns its path."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder, a file was expected")
    if not path.exists():
        raise InputError(f"{path}: there is no such file")
    return path


def check_output(path: Path, suffix: str | tuple[str, ...], sources: Iterable[Path | None], *, force: bool) -> Path:
    """Check that an output file may be written and has the right suffix; returns its path."""
    check_output_file(path, sources, force=force)
    suffixes = (suffix,) if isinstance(suffix, str) else suffix
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: the name must end in {' or '.join(suffixes)}, got {path.suffix or 'no ending'}")
    return path
