"""The benchmark of reading tables compares equal numbers, and prints a ratio for each form."""

import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import reading
from reactorwatch.records.write import write_table
from tests.tables import read_csv


def test_each_form_holds_the_same_numbers(tmp_path: Path) -> None:
    record = reading.make_record(50, 4)
    write_table(tmp_path / "short.csv", record)
    reading.write_german(tmp_path / "german.csv", tmp_path / "short.csv")
    reading.write_stamps(tmp_path / "stamps.csv", record)
    for name in ("short", "german", "stamps"):
        found = read_csv(tmp_path / f"{name}.csv")
        np.testing.assert_allclose(found.time_min, record.time_min, rtol=0, atol=1e-12)
        for signal, values in record.columns.items():
            assert np.array_equal(found.columns[signal], values), (name, signal)


def test_the_table_has_a_line_for_each_form(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["reading.py", "--rows", "200", "--repetitions", "1"])
    reading.main()
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["200", "full", "short", "german", "stamps", "goal:"]
