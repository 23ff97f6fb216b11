"""Records as CSV."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from reactorwatch.errors import InputError
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.read import SignalColumn, read_table
from reactorwatch.records.record import LARGEST_VALUE, LONGEST_MIN, Record
from reactorwatch.records.write import write_table
from tests.tables import read_csv

PLAIN = "time_min,qc,C,T\n0.1,100,0.1,438\n0.2,101,0.2,439\n0.5,102,0.3,440\n"


def written(folder: Path, text: str | bytes) -> Path:
    path = folder / "run.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def assert_same(record: Record, other: Record) -> None:
    assert np.array_equal(record.time_min, other.time_min)
    assert list(record.columns) == list(other.columns)
    for signal, values in record.columns.items():
        assert np.array_equal(values, other.columns[signal], equal_nan=True)


def test_the_file_may_have_other_names(tmp_path: Path) -> None:
    path = written(tmp_path, "t,flow,conc,reactor_temp\n6,100,0.1,438\n12,101,0.2,439\n")
    record = read_csv(path, {"time_s": "t", "qc": "flow", "C": "conc", "T": "reactor_temp"})
    assert record.time_min.tolist() == [0.1, 0.2]
    assert record.columns["T"].tolist() == [438.0, 439.0]


@pytest.mark.parametrize("quote", ["", '"'], ids=["at once", "row by row"])
def test_an_empty_cell_was_not_measured(tmp_path: Path, quote: str) -> None:
    record = read_csv(written(tmp_path, f"time_min,qc,C,T\n0,{quote}1{quote},,\n1,,,3\n2,,4,nan\n3,5, ,6"))
    assert np.array_equal(record.columns["qc"], [1, np.nan, np.nan, 5], equal_nan=True)
    assert np.array_equal(record.columns["C"], [np.nan, np.nan, 4, np.nan], equal_nan=True)
    assert np.array_equal(record.columns["T"], [np.nan, 3, np.nan, 6], equal_nan=True)


def test_a_signal_that_is_not_required_may_be_absent(tmp_path: Path) -> None:
    signals = [SignalColumn("qc"), SignalColumn("T", required=False)]
    record = read_table(written(tmp_path, "time_min,qc\n0,1\n"), signals)
    assert list(record.columns) == ["qc"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "expected a header and rows, got an empty file"),
        (" \n\n", "expected a header and rows, got an empty file"),
        ('""\n', "row 1: expected a column 'time_min' or 'time_s' in the header"),
        ("time_min,qc,C,T\n", "expected rows below the header, got none"),
        ("time_min,qc,C,T", "expected rows below the header, got none"),
        ("Datum;TI-301;FC-7\n", "expected rows below the header, got none"),
        ("time_min:qc:C:T\n0:1:2:3\n", "the cells must be separated, such as by commas"),
        (
            "a,qc,C,T\n0,1,2,3\n",
            "row 1: expected a column 'time_min' or 'time_s' in the header, "
            "or another that looks like a time, got 'a', 'qc'",
        ),
        ("time_min,qc,C\n0,1,2\n", "row 1: expected a column 'T' in the header, got 'time_min', 'qc', 'C'"),
        ("time_min,qc,C,T,C\n0,1,2,3,4\n", "row 1: expected each column name once, got 'C' more than once"),
        (PLAIN.replace("0.2,101", "0.2,1o1"), "row 3, column 'qc': expected a finite number or nothing, got '1o1'"),
        (PLAIN.replace("0.2,101", "0.2,inf"), "row 3, column 'qc': expected a finite number or nothing, got 'inf'"),
        (PLAIN.replace("0.2,101", "0.2,1_0"), "row 3, column 'qc': expected a finite number or nothing, got '1_0'"),
        (PLAIN.replace("0.2,", "x,"), "row 3, column 'time_min': expected a finite number, got 'x'"),
        (
            PLAIN.replace("0.2,", ","),
            "row 3, column 'time_min': expected a time after 0.1, that of the row before, got ''",
        ),
        (PLAIN.replace("0.1,100", ",100"), "row 2, column 'time_min': expected a time, got ''"),
        (
            PLAIN.replace("0.2,", "0.1,").replace("0.5,", "0.1,"),
            "row 3, column 'time_min': expected a time after 0.1, that of the row before, got",
        ),
        (
            PLAIN.replace("\n0.2,", "\n\n\n0.1,").replace("0.5,", "0.1,"),
            "row 5, column 'time_min': expected a time after",
        ),
        (PLAIN.replace(",440", ""), "row 4: expected 4 cells as in the header, got 3"),
        (PLAIN.replace("101,0.2", "101,0,2"), "row 3: expected 4 cells as in the header, got 5"),
        (PLAIN + '0.6,"1,2,3\n', "row 5: expected comma separated cells"),
        (b"time_min,qc,C,T\n0,1,2,\xb0\n", "row 2, column 'T': expected a finite number or nothing, got '\xb0'"),
        (PLAIN.encode() + b"\0\1", "expected a CSV file, got binary data"),
        (b"\x89MCAP0\r\n" + bytes(100), "expected a CSV file, got an MCAP recording"),
    ],
)
def test_an_error_in_a_file_is_reported_in_one_line(tmp_path: Path, text: str | bytes, said: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(InputError) as error:
        read_csv(path)
    assert said in str(error.value)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_a_file_that_cannot_be_opened_is_reported_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no such file"):
        read_csv(tmp_path / "none.csv")
    with pytest.raises(InputError, match="expected a CSV file, got a folder"):
        read_csv(tmp_path)


def test_a_name_that_is_asked_for_must_be_there_and_be_known(tmp_path: Path) -> None:
    path = written(tmp_path, PLAIN)
    with pytest.raises(InputError, match="expected a column 'temp' in the header"):
        read_csv(path, {"T": "temp"})
    with pytest.raises(InputError, match=r"unknown signal 'Q'.* \(valid: time_min, time_s, qc, C, T\)"):
        read_csv(path, {"Q": "qc"})


@pytest.mark.parametrize("misspelt", ["TI-310 Inlet", "ti-301 inlet", "TI 301 Inlet"])
@pytest.mark.parametrize("form", ["wide", "long", "time"])
def test_a_misspelt_column_or_tag_gets_the_closest_name(tmp_path: Path, misspelt: str, form: str) -> None:
    rows = "".join(f"{row},{row},4\n" for row in range(5))
    signals = [SignalColumn("T", column=misspelt)]
    if form == "long":
        text = "time,tag,value\n" + "".join(f"2026-03-02T08:00:0{row}Z,TI-301 Inlet,{row}\n" for row in range(5))
    else:
        text = f"time_s,TI-301 Inlet [degC],FC-7\n{rows}"
    with pytest.raises(InputError) as error:
        read_table(written(tmp_path, text), signals, FileFormat(time=misspelt) if form == "time" else FileFormat())
    assert "did you mean 'TI-301 Inlet'?" in str(error.value)


def test_the_cure_for_a_missing_column_is_quoted_for_the_shell(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--column 'my T=NAME' names another"):
        read_table(written(tmp_path, PLAIN), [SignalColumn("my T")])


def test_reading_row_by_row_gives_what_reading_at_once_gives(tmp_path: Path) -> None:
    """A quoted cell is what sends a file the slow way."""
    generator = np.random.default_rng(1)
    values = generator.normal(size=(200, 3))
    rows = [f"{number * 0.1!r},{','.join(map(repr, row))}" for number, row in enumerate(values.tolist())]
    text = "time_min,qc,C,T\n" + "\n".join(rows)
    at_once = read_csv(written(tmp_path, text))
    assert_same(read_csv(written(tmp_path, text.replace("\n0.0,", '\n"0.0",'))), at_once)
    assert np.array_equal(at_once.columns["T"], values[:, 2])


def test_writing_replaces_what_was_there_and_names_the_columns(tmp_path: Path) -> None:
    path = written(tmp_path, "old")
    write_table(
        path, Record(np.array([0.1, 0.2]), {"qc": np.array([100.0, np.nan]), "T": np.array([1e-5, 438.54])}, "x")
    )
    assert path.read_text() == "time_min,qc,T\n0.1,100.0,1e-05\n0.2,,438.54\n"


@pytest.mark.parametrize("value", [np.inf, -np.inf, 1e15, -1e308])
def test_what_could_not_be_read_again_is_not_written(tmp_path: Path, value: float) -> None:
    record = Record(np.array([0.1]), {"qc": np.array([value])}, "x")
    with pytest.raises(ValueError, match=r"column 'qc' must be below 1e\+15 or NaN"):
        write_table(tmp_path / "run.csv", record)
    with pytest.raises(ValueError, match="times must be within"):
        write_table(tmp_path / "run.csv", Record(np.array([value]), {"qc": np.array([1.0])}, "x"))
    assert not list(tmp_path.iterdir())


A_TIME = st.floats(-LONGEST_MIN, LONGEST_MIN)
A_VALUE = st.floats(-LARGEST_VALUE, LARGEST_VALUE, exclude_min=True, exclude_max=True) | st.just(np.nan)


@given(
    times=st.lists(A_TIME, min_size=1, max_size=20, unique=True).map(sorted),
    values=arrays(np.float64, (3, 20), elements=A_VALUE),
)
def test_what_is_written_reads_back_exactly(
    tmp_path_factory: pytest.TempPathFactory, times: list[float], values: np.ndarray
) -> None:
    path = tmp_path_factory.mktemp("csv") / "run.csv"
    columns = {signal: values[number, : len(times)] for number, signal in enumerate(("qc", "C", "T"))}
    record = Record(np.array(times), columns, "run.csv")
    write_table(path, record)
    assert_same(read_csv(path), record)


@given(
    unit=st.sampled_from(["time_min", "time_s"]),
    row=st.integers(0, 4),
    column=st.integers(0, 3),
    value=st.floats(min_value=LARGEST_VALUE) | st.floats(max_value=-LARGEST_VALUE),
)
def test_a_time_or_a_value_that_cannot_be_is_named_with_its_row_and_column(
    tmp_path_factory: pytest.TempPathFactory, unit: str, row: int, column: int, value: float
) -> None:
    cells = [[str(time), "100", "0.1", "440"] for time in range(5)]
    cells[row][column] = repr(value)
    path = written(
        tmp_path_factory.mktemp("csv"), "\n".join([f"{unit},qc,C,T", *(",".join(line) for line in cells)]) + "\n"
    )
    with pytest.raises(InputError) as refused:
        read_csv(path)
    named = (unit, "qc", "C", "T")[column]
    assert f"row {row + 2}, column {named!r}: expected a" in str(refused.value)


def test_seconds_of_a_clock_in_a_column_of_minutes_are_named(tmp_path: Path) -> None:
    path = written(tmp_path, "time_min,qc,C,T\n1700000000,100,0.1,440\n1700000006,100,0.1,440\n")
    with pytest.raises(InputError, match=r"row 2, column 'time_min': .* got '1700000000'; check its unit: seconds are"):
        read_csv(path)
    assert read_csv(written(tmp_path, path.read_text().replace("time_min", "time_s"))).rows == 2
