"""The benchmark of speeds compares equal numbers, and prints a ratio for each form of a table."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import speed
from tests.tables import read_csv


def test_each_form_holds_the_same_numbers(tmp_path: Path) -> None:
    speed.write_tables(tmp_path, 50)
    record = speed.make_record(50, 4)
    for name in ("short", "german", "stamps"):
        found = read_csv(tmp_path / f"{name}.csv")
        np.testing.assert_allclose(found.time_min, record.time_min, rtol=0, atol=1e-12)
        for signal, values in record.columns.items():
            assert np.array_equal(found.columns[signal], values), (name, signal)


def test_the_table_has_a_line_for_each_form(capsys: pytest.CaptureFixture[str]) -> None:
    speed.tables(200, 1)
    assert [line.split()[2] for line in capsys.readouterr().out.splitlines()] == ["full", "short", "german", "stamps"]
