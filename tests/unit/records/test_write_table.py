"""Records as tables of each form: what is written reads back exactly."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.records import decode
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.read import read_table
from reactorwatch.records.record import Record, join_runs
from reactorwatch.records.write import WRITTEN_SUFFIXES, write_table
from tests.tables import read_csv
from tests.unit.records.test_csv_file import assert_same

ZERO_NS = 1_772_352_000_250_000_000


def record(zero_ns: int = 0) -> Record:
    values = np.random.default_rng(3).normal(size=(3, 50))
    values[:, 7] = np.nan
    columns = dict(zip(("qc", "C", "T"), values, strict=True))
    return Record(np.arange(50) / 10, columns, "made", zero_ns)


@pytest.mark.parametrize("suffix", WRITTEN_SUFFIXES)
@pytest.mark.parametrize("clock", [False, True])
def test_each_form_reads_back(tmp_path: Path, suffix: str, clock: bool) -> None:
    if suffix == ".xlsx":
        pytest.importorskip("openpyxl")
    path = tmp_path / f"record{suffix}"
    for written in (record(ZERO_NS), join_runs([record(ZERO_NS), record(ZERO_NS)])):
        write_table(path, written, clock=clock)
        found = read_csv(path)
        assert found.zero_ns == (ZERO_NS if clock else 0)
        if suffix == ".xlsx":  # its writer rounds to 16 digits
            for name, values in written.columns.items():
                np.testing.assert_allclose(found.columns[name], values, rtol=1e-15)
        else:
            assert_same(found, written)
        assert np.array_equal(
            found.runs if found.runs is not None else 0, written.runs if written.runs is not None else 0
        )


def test_the_clock_is_a_column_that_can_be_read_as_the_time(tmp_path: Path) -> None:
    path = tmp_path / "record.csv"
    write_table(path, record(ZERO_NS), clock=True)
    assert path.read_text().splitlines()[1].endswith(",2026-03-01T08:00:00.250Z")
    found = read_table(path, None, FileFormat(time="time"))
    assert found.zero_ns == ZERO_NS
    np.testing.assert_allclose(found.time_min, record().time_min, rtol=0, atol=1e-12)


def test_a_record_without_clock_time_has_none_to_write(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="made: has no clock time that --clock could add"):
        write_table(tmp_path / "record.csv", record(), clock=True)
    assert not list(tmp_path.iterdir())


def test_a_compressed_file_has_the_same_bytes_each_time(tmp_path: Path) -> None:
    for name in ("a.csv.gz", "b.csv.gz"):
        write_table(tmp_path / name, record())
    assert (tmp_path / "a.csv.gz").read_bytes() == (tmp_path / "b.csv.gz").read_bytes()
    write_table(tmp_path / "a.csv", record())
    assert gzip.decompress((tmp_path / "a.csv.gz").read_bytes()) == (tmp_path / "a.csv").read_bytes()


@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        ("a.csv.gz", gzip.compress(b"time_min,qc\n0,1\n" * 100, mtime=0)[:-9], "expected a complete gzip file"),
        ("a.xlsx", b"PK\x03\x04 and no more", "expected a workbook"),
        ("a.parquet", b"PAR1 and no more", "expected a Parquet file with columns of plain values"),
        ("a.txt", b"\xff\xfet", "expected UTF-16 text"),
        ("a.csv", b"# only\n# comments\n", "expected a header and rows, got only comments"),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(tmp_path: Path, name: str, content: bytes, line: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=line) as refused:
        read_table(path)
    assert str(refused.value).startswith(f"{path}: ")
    assert "\n" not in str(refused.value)


def test_a_small_file_that_expands_to_gigabytes_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decode, "LARGEST_TEXT", 1000)
    for rows, fits in ((100, True), (300, False)):
        path = tmp_path / f"{rows}.csv.gz"
        path.write_bytes(gzip.compress(b"time_min,qc\n" + b"".join(b"%d,1\n" % row for row in range(rows))))
        if fits:
            assert read_table(path).rows == rows
        else:
            with pytest.raises(InputError, match=r"300\.csv\.gz: expected at most 1e-06 GB of text, got more"):
                read_table(path)
