"""Workbooks: their sheets, the kinds of their cells, and those that would exhaust memory."""

import io
import sys
import zipfile
from collections.abc import Callable, Sequence
from datetime import date, datetime, time, timedelta
from pathlib import Path
from typing import Any

import openpyxl
import pytest
from typer.testing import CliRunner

import reactorwatch as rw
from reactorwatch.cli.main import app
from reactorwatch.errors import InputError
from reactorwatch.records import decode
from reactorwatch.records.decode import read_text
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.read import read_table
from reactorwatch.records.record import Record
from reactorwatch.records.write import write_table
from tests.unit.records.variants import HOLES, START, UNITS, VALUES, clock

Sheets = dict[str, Sequence[Sequence[object]]]
ROWS: list[list[object]] = [[k, 10.0 + k] for k in range(30)]
SHEETS: Sheets = {
    "Cover": [["Report of rig 7"], ["made", "by hand"], ["number", 3]],
    "empty": [],
    "Data": [["time_s", "T"], *ROWS],
    "Backup": [["time_s", "T"], *([k, -10.0 - k] for k in range(30))],
}


def write(path: Path, sheets: Sheets) -> Path:
    book = openpyxl.Workbook()
    book.remove(book.active)
    for name, rows in sheets.items():
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(row)
    book.save(path)
    return path


def test_a_workbook_reads_like_its_text(tmp_path: Path) -> None:
    values = [
        [time.replace(tzinfo=None), *(None if hole else value for value, hole in zip(row, holes, strict=True))]
        for time, row, holes in zip(clock(), VALUES.tolist(), HOLES.tolist(), strict=True)
    ]
    rows: list[list[object]] = [["Anlage 7"], ["Zeit", "qc [l/min]", "C [mol/l]", "T [K]"], *values]
    record = read_table(write(tmp_path / "book.xlsx", {"empty": [], "Daten": rows}))
    assert record.zero == f"{START:%Y-%m-%dT%H:%M:%SZ}"
    assert record.units == UNITS
    for number, name in enumerate(UNITS):
        assert record.columns[name].tolist() == pytest.approx(
            [float("nan") if hole else value for value, hole in zip(VALUES[:, number], HOLES[:, number], strict=True)],
            rel=1e-15,
            nan_ok=True,
        )
    assert record.read_as.startswith("sheet `Daten`, header in row 2, time `Zeit`")


@pytest.mark.parametrize(
    ("sheet", "last", "read_as"),
    [
        (None, 39.0, "sheet `Data` (--sheet reads `Backup`)"),
        ("Data", 39.0, "sheet `Data`"),
        ("3", 39.0, "sheet `Data`"),
        ("Backup", -39.0, "sheet `Backup`"),
        ("4", -39.0, "sheet `Backup`"),
    ],
)
def test_any_sheet_is_read_and_the_first_table_if_none_is_named(
    sheet: str | None, last: float, read_as: str, tmp_path: Path
) -> None:
    record = read_table(write(tmp_path / "book.xlsx", SHEETS), None, FileFormat(sheet=sheet))
    assert record.columns["T"][-1] == last
    assert record.read_as == read_as


def test_a_name_goes_before_a_number(tmp_path: Path) -> None:
    path = write(tmp_path / "book.xlsx", {"2": SHEETS["Data"], "1": SHEETS["Backup"]})
    assert rw.read_record(path, process=_process(tmp_path, ""), sheet="1").columns["T"][-1] == -39.0
    assert rw.read_record(path, process=_process(tmp_path, "sheet = 2")).columns["T"][-1] == 39.0


def _process(folder: Path, stated: str) -> Path:
    path = folder / "rig.toml"
    path.write_text(f'name = "rig"\nsignals = [{{name = "T", role = "output"}}]\n[file]\n{stated}\n')
    return path


@pytest.mark.parametrize("sheet", ["Dataa", "5", "0"])
def test_a_sheet_that_is_not_there_is_refused_with_those_that_are(sheet: str, tmp_path: Path) -> None:
    path = write(tmp_path / "book.xlsx", SHEETS)
    error = CliRunner().invoke(app, ["info", str(path), "--sheet", sheet]).exception  # which ends the command with 2
    assert isinstance(error, InputError)
    assert str(error).startswith(
        f"{path}: expected a sheet {sheet!r} (--sheet), got 'Cover', 'empty', 'Data', 'Backup'"
    )
    assert "\n" not in str(error)
    with pytest.raises(InputError, match="expected a sheet with rows, got an empty sheet"):
        read_table(path, None, FileFormat(sheet="empty"))


@pytest.mark.parametrize("name", ["rig.csv", "rig.csv.gz", "rig.parquet", "rig.mcap"])
@pytest.mark.parametrize("command", ["info", "backtest", "export"])
def test_a_sheet_of_a_file_that_is_no_workbook_is_refused(command: str, name: str, tmp_path: Path) -> None:
    path, table = tmp_path / name, tmp_path / ("table.csv" if name.endswith("mcap") else name)
    write_table(table, read_table(write(tmp_path / "book.xlsx", {"Data": SHEETS["Data"]})))
    if path != table:
        assert not CliRunner().invoke(app, ["import", str(table), "-o", str(path), "--output", "T"]).exit_code
    more = ["-o", str(tmp_path / "out.csv")] if command == "export" else []
    error = CliRunner().invoke(app, [command, str(path), "--sheet", "2", *more]).exception
    assert isinstance(error, InputError)
    assert str(error) == f"{path}: --sheet '2' is of a workbook (.xlsx), and this is none; leave it out"


def test_the_sheet_of_a_process_is_for_its_workbooks_alone(tmp_path: Path) -> None:
    write_table(tmp_path / "rig.csv", read_table(write(tmp_path / "book.xlsx", {"Data": SHEETS["Data"]})))
    assert rw.read_record(tmp_path / "rig.csv", process=_process(tmp_path, "sheet = 2")).columns["T"][-1] == 39.0


def test_each_kind_of_cell_is_written_as_in_a_text(tmp_path: Path) -> None:
    cells: list[tuple[object, str]] = [
        (5, "5"),
        (0.1 + 0.2, "0.3"),  # as the writer rounds it
        (1e20, "1e+20"),
        (1 / 3, repr(1 / 3)),
        (True, "True"),
        ("0012,50", "0012,50"),
        (None, ""),
        (datetime(2026, 3, 1, 8, 0, 0, 250_000), "2026-03-01T08:00:00.250000"),
        (datetime(2026, 3, 1), "2026-03-01T00:00:00"),
        (date(2026, 3, 2), "2026-03-02T00:00:00"),
        (time(8, 1, 2), "08:01:02"),
        (timedelta(hours=30, seconds=1.5), "108001.5"),
        ("#DIV/0!", ""),
    ]
    path = write(tmp_path / "book.xlsx", {"Data": [["x", "y"], *([1, value] for value, _ in cells)]})
    text, _ = read_text(path)
    assert [line.split(",", 1)[1].strip('"') for line in text.decode().splitlines()[1:]] == [text for _, text in cells]


def test_merged_cells_and_rows_above_the_table_keep_their_lines(tmp_path: Path) -> None:
    path = write(tmp_path / "book.xlsx", {"Data": [[], ["Rig 7"], [], ["time_s", "T"], *ROWS]})
    book = openpyxl.load_workbook(path)
    book["Data"].merge_cells("A2:B2")
    book["Data"]["B9"] = "broken"
    book.save(path)
    with pytest.raises(InputError, match=r"row 9, column 'T': .* got 'broken'"):
        read_table(path)


def _far_cell() -> bytes:
    book = openpyxl.Workbook()
    book.active["A1"], book.active["XFD1048576"] = 1, 2
    file = io.BytesIO()
    book.save(file)
    return file.getvalue()


def _replaced(sheet: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(_far_cell())) as old, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, sheet if name.startswith("xl/worksheets/") else old.read(name))
    return file.getvalue()


BOMBS: dict[str, Callable[[], bytes]] = {
    "a cell far from the others": _far_cell,
    "cells without references": lambda: _replaced(
        b"<worksheet><sheetData><row r='1'>%s</row><row r=\"1048576\"><c><v>1</v></c></row></sheetData></worksheet>"
        % (b"<c><v>1</v></c>" * 9_000)
    ),
    "a sheet of repeated bytes": lambda: _replaced(b"<worksheet>" + b" " * 20_000_000),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_workbook_that_memory_could_not_hold_is_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(decode, "LARGEST_TEXT", 10_000_000)
    path = tmp_path / "book.xlsx"
    path.write_bytes(BOMBS[name]())
    with pytest.raises(InputError, match=r"book\.xlsx: expected sheets that unpack to at most 0\.01 GB, got more in"):
        read_table(path)
    assert read_table(write(tmp_path / "sound.xlsx", {"Data": SHEETS["Data"]})).rows == len(ROWS)


def test_rules_and_widths_of_columns_are_no_cells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decode, "LARGEST_TEXT", 1_000_000)
    rules: Any = openpyxl.formatting.rule
    book: Any = openpyxl.Workbook()
    for row in SHEETS["Data"]:
        book.active.append(row)
    for k in range(1, 800):
        scale = rules.ColorScaleRule(start_type="min", start_color="FF0000", end_type="max", end_color="00FF00")
        book.active.conditional_formatting.add(f"B{k}", scale)
    path = tmp_path / "book.xlsx"
    book.save(path)
    assert read_table(path).rows == len(ROWS)


@pytest.mark.parametrize(
    "content",
    [b"\xd0\xcf\x11\xe0 and more", _replaced(b"")[:900], b"PK\x03\x04 and no more"],
    ids=["older or encrypted", "cut", "damaged"],
)
def test_another_or_a_damaged_workbook_is_refused_in_one_line(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "book.xlsx"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"^\S+book\.xlsx: expected a workbook \(\.xlsx\), got [^\n]+$"):
        read_table(path)


def test_a_zip_of_other_files_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "book.xlsx", "w") as file:
        file.writestr("content.xml", "<office/>")
    with pytest.raises(InputError, match=r"expected a workbook \(\.xlsx\), got another kind of file; save it as"):
        read_table(tmp_path / "book.xlsx")


def test_without_openpyxl_a_workbook_is_read_and_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "book.xlsx", SHEETS)
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    record: Record = read_table(path)
    with pytest.raises(
        InputError, match=r"new\.xlsx: a workbook is written with openpyxl: install reactorwatch\[excel\]"
    ):
        write_table(tmp_path / "new.xlsx", record)
