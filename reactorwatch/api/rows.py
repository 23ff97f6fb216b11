"""Rows for a monitor, from wherever they come: records, data frames, or any iterable of rows."""

from collections.abc import Iterator, Mapping
from datetime import datetime
from typing import Any, TypeAlias

from reactorwatch.errors import InputError
from reactorwatch.records.record import Record

Row: TypeAlias = tuple[float, dict[str, float]]
"""Minute, and values by signal; NaN: not measured."""


def iterate_rows(source: Any, time: str = "time_min") -> Iterator[Row]:
    """Iterate over rows.

    Args:
        source: a record; a data frame (pandas or polars); or an iterable of mappings, such as a `csv.DictReader`, a
            generator that reads a socket, or a database cursor with rows by name.
        time: name of the column with the time: minutes, or clock times (`datetime`), which are counted from the first.

    Raises:
        InputError: a row has no time, or a cell is no number.
    """
    if isinstance(source, Record):
        for row, minute in enumerate(source.time_min.tolist()):
            yield minute, {name: float(values[row]) for name, values in source.columns.items()}
        return
    zero: datetime | None = None
    for number, row in enumerate(_mappings(source)):
        if not isinstance(row, Mapping):
            raise InputError(f"row {number}: must be a mapping of names to values, got {type(row).__name__}")
        if time not in row:
            raise InputError(f"row {number}: has no {time!r}, only {', '.join(map(str, row))}; name it with time=")
        moment = row[time]
        if isinstance(moment, datetime):
            zero = zero or moment
            minute = (moment - zero).total_seconds() / 60
        else:
            minute = _number(moment, time, number)
        yield minute, {str(name): _number(value, str(name), number) for name, value in row.items() if name != time}


def _mappings(source: Any) -> Iterator[Any]:
    """Rows of a data frame by name; another iterable as it is."""
    if hasattr(source, "iter_rows"):  # polars
        yield from source.iter_rows(named=True)
    elif hasattr(source, "itertuples"):  # pandas
        flat = source if source.index.name is None else source.reset_index()
        names = list(flat.columns)
        yield from (dict(zip(names, row, strict=True)) for row in flat.itertuples(index=False, name=None))
    else:
        yield from source


def _number(value: Any, name: str, number: int) -> float:
    if value is None or value == "":
        return float("nan")
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"row {number}: {name} must be a number, got {value!r}") from error
