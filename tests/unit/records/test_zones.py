"""Local times to UTC around the changes of clocks, held to the standard library's zones."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NoReturn
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from reactorwatch.errors import InputError
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.read import read_table
from reactorwatch.records.timestamps import to_utc

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
