"""Any combination of forms reads to the same numbers: separators, decimal signs, times, headers, missing values."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.read import read_table

START = datetime(2026, 10, 24, 22, 30, tzinfo=UTC)


def stamp(second: int, form: str) -> str:
    return (START + timedelta(seconds=second)).strftime(form)


TIMES: dict[str, Callable[[int], str]] = {
    "time_min": lambda second: f"{second / 60:.9f}",
    "Time (sec)": lambda second: f"{second}",
    "t [h]": lambda second: f"{second / 3600:.12f}",
    "elapsed_ms": lambda second: f"{1000 * second}",
    "Timestamp": lambda second: stamp(second, "%Y-%m-%dT%H:%M:%SZ"),
    "Zeit": lambda second: stamp(second, "%d.%m.%Y %H:%M:%S"),
    "date": lambda second: stamp(second, "%d-%b-%Y %H:%M:%S"),
    "ts": lambda second: f"{int(START.timestamp()) + second}",
}
"""Forms of a time in whole seconds, by the header of its column."""

HOLES = ("", "NA", "NaN", "Bad Input", "#WERT!", "-999")
NAMES = ("F1", "level", "TI-101", "Druck", "x y", "7B")
TITLES = ("Export", "# comment", "", "Anlage 7: Reaktor")
UNITS = ("bar", "l/min", "K", "%", "", "degC")


@dataclass(frozen=True)
class Form:
    """Form of a written table; the time is the column number `position`, from 0."""

    separator: str
    decimal: str
    time: str
    hole: str
    digits: int
    position: int
    units: str
    above: tuple[str, ...]
    newline: str
    mark: bool
    trailing: bool
    transposed: bool

    def write(self, seconds: list[int], values: NDArray[np.float64]) -> bytes:
        """The bytes of a table, values of shape (rows, columns); NaN: missing."""
        names = list(NAMES[: values.shape[1]])
        units = list(UNITS[: values.shape[1]])
        if self.units == "header":
            names = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True)]
        rows = [self._row(names, self.time)]
        if self.units == "row":
            rows.append(self._row(units, {"Time (sec)": "s", "t [h]": "h"}.get(self.time, "")))
        for second, row in zip(seconds, values.tolist(), strict=True):
            cells = [self.hole if np.isnan(value) else f"{value:.{self.digits}f}" for value in row]
            rows.append(self._row([cell.replace(".", self.decimal) for cell in cells], self._time(second)))
        if self.transposed:
            rows = [
                self.separator.join(cells) for cells in zip(*(row.split(self.separator) for row in rows), strict=True)
            ]
        text = self.newline.join([*self.above, *rows]) + self.newline
        return ("\ufeff" if self.mark else "").encode() + text.encode()

    def _time(self, second: int) -> str:
        text = TIMES[self.time](second)
        return text.replace(".", self.decimal) if self.time in ("time_min", "t [h]") else text

    def _row(self, cells: list[str], time: str) -> str:
        at = min(self.position, len(cells))
        return self.separator.join([*cells[:at], time, *cells[at:]]) + self.separator * self.trailing


@st.composite
def forms(draw: st.DrawFn) -> Form:
    separator = draw(st.sampled_from([",", ";", "\t", "|"]))
    transposed = draw(st.booleans())
    return Form(
        separator=separator,
        decimal="." if separator == "," else draw(st.sampled_from([".", ","])),
        time=draw(st.sampled_from(list(TIMES))),
        hole=draw(st.sampled_from(HOLES)),
        digits=draw(st.sampled_from([1, 2, 4, 6])),
        position=draw(st.integers(0, 6)),
        units=draw(st.sampled_from(["none", "header", "row"])),
        above=() if transposed else tuple(draw(st.lists(st.sampled_from(TITLES), max_size=3))),
        newline=draw(st.sampled_from(["\n", "\r\n", "\r"])),
        mark=draw(st.booleans()),
        trailing=draw(st.booleans()) and not transposed,
        transposed=transposed,
    )


@given(form=forms(), rows=st.integers(4, 30), columns=st.integers(1, 6), seed=st.integers(0, 999))
@settings(max_examples=200, deadline=None)
def test_any_combination_of_forms_reads_to_the_same_numbers(
    tmp_path_factory: pytest.TempPathFactory, form: Form, rows: int, columns: int, seed: int
) -> None:
    random = np.random.default_rng(seed)
    scales = 10.0 ** random.integers(0, 4, columns)
    values = np.asarray(np.round(random.normal(size=(rows, columns)) * scales, form.digits), dtype=np.float64)
    values[1:][random.random((rows - 1, columns)) < 0.2] = np.nan
    seconds = np.cumsum(random.integers(1, 30, rows)).tolist()
    path = tmp_path_factory.mktemp("forms") / "record.csv"
    path.write_bytes(form.write(seconds, values))
    record = read_table(path, None, FileFormat(missing=("-999",)))
    assert list(record.columns) == list(NAMES[:columns]), path.read_bytes()[:300]
    minutes = np.array(seconds) / 60
    np.testing.assert_allclose(record.time_min - record.time_min[0], minutes - minutes[0], rtol=0, atol=1e-8)
    for number, found in enumerate(record.columns.values()):
        np.testing.assert_array_equal(found, values[:, number], err_msg=str(path.read_bytes()[:300]))
    expected = {name: unit for name, unit in zip(NAMES[:columns], UNITS, strict=False) if unit}
    assert record.units == ({} if form.units == "none" else expected)
