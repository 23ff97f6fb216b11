"""Times of the rows and names of the columns: what is read, and what is ambiguous."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NoReturn
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from reactorwatch.errors import InputError
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.read import SignalColumn, read_table
from reactorwatch.records.record import Record
from reactorwatch.records.timestamps import to_utc

START = datetime(2026, 3, 4, 8, tzinfo=UTC)
REACTOR = [SignalColumn("qc", "l/min"), SignalColumn("C", "mol/l"), SignalColumn("T", "K")]


def read(
    folder: Path,
    header: str,
    rows: list[str],
    signals: list[SignalColumn] | None = None,
    stated: FileFormat | None = None,
) -> Record:
    path = folder / "table.csv"
    path.write_text("\n".join([header, *rows]) + "\n")
    return read_table(path, signals, stated or FileFormat())


STAMPS = {
    "%Y-%m-%dT%H:%M:%SZ": "yyyy-mm-dd hh:mm:ss",
    "%Y-%m-%d %H:%M:%S": "yyyy-mm-dd hh:mm:ss, time zone unknown, taken as UTC",
    "%d.%m.%Y %H:%M:%S": "dd.mm.yyyy hh:mm:ss, time zone unknown, taken as UTC",
    "%d-%b-%Y %H:%M:%S": "dd-Mon-yyyy hh:mm:ss, time zone unknown, taken as UTC",
}


@pytest.mark.parametrize("form", STAMPS)
@pytest.mark.parametrize("name", ["time_s", "time_min"])
@pytest.mark.parametrize("stated", [None, FileFormat(time_unit="s")], ids=["", "with a unit"])
def test_stamps_under_a_name_of_minutes_or_seconds_are_read_as_stamps(
    tmp_path: Path, name: str, form: str, stated: FileFormat | None
) -> None:
    times = [START + timedelta(seconds=20 * row) for row in range(30)]
    record = read(tmp_path, f"{name},y", [f"{time:{form}},{row}" for row, time in enumerate(times)], stated=stated)
    np.testing.assert_allclose(record.time_min, np.arange(30) / 3, rtol=0, atol=1e-9)
    assert record.zero == "2026-03-04T08:00:00Z"
    assert record.read_as == f"time `{name}` {STAMPS[form]}"


def test_a_time_of_day_under_such_a_name_has_the_date_beside_it(tmp_path: Path) -> None:
    rows = [f"2026-03-04,08:{row:02d}:00,{row}" for row in range(30)]
    assert read(tmp_path, "date,time_s,y", rows).zero == "2026-03-04T08:00:00Z"


@pytest.mark.parametrize("zero", [0, 46082, 1772352000], ids=["small", "days of a spreadsheet", "Unix seconds"])
def test_numbers_under_such_a_name_are_no_stamps_whatever_their_size(tmp_path: Path, zero: int) -> None:
    record = read(tmp_path, "time_s,y", [f"{zero + row},{row}" for row in range(3)])
    assert record.zero_ns == 0
    assert record.read_as == ""


@settings(max_examples=40, deadline=None)
@given(
    names=st.tuples(
        st.sampled_from(["qc", "QC", "Qc", "qC"]), st.sampled_from(["C", "c"]), st.sampled_from(["T", "t"])
    ),
    time=st.sampled_from(["time_s", "timestamp", "Zeit"]),
    unit=st.sampled_from(["", " [K]"]),
    is_long=st.booleans(),
)
def test_names_in_another_case_are_taken_and_named(
    tmp_path_factory: pytest.TempPathFactory, names: tuple[str, str, str], time: str, unit: str, is_long: bool
) -> None:
    folder = tmp_path_factory.mktemp("case")
    values = {name: np.arange(20) * 0.5 + shift for name, shift in zip(names, (100.0, 0.1, 438.0), strict=True)}
    if is_long:
        stamps = [(START + timedelta(seconds=row)).isoformat() for row in range(20)]
        rows = [f"{stamps[row]},{name},{values[name][row]}" for name in names for row in range(20)]
        record = read(folder, "timestamp,tag,value", rows, REACTOR)
    else:
        header = ",".join([time, *names]) + unit
        rows = [",".join(map(str, [row, *(values[name][row] for name in names)])) for row in range(20)]
        record = read(folder, header, rows, REACTOR)
    for signal, name in zip(("qc", "C", "T"), names, strict=True):
        np.testing.assert_array_equal(record.columns[signal], values[name])
        assert (f"{signal} from `{name}`" in record.read_as) == (signal != name)


@pytest.mark.parametrize(
    ("header", "line"),
    [
        ("t,QC,c", "expected a column 'T' in the header"),
        ("time_s,QC,Qc,C,T", "expected a column 'qc' in the header"),
        ("time_s,QC,c,temp", "expected a column 'T' in the header"),
    ],
)
def test_a_name_with_two_readings_is_refused(tmp_path: Path, header: str, line: str) -> None:
    rows = [",".join([str(row)] * (header.count(",") + 1)) for row in range(5)]
    with pytest.raises(InputError, match=line):
        read(tmp_path, header, rows, REACTOR)


def test_the_only_time_is_no_signal_in_another_case(tmp_path: Path) -> None:
    """`t` would be the temperature if another column was the time."""
    signals = [*REACTOR[:2], SignalColumn("T", "K", required=False)]
    rows = [f"{row},100,0.1" for row in range(5)]
    assert list(read(tmp_path, "t,QC,c", rows, signals).columns) == ["qc", "C"]
    stated = FileFormat(period="1 s")
    assert list(read(tmp_path, "t,QC,c", rows, signals, stated).columns) == ["qc", "C", "T"]


def test_two_signals_that_differ_in_case_share_no_column(tmp_path: Path) -> None:
    rows = [f"{row},1,2" for row in range(5)]
    signals = [SignalColumn("y"), SignalColumn("C"), SignalColumn("c", required=False)]
    assert list(read(tmp_path, "time_s,C,y", rows, signals).columns) == ["y", "C"]
    with pytest.raises(InputError, match="expected a column 'ab'"):
        read(tmp_path, "time_s,AB,y", rows, [SignalColumn("ab"), SignalColumn("aB", required=False)])


def sampled(start: datetime, step: timedelta, rows: int) -> list[datetime]:
    return [start + step * row for row in range(rows)]


MINUTE = timedelta(minutes=1)
COURSES = {
    "a day above twelve, late": sampled(datetime(2026, 3, 4, 8, tzinfo=UTC), 20 * MINUTE, 800),
    "a day above twelve, early": sampled(datetime(2026, 3, 14, 8, tzinfo=UTC), 20 * MINUTE, 100),
    "over midnight": sampled(datetime(2026, 3, 4, 23, tzinfo=UTC), MINUTE, 200),
    "over the end of a month": sampled(datetime(2026, 1, 31, 23, tzinfo=UTC), MINUTE, 200),
    "over the end of a year": sampled(datetime(2025, 12, 31, 23, tzinfo=UTC), MINUTE, 200),
    "daily": sampled(datetime(2026, 3, 1, tzinfo=UTC), timedelta(days=1), 40),
    "in order only one way": [
        *sampled(datetime(2026, 1, 2, 8, tzinfo=UTC), MINUTE, 20),
        *sampled(datetime(2026, 2, 1, 8, tzinfo=UTC), MINUTE, 20),
    ],
}


@pytest.mark.parametrize("course", COURSES)
@pytest.mark.parametrize("sign", ["/", "-", "."])
@pytest.mark.parametrize("order", ["day-first", "month-first"])
@pytest.mark.parametrize("turn", [1, -1], ids=["oldest first", "newest first"])
def test_rows_and_the_order_of_times_decide_about_day_and_month(
    tmp_path: Path, course: str, sign: str, order: str, turn: int
) -> None:
    times = COURSES[course]
    form = f"%d{sign}%m{sign}%Y %H:%M" if order == "day-first" else f"%m{sign}%d{sign}%Y %H:%M"
    rows = [f"{time:{form}},{row}" for row, time in enumerate(times)]
    record = read(tmp_path, "Zeit,y", rows[::turn])
    minutes = [(time - times[0]) / MINUTE for time in times]
    np.testing.assert_allclose(record.time_min, minutes, rtol=0, atol=1e-6)
    assert record.zero == times[0].strftime("%Y-%m-%dT%H:%M:%SZ")
    first, second = ("dd", "mm") if order == "day-first" else ("mm", "dd")
    assert f"time `Zeit` {first}{sign}{second}{sign}yyyy" in record.read_as


OPEN_DATES = {
    "one date": [f"03{{0}}04{{0}}2026 10:{row:02d}" for row in range(30)],
    "one row a date, which may be days or months": [f"03{{0}}{row:02d}{{0}}2026" for row in range(4, 12)],
    "two digits of the year": [f"03{{0}}04{{0}}26 10:{row:02d}" for row in range(30)],
}


@pytest.mark.parametrize("kind", OPEN_DATES)
@pytest.mark.parametrize("sign", ["/", "-"])
def test_dates_that_may_be_read_both_ways_are_refused_and_read_as_stated(tmp_path: Path, kind: str, sign: str) -> None:
    rows = [f"{date.format(sign)},{row}" for row, date in enumerate(OPEN_DATES[kind])]
    with pytest.raises(InputError) as refused:
        read(tmp_path, "Zeit,y", rows)
    assert "day and month are ambiguous" in str(refused.value)
    assert "state --dates month-first or --dates day-first" in str(refused.value)
    for dates, day in (("month-first", "2026-03-04"), ("day-first", "2026-04-03")):
        assert str(read(tmp_path, "Zeit,y", rows, None, FileFormat(dates=dates)).zero).startswith(day)


def test_points_mean_day_first_unless_stated(tmp_path: Path) -> None:
    rows = [f"03.04.2026 10:{row:02d},{row}" for row in range(30)]
    assert str(read(tmp_path, "Zeit,y", rows).zero).startswith("2026-04-03")
    assert str(read(tmp_path, "Zeit,y", rows, None, FileFormat(dates="month-first")).zero).startswith("2026-03-04")


def test_a_clock_column_beside_minutes_with_ambiguous_dates_is_no_zero(tmp_path: Path) -> None:
    rows = [f"{row},03/04/2026 10:{row:02d},{row}" for row in range(30)]
    assert read(tmp_path, "time_min,time,y", rows).zero_ns == 0


CHANGES = {
    "Europe/Berlin": (datetime(2026, 3, 29, 1, tzinfo=UTC), datetime(2026, 10, 25, 1, tzinfo=UTC)),
    "America/New_York": (datetime(2026, 3, 8, 7, tzinfo=UTC), datetime(2026, 11, 1, 6, tzinfo=UTC)),
    "Australia/Lord_Howe": (datetime(2026, 4, 4, 15, tzinfo=UTC), datetime(2026, 10, 3, 15, 30, tzinfo=UTC)),
}
"""Clocks there change by an hour, or by half an hour."""


def refuse(row: int, rule: str) -> NoReturn:
    raise InputError(f"row {row}: {rule}")


def local_and_utc(zone: str, times: list[datetime]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    utc = np.array([np.datetime64(time.replace(tzinfo=None), "ns").astype(np.int64) for time in times])
    offsets = [time.astimezone(ZoneInfo(zone)).utcoffset() or timedelta() for time in times]
    return utc + np.array([round(offset.total_seconds()) for offset in offsets]) * 10**9, utc


@given(
    zone=st.sampled_from(list(CHANGES)),
    autumn=st.booleans(),
    before=st.integers(1, 200),
    after=st.integers(1, 200),
    period_s=st.sampled_from([1, 6, 60, 600, 1800]),
)
def test_rows_over_a_change_of_clocks_come_back_to_utc(
    zone: str, autumn: bool, before: int, after: int, period_s: int
) -> None:
    change = CHANGES[zone][autumn]
    times = [change + timedelta(seconds=period_s * row) for row in range(-before, after)]
    local, utc = local_and_utc(zone, times)
    np.testing.assert_array_equal(to_utc(local, zone, refuse), utc)


@pytest.mark.parametrize("gap", ["first pass", "second pass"])
def test_rows_of_one_pass_of_an_hour_that_occurs_twice_join_their_neighbours(gap: str) -> None:
    zone, change = "Europe/Berlin", CHANGES["Europe/Berlin"][1]
    times = [change + timedelta(minutes=minute) for minute in range(-120, 120)]
    missing = range(-60, -30) if gap == "first pass" else range(60)
    kept = [time for time in times if (time - change) // timedelta(minutes=1) not in missing]
    local, utc = local_and_utc(zone, kept)
    if gap == "second pass":
        with pytest.raises(InputError, match="row 60: expected a time that is unique in Europe/Berlin"):
            to_utc(local, zone, refuse)
    else:
        np.testing.assert_array_equal(to_utc(local, zone, refuse), utc)


@pytest.mark.parametrize(("zone", "hours"), [("+01:00", 1), ("-0330", -3.5), ("UTC", 0), ("UTC+2", 2), ("GMT-5", -5)])
def test_a_fixed_offset_is_subtracted(zone: str, hours: float) -> None:
    local = np.array([10**18], dtype=np.int64)
    assert to_utc(local, zone, refuse)[0] == 10**18 - hours * 3600 * 10**9


@pytest.mark.parametrize("offset", ["+01:00", "+0100", "+01", "+01:"])
def test_an_offset_is_read_in_each_of_its_forms(tmp_path: Path, offset: str) -> None:
    path = tmp_path / "record.csv"
    path.write_text("time,T\n" + "".join(f"2026-01-01 10:0{minute}:00{offset},{minute}\n" for minute in range(3)))
    assert read_table(path, None, FileFormat()).zero_ns == datetime(2026, 1, 1, 9, tzinfo=UTC).timestamp() * 1e9
