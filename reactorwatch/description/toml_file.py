"""A process as a TOML document: its signals and, by name, equations of the catalogue with given constants."""

import re
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Annotated, Any

import msgspec

from reactorwatch.description.process import KnownParameter, Process, Signal, describe_model
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.limits import parse_toml
from reactorwatch.records.file_format import FileFormat

_Column = str | Annotated[int, msgspec.Meta(ge=1)]


class _Signal(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    role: str
    unit: str = ""
    column: _Column | None = None
    resolution: float | None = None
    bounds: tuple[float, float] | None = None


class _Time(msgspec.Struct, forbid_unknown_fields=True):
    column: _Column | None = None
    period: str | None = None
    unit: str | None = None
    zone: str | None = None
    format: str | None = None
    dates: str | None = None


class _File(msgspec.Struct, forbid_unknown_fields=True):
    header: bool | None = None
    separator: str | None = None
    decimal: str | None = None
    transposed: bool | None = None
    tag: _Column | None = None
    value: _Column | None = None
    sheet: _Column | None = None
    quality_good: tuple[str | int, ...] = ()
    resample: str | None = None


class _Document(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    signals: tuple[_Signal, ...]
    equations: str | None = None
    generic: bool = False
    parameters: dict[str, KnownParameter] = {}  # msgspec copies the default
    missing: tuple[str | float, ...] = ()
    time: _Time = msgspec.field(default_factory=_Time)
    file: _File = msgspec.field(default_factory=_File)


_KEYS = {
    "--time-unit": "[time] unit",
    "--time-format": "[time] format",
    "--missing": "missing",
    "--dates": "[time] dates",
    "--period": "[time] period",
    "--zone": "[time] zone",
    "--separator": "[file] separator",
    "--decimal": "[file] decimal",
    "--tag": "[file] tag",
    "--value": "[file] value",
    "--sheet": "[file] sheet",
    "--resample": "[file] resample",
}
"""Keys by the options that state the same."""

_PLACE = re.compile(r" - at `\$\.?([^`]*)`")
_SIGNAL = re.compile(r"signals\[(\d+)\]")
_UNKNOWN_FIELD = re.compile(r"Object contains unknown field `(\w+)`")
_STRUCTS: Mapping[str, type[msgspec.Struct]] = {
    "": _Document,
    "signals": _Signal,
    "time": _Time,
    "file": _File,
    "parameters": KnownParameter,
}


def parse_process(content: bytes, find_equations: Callable[[str], Process]) -> Process:
    """Parse the description of a process.

    Args:
        content: the TOML document.
        find_equations: returns the process whose equations, effects and controllers a name stands for.

    Raises:
        InputError: it is not TOML, or a part of it breaks a rule.
    """
    return parse_tables(parse_toml(content), find_equations)


def parse_tables(tables: Mapping[str, Any], find_equations: Callable[[str], Process]) -> Process:
    """Parse the tables of a description, see `parse_process`.

    Raises:
        InputError: a part of it breaks a rule.
    """
    try:
        document = msgspec.convert(tables, _Document)
    except msgspec.ValidationError as error:
        raise InputError(_describe_error(str(error), tables)) from error
    described: dict[str, Any] = {}
    if document.equations is not None:
        named = find_equations(document.equations)
        described = {name: getattr(named, name) for name in ("equations", "effects", "controllers", "operation")}
    return Process(
        document.name,
        tuple(Signal(**msgspec.structs.asdict(item)) for item in document.signals),
        parameters=document.parameters,
        file_format=_file_format(document),
        generic=document.generic,
        **described,
    )


def to_tables(process: Process) -> dict[str, Any]:
    """Tables that describe the signals and files of a process, without its equations; `parse_tables` reads them."""
    stated = process.file_format
    time = _Time(stated.time, stated.period, stated.time_unit, stated.zone, stated.time_format, stated.dates)
    file = _File(**{field.name: getattr(stated, field.name) for field in msgspec.structs.fields(_File)})
    signals = [
        {name: value for name, value in asdict(signal).items() if value is not None and value != ""}
        for signal in process.signals
    ]
    return {
        "name": process.name,
        "signals": signals,
        **({"generic": True} if process.generic else {}),
        **({"missing": list(stated.missing)} if stated.missing else {}),
        **{
            name: given
            for name, table in (("time", time), ("file", file))
            if (
                given := {key: value for key, value in msgspec.structs.asdict(table).items() if value not in (None, ())}
            )
        },
    }


def add_description(extended: Mapping[str, Any], process: Process) -> dict[str, Any]:
    """Object of an extended model with the description of its process, unless it has just the signals of its equations.

    Args:
        extended: object of the extended model, see `reactorwatch.process.extended_model`.
        process: the process, which has equations.
    """
    named = describe_model(process.require_model())
    own = (process.name, process.signals, process.file_format, process.generic)
    is_plain = own == (named.name, named.signals, named.file_format, named.generic)
    return dict(extended) if is_plain else {**extended, "process": to_tables(process)}


def _file_format(document: _Document) -> FileFormat:
    """Statements of a document about its files."""
    time, file = document.time, document.file
    if time.column is not None and time.period is not None:
        raise InputError(
            f"[time] has a column or a period, got column {time.column!r} and period {time.period!r}; leave one out"
        )
    try:
        return FileFormat(
            time=None if time.column is None else str(time.column),
            time_unit=time.unit,
            zone=time.zone,
            time_format=time.format,
            dates=time.dates,
            period=time.period,
            missing=tuple(str(cell) for cell in document.missing),
            **{
                **msgspec.structs.asdict(file),
                **{
                    name: None if (given := getattr(file, name)) is None else str(given)
                    for name in ("tag", "value", "sheet")
                },
                "quality_good": tuple(map(str, file.quality_good)),
            },
        )
    except InputError as error:
        text = str(error)
        for option, key in _KEYS.items():
            text = text.replace(option, key)
        raise InputError(text) from error


def _find_wrong_parameter(tables: Mapping[str, Any]) -> str:
    """Name of the first parameter of the wrong form."""
    for name, table in tables.items():
        try:
            msgspec.convert(table, KnownParameter)
        except msgspec.ValidationError:
            return name
    return ""


def _describe_error(text: str, tables: Mapping[str, Any]) -> str:
    """Describe a part of the wrong form by its table or signal; for an unknown key with the valid ones."""
    match = _PLACE.search(text)
    place = match[1] if match else ""
    text = _PLACE.sub("", text)
    table = re.split(r"[.\[]", place)[0]
    unknown = _UNKNOWN_FIELD.search(text)
    if unknown is not None and table in _STRUCTS:
        text = describe_unknown("key", unknown[1], [item.name for item in msgspec.structs.fields(_STRUCTS[table])])
    if table == "parameters":
        place = place.replace("[...]", f" {_find_wrong_parameter(tables['parameters'])!r}", 1)
    index = _SIGNAL.match(place)
    if index is not None:
        number = int(index[1])
        named = tables["signals"][number]
        name = named.get("name") if isinstance(named, dict) else None
        place = place.replace(index[0], f"signal {name!r}" if name else f"signal {number + 1}", 1)
    return f"{place}: {text}" if place else text
