"""Files of real rigs and public benchmarks read at the first try; only a period is stated, where none is there."""

from pathlib import Path

import numpy as np
import pytest

from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.read import SignalColumn, read_table

TEP = FileFormat(period="3 min")


@pytest.mark.parametrize(
    ("file", "stated", "rows", "signals", "last_min", "zero"),
    [
        ("tep/d00.dat", TEP, 500, 52, 1497.0, None),
        ("tep/d00_te.dat", TEP, 960, 52, 2877.0, None),
        ("skab/valve1_0.csv", FileFormat(), 1147, 10, 1199 / 60, "2020-03-09T10:14:33Z"),
        ("three_tanks/normal.csv", FileFormat(), 8004, 5, 8003 / 60, None),
        ("cascaded_tanks/estimation.csv", FileFormat(), 1024, 2, 1023 * 4 / 60, None),
        ("tclab/tclab.csv", FileFormat(), 599, 6, 9.98, None),
        ("daisy_cstr.csv", FileFormat(), 7500, 3, 750.0, None),
    ],
)
def test_a_given_file_reads_at_the_first_try(
    given_data: Path, file: str, stated: FileFormat, rows: int, signals: int, last_min: float, zero: str | None
) -> None:
    record = read_table(given_data / file, None, stated)
    assert (record.rows, len(record.columns), record.zero, record.runs) == (rows, signals, zero, None)
    assert record.time_min[-1] == pytest.approx(last_min, abs=0.01)
    assert all(np.isfinite(values).all() for values in record.columns.values())


def test_both_orientations_of_one_benchmark_have_the_same_signals(given_data: Path) -> None:
    normal, later = (read_table(given_data / f"tep/{name}.dat", None, TEP) for name in ("d00", "d00_te"))
    assert list(normal.columns) == list(later.columns) == [str(number) for number in range(1, 53)]
    for name, values in normal.columns.items():
        spread = 6 * max(values.std(), later.columns[name].std())
        assert abs(values.mean() - later.columns[name].mean()) <= spread


def test_columns_are_called_by_header_or_number_and_have_the_units_in_brackets(given_data: Path) -> None:
    heaters = [SignalColumn("Heater 1", role="input"), SignalColumn("T1", "K", column="Temperature 1")]
    record = read_table(given_data / "tclab/tclab.csv", heaters)
    assert record.units == {"Heater 1": "%", "T1": "K"}
    assert record.columns["T1"][0] == pytest.approx(20.83 + 273.15)
    third = read_table(given_data / "tep/d00.dat", [SignalColumn("3"), SignalColumn("feed", column="1")], TEP)
    assert third.columns["feed"][0] == 0.24987
