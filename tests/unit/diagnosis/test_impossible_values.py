"""Values that no signal can have are named with file, row, column and the cure, before anything is fitted to them."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from reactorwatch.api.simulation import simulate_along
from reactorwatch.cli.diagnosis import DiagnosisOptions, load_case
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.errors import InputError
from reactorwatch.process.library.cascaded_tanks import tanks
from reactorwatch.process.library.cstr import cstr
from reactorwatch.records.record import Record
from reactorwatch.records.write import write_table
from tests.tables import read_csv
from tests.unit.diagnosis.rig import Rig
from tests.unit.diagnosis.rig import record_of as rig_record
from tests.unit.diagnosis.runs import record_of

ROWS = 400
SENTINELS = (-999.0, -9999.0, -1.0, 9999.0, 65535.0, 1e30, -1e300)
MODELS = {"qc": cstr(), "C": cstr(), "T": cstr(), "u": tanks(), "x2": tanks()}
BOUNDS = {"qc": (0.0, 500.0), "C": (-0.1, 2.1), "T": (240.0, 710.0), "u": (0.0, 10.0), "x2": (-3.0, 53.0)}
"""Of the states one scale more to either side."""


@cache
def sound(signal: str) -> Record:
    """A record with that signal."""
    return record_of(rows=ROWS) if MODELS[signal].name == "cstr" else rig_record(Rig(), seed=1, rows=ROWS)


def spoiled(record: Record, signal: str, rows: list[int], value: float) -> Record:
    """The same with a value in some rows of a column."""
    values = record.columns[signal].copy()
    values[rows] = value
    return replace(record, columns=record.columns | {signal: values})


@settings(max_examples=40)
@given(
    signal=st.sampled_from(sorted(MODELS)),
    value=st.one_of(st.sampled_from(SENTINELS), st.floats(allow_nan=False, allow_infinity=False)),
    rows=st.sets(st.integers(0, ROWS - 1), min_size=1, max_size=ROWS // 2),
)
def test_any_value_outside_a_signals_bounds_is_named_in_any_rows(signal: str, value: float, rows: set[int]) -> None:
    lower, upper = BOUNDS[signal]
    assume(not lower <= value <= upper)
    record = spoiled(sound(signal), signal, sorted(rows), value)
    with pytest.raises(InputError) as told:
        make_run(record, MODELS[signal])
    said, place = str(told.value), f"at {record.time_min[min(rows)]:g} min, column '{signal}'"
    assert f"{record.name}, {place}: must be in [{lower:g}, {upper:g}]" in said
    assert f"got {value:g}" in said
    assert said.endswith("empty the cells that mean 'not measured'")
    assert (f"and {len(rows) - 1} more of it" in said) == (len(rows) > 1)


@pytest.mark.parametrize("signal", ["qc", "C", "T"])
@pytest.mark.parametrize("rows", [[0], [123], list(range(5, ROWS, 50))])
def test_of_a_file_the_row_is_its_line(signal: str, rows: list[int], tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write_table(path, spoiled(sound("qc"), signal, rows, -999.0))
    line = next(number for number, text in enumerate(path.read_text().split("\n"), start=1) if "-999" in text)
    with pytest.raises(InputError, match=rf"a\.csv, row {line} \(.*\), column '{signal}': .* got -999"):
        load_case(path, DiagnosisOptions())
    with pytest.raises(InputError, match=rf"row {line} \(.*\), column '{signal}': .* got -999"):
        simulate_along(read_csv(path), cstr(), [])


@pytest.mark.parametrize("signal", sorted(MODELS))
def test_values_at_the_bounds_are_no_sentinels(signal: str) -> None:
    record = spoiled(spoiled(sound(signal), signal, [7], BOUNDS[signal][0]), signal, [9], BOUNDS[signal][1])
    make_run(record, MODELS[signal])


def test_where_lines_are_no_rows_only_the_time_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write_table(path, spoiled(sound("qc"), "T", [2], 9999.0))
    lines = path.read_text().split("\n")
    path.write_text("\n".join([*lines[:2], "", *lines[2:]]))
    with pytest.raises(InputError, match=r"a\.csv, at 0\.2 min, column 'T'"):
        load_case(path, DiagnosisOptions())
