"""Records of several runs: where they start, what they are called, and how they are kept as CSV."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reactorwatch.errors import InputError
from reactorwatch.records.record import GAP_ROWS, Record, join_runs
from reactorwatch.records.write import write_table
from tests.tables import read_csv


def run(*times: float) -> Record:
    columns = {signal: np.arange(float(len(times))) + place for place, signal in enumerate(("qc", "C", "T"))}
    return Record(np.array(times), columns, "run.csv")


times_of_runs = st.lists(
    st.lists(st.integers(-(10**6), 10**6), min_size=3, max_size=20, unique=True).map(sorted), min_size=1, max_size=4
)


@given(times_of_runs)
def test_runs_come_back_from_a_csv_as_they_were(
    tmp_path_factory: pytest.TempPathFactory, times: list[list[int]]
) -> None:
    """Wherever a run starts: before, at or after the end of the one before it."""
    path = tmp_path_factory.mktemp("csv") / "run.csv"
    record = join_runs([run(*(item / 10 for item in one)) for one in times])
    write_table(path, record)
    found = read_csv(path)
    assert (",run\n" in path.read_text()) == (len(times) > 1)
    assert [item.time_min.tolist() for item in found.split_runs()] == [[item / 10 for item in one] for one in times]
    assert np.array_equal(found.columns["C"], record.columns["C"])


@given(times_of_runs)
def test_continuous_minutes_increase_and_each_run_keeps_its_spacing(times: list[list[int]]) -> None:
    record = join_runs([run(*map(float, one)) for one in times])
    continuous = record.continuous_min
    assert (np.diff(continuous) > 0).all()
    period = np.median(np.concatenate([np.diff(one) for one in times]))
    for start, shift, one in zip(record.run_starts, record.run_shifts_min, times, strict=True):
        assert np.allclose(continuous[start : start + len(one)] - shift, one, atol=1e-6)
        if start:
            assert continuous[start] - continuous[start - 1] == pytest.approx(GAP_ROWS * period)
    assert record.span_min == sum(one[-1] - one[0] for one in times)


@pytest.mark.parametrize("quote", ["", '"'], ids=["at once", "row by row"])
def test_a_csv_that_steps_back_is_read_as_runs(tmp_path: Path, quote: str) -> None:
    rows = "".join(f"{time},{quote}1{quote},2,3\n" for time in (0.1, 0.2, 0.3, 0.15, 0.25, 0.35, 0.15, 0.16, 0.17))
    path = tmp_path / "run.csv"
    path.write_text(f"time_min,qc,C,T\n{rows}")
    found = read_csv(path)
    assert found.rows == 9
    assert found.runs is not None
    assert found.runs.tolist() == [1, 1, 1, 2, 2, 2, 3, 3, 3]
    assert "3 runs, 0.1 to 0.3, 0.15 to 0.35, 0.15 to 0.17 min" in found.describe_runs()


def test_a_column_called_run_that_counts_nothing_is_one_among_others(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    for cells in ("0 1 0 1", "2 2 2 3", "1 1 3 3", "a b c d", "1 1 2 x", "1 1 1 " + 20 * "2"):
        body = "".join(f"{row},1,2,3,{cell}\n" for row, cell in enumerate(cells.split()))
        path.write_text(f"time_min,qc,C,T,run\n{body}")
        assert read_csv(path).runs is None, cells


def test_rows_in_no_order_are_refused_with_the_cure(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("time_min,qc,C,T\n" + "".join(f"{row * 7 % 10},1,2,3\n" for row in range(10)))
    with pytest.raises(InputError, match="the time steps back before 6 of 10 rows; sort the rows by time"):
        read_csv(path)
