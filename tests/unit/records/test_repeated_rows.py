"""Rows that repeat a time: duplicates are left out and counted, of different rows the last values count."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reactorwatch.errors import InputError
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.read import read_table
from reactorwatch.records.record import Record, join_files

ROWS = [f"{10 * row},{20 + row * 37 % 11 / 10},{row % 3}" for row in range(60)]
HOURS = [f"2026-10-{1 + row // 24:02d} {row % 24:02d}:00:00,{20 + row * 37 % 11 / 10},{row % 3}" for row in range(60)]


def read(folder: Path, rows: list[str], header: str = "time_s,y,u") -> Record:
    path = folder / "table.csv"
    path.write_text("\n".join([header, *rows]) + "\n")
    return read_table(path)


def assert_is_original(record: Record, original: Record) -> None:
    np.testing.assert_array_equal(record.time_min, original.time_min)
    for name, values in original.columns.items():
        np.testing.assert_array_equal(record.columns[name], values)
    assert record.runs is None
    assert record.zero_ns == original.zero_ns


@settings(max_examples=40, deadline=None)
@given(
    copies=st.lists(st.tuples(st.integers(0, 59), st.integers(1, 20), st.integers(1, 3)), min_size=1, max_size=6),
    form=st.sampled_from(["seconds", "stamps each hour", "newest first"]),
)
def test_duplicates_one_by_one_or_in_blocks_are_left_out_and_counted(
    tmp_path_factory: pytest.TempPathFactory, copies: list[tuple[int, int, int]], form: str
) -> None:
    """A block of rows is written again at once, as where two exports overlap."""
    folder = tmp_path_factory.mktemp("duplicates")
    plain, header = (HOURS, "Zeit,y,u") if form == "stamps each hour" else (ROWS, "time_s,y,u")
    blocks = {last: (size, times) for last, size, times in copies}
    rows = []
    for index, row in enumerate(plain):
        size, times = blocks.get(index, (0, 0))
        rows += [row, *plain[max(0, index + 1 - size) : index + 1] * times]
    turn = -1 if form == "newest first" else 1
    original = read(folder, plain[::turn], header)
    record = read(folder, rows[::turn], header)
    assert_is_original(record, original)
    assert record.first_row is None
    assert f"duplicate rows left out: {len(rows) - len(plain)}" in record.read_as
    assert "merged" not in record.read_as


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_of_different_rows_of_one_time_the_last_measured_values_count_and_their_number_is_named(
    tmp_path: Path, depth: int
) -> None:
    rows = [*ROWS[:30], *[f"290,{60 + k},{'' if k == depth - 1 else 7 + k}" for k in range(depth)], *ROWS[30:]]
    record = read(tmp_path, rows)
    original = read(tmp_path, ROWS)
    np.testing.assert_array_equal(record.time_min, original.time_min)
    assert record.columns["y"][29] == 59 + depth
    assert record.columns["u"][29] == (6 + depth - 1 if depth > 1 else float(29 % 3))
    others = np.arange(60) != 29
    np.testing.assert_array_equal(record.columns["y"][others], original.columns["y"][others])
    assert f"rows merged into a later one of the same time, whose values count: {depth}" in record.read_as


def test_rows_of_one_time_of_which_each_has_other_signals_are_one_row(tmp_path: Path) -> None:
    rows = [row for k in range(20) for row in (f"{k},{k}.5,", f"{k},,{k}")]
    record = read(tmp_path, rows)
    assert record.columns["y"].tolist() == [k + 0.5 for k in range(20)]
    assert record.columns["u"].tolist() == list(range(20))


def test_a_clock_too_coarse_for_its_rows_is_refused(tmp_path: Path) -> None:
    """To keep the last row of each minute would drop most of what was measured."""
    rows = [f"2026-03-01 08:{row // 6:02d},{row}.5,1" for row in range(60)]
    with pytest.raises(InputError, match="row 3, column 'Zeit': expected a time after 2026-03-01 08:00"):
        read(tmp_path, rows, "Zeit,y,u")


def test_a_step_back_with_other_values_stays_a_run(tmp_path: Path) -> None:
    rows = [*ROWS[:40], *[row.replace(",2", ",5") for row in ROWS[20:50]]]
    record = read(tmp_path, rows)
    assert record.runs is not None
    assert [run.rows for run in record.split_runs()] == [40, 30]
    assert "left out" not in record.read_as


def test_an_hour_that_occurs_twice_is_still_refused_without_a_zone(tmp_path: Path) -> None:
    """25 October 2026 is the end of summer time in Europe: 02:00 comes twice, with other values."""
    rows = [
        f"2026-10-25 {hour:02d}:00:00,{20 + hour + turn / 10},1"
        for turn, hour in [(0, 0), (0, 1), (0, 2), (1, 2), (0, 3), (0, 4)]
    ]
    with pytest.raises(InputError, match="as at the end of summer time"):
        read(tmp_path, rows, "Zeit,y,u")


def test_times_a_nanosecond_apart_are_two_times(tmp_path: Path) -> None:
    rows = [f"2026-03-01 08:00:00.{number:09d},A,{number}" for number in (5, 1, 1, 2)]
    record = read(tmp_path, rows, "timestamp,tag,value")
    assert record.columns["A"].tolist() == [1.0, 2.0, 5.0]


@pytest.mark.parametrize("copied", [10, 70, 100, 130, 170, 200])
def test_duplicates_where_summer_time_ends_shift_no_time(tmp_path: Path, copied: int) -> None:
    """From 01:00 summer time, a row each minute: from 02:00 to 03:00 local times occur twice."""
    local = [minute if minute < 120 else minute - 60 for minute in range(240)]
    rows = [f"2026-10-25 {1 + time // 60:02d}:{time % 60:02d}:00,{minute}.5,1" for minute, time in enumerate(local)]
    path = tmp_path / "table.csv"
    path.write_text("\n".join(["Zeit,y,u", *rows[: copied + 1], rows[copied], *rows[copied + 1 :]]))
    record = read_table(path, None, FileFormat(zone="Europe/Berlin"))
    np.testing.assert_allclose(record.time_min, np.arange(240), rtol=0, atol=1e-9)
    assert record.columns["y"].tolist() == [minute + 0.5 for minute in range(240)]


@pytest.mark.parametrize("is_sorted", [True, False], ids=["by tag", "by time"])
def test_in_a_table_with_a_row_for_each_value_the_same_holds_for_each_tag(tmp_path: Path, is_sorted: bool) -> None:
    rows = [
        (f"2026-03-01 08:00:{k:02d}", tag, f"{k + shift}.5") for k in range(20) for shift, tag in ((0, "A"), (100, "B"))
    ]
    rows = sorted(rows, key=lambda row: row[1]) if is_sorted else rows
    event = (rows[7][0], rows[7][1], "77.5")
    table = [",".join(row) for row in [*rows[:5], rows[4], *rows[5:8], event, *rows[8:]]]
    record = read(tmp_path, table, "timestamp,tag,value")
    original = read(tmp_path, [",".join(row) for row in rows], "timestamp,tag,value")
    np.testing.assert_array_equal(record.time_min, original.time_min)
    changed = [values[original.columns[name] != values] for name, values in record.columns.items()]
    assert np.concatenate(changed).tolist() == [77.5]
    assert (
        "duplicate rows left out: 1, rows merged into a later one of the same time, whose values count: 1"
        in record.read_as
    )
    assert record.strays == 0


@pytest.mark.parametrize("overlap", [0, 1, 7])
def test_files_that_overlap_are_one_run(tmp_path: Path, overlap: int) -> None:
    parts = (ROWS[: 30 + overlap], ROWS[30:])
    record = join_files([read(tmp_path, part) for part in parts])
    assert_is_original(record, read(tmp_path, ROWS))
    assert record.read_as == (f"duplicate rows left out: {overlap}" if overlap else "")


def test_files_that_step_back_with_other_values_are_two_runs(tmp_path: Path) -> None:
    record = join_files([read(tmp_path, ROWS), read(tmp_path, [row.replace(",2", ",5") for row in ROWS])])
    assert [run.rows for run in record.split_runs()] == [60, 60]
    assert all((np.diff(run.time_min) > 0).all() for run, _ in pairwise([*record.split_runs(), record]))
