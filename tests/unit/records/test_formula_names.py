"""Names of others are written as text: no spreadsheet calculates them, and they are read back as they were."""

import csv
import re
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import openpyxl
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from rich.text import Text

from reactorwatch.cli.backtest import RowsOfFile, write_rows
from reactorwatch.cli.batch import write_summary
from reactorwatch.cli.display import Screen, _escape_markup, format_rows, wrap_line
from reactorwatch.cli.recordings import _report_text
from reactorwatch.diagnosis.report import mathml
from reactorwatch.errors import InputError
from reactorwatch.figures import Line, Panel, panel_svg
from reactorwatch.records.decode import quote_formula, unquote_formula
from reactorwatch.records.read import read_table
from reactorwatch.records.record import Record
from reactorwatch.records.table import bare_name
from reactorwatch.records.write import write_table
from reactorwatch.terminal import printable

FORMULAS = [
    *("=cmd|' /C calc'!A0", "=1+2", "+1+2", "-2+3", "@SUM(A1)", '=HYPERLINK("http://x","y")', "'=1+2", "''=1", "'+x"),
    *("a;=cmd|' /C calc'!A0", "\uff1d1+2", "\uff201", "a;'=1", "=", "-", "'@", "=a [K]"),
]
TRIGGERS = ("=", "+", "-", "@", "\t", "\r", "\uff1d", "\uff0b", "\uff0d", "\uff20")

names = st.text(st.sampled_from("=+-@'\"; ,|aT1\uff1d"), min_size=1, max_size=8).map(
    lambda name: " ".join(name.split())
)
names = names.filter(lambda name: name and not name.isdecimal())


def record_of(name: str) -> Record:
    return Record(np.arange(4.0), {name: np.array([1.5, 2.5, 4.0, 3.5]), "other": np.array([1.0, 2.0, 3.0, 5.0])}, "x")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(names)
@example("=1+2")
@example("a;=1")
def test_a_name_in_a_text_table_starts_no_formula_and_is_read_as_it_was(tmp_path: Path, name: str) -> None:
    path = tmp_path / "record.csv"
    write_table(path, record_of(name))
    with path.open(encoding="utf-8", newline="") as file:
        header = next(csv.reader(file))
    assert not header[1].startswith(TRIGGERS)
    assert not any(part.startswith(TRIGGERS) for part in header[1].split(";"))
    assert unquote_formula(quote_formula(name)) == name
    assert header[1] == quote_formula(name)


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".xlsx", ".parquet"])
@pytest.mark.parametrize("name", FORMULAS)
def test_a_name_like_a_formula_is_read_as_it_was_from_every_format(name: str, suffix: str, tmp_path: Path) -> None:
    record = record_of(name)
    write_table(tmp_path / f"record{suffix}", record)
    read = read_table(tmp_path / f"record{suffix}")
    assert list(read.columns) == [bare_name(name), "other"]  # a unit in brackets is none of the name
    np.testing.assert_array_equal(next(iter(read.columns.values())), record.columns[name])


@pytest.mark.parametrize("name", FORMULAS)
def test_a_name_in_a_workbook_is_a_text_cell(name: str, tmp_path: Path) -> None:
    write_table(tmp_path / "record.xlsx", record_of(name))
    sheet = openpyxl.load_workbook(tmp_path / "record.xlsx").active
    cell = sheet.cell(1, 2)
    assert (cell.value, cell.data_type) == (name, "s")
    assert cell.quotePrefix or not name.startswith(TRIGGERS)  # else editing the cell would make it one


def test_a_name_with_control_characters_is_refused_by_a_workbook_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a workbook cannot hold the control characters.*write \.csv or \.parquet"):
        write_table(tmp_path / "record.xlsx", record_of("a\x1b[31m"))
    assert not (tmp_path / "record.xlsx").exists()


def test_an_export_reports_once_that_a_quote_was_written() -> None:
    record = Record(np.arange(2.0), {"=a": np.zeros(2), "-b": np.zeros(2)}, "x")
    assert _report_text(Path("x.csv"), record).count("formula") == 1
    assert "formula" not in _report_text(Path("x.xlsx"), record)
    assert "formula" not in _report_text(Path("x.csv"), record_of("T"))


@pytest.mark.parametrize("name", FORMULAS)
def test_a_file_s_name_in_a_table_of_results_is_no_formula(name: str, tmp_path: Path) -> None:
    write_summary(tmp_path / "out", [{"file": name, "watched": True, "alarms": -1, "error": name}])
    row = SimpleNamespace(time_ns=0, in_alarm=False, raised=False)
    write_rows(tmp_path / "rows.csv", [RowsOfFile(Path(name), [row], 0)])  # type: ignore[list-item]
    for table in (tmp_path / "out" / "summary.csv", tmp_path / "rows.csv"):
        with table.open(encoding="utf-8", newline="") as file:
            (found,) = csv.DictReader(file)
        assert unquote_formula(found["file"]) in (name, str(Path(name)))
        assert not found["file"].startswith(TRIGGERS)


class Tags(HTMLParser):
    """Collects the tags and the text of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.tags.append(tag)

    def handle_data(self, data: str) -> None:
        self.text += data


HTML = ["<script>alert(1)</script>", "<img src=x onerror=alert(1)>", "a&lt;b", '"><b>', "T<b", "<", "a_<b>"]


@pytest.mark.parametrize("name", HTML)
def test_a_name_in_a_page_is_text(name: str) -> None:
    times = np.arange(3.0)
    for page in (mathml.name(name), panel_svg(Panel(name, (Line(name, times, times),), x_title=name))):
        found = Tags()
        found.feed(page)
        assert set(found.tags) <= {"mi", "mn", "msub", "path", "svg", "text"}, page


@pytest.mark.parametrize(
    "name",
    [
        "[red]x[/red]",
        "[/]",
        "[link=http://x]a[/link]",
        "\x1b[31mx",
        "\x1b]8;;http://x\x07a",
        "\u202ex",
        "a\nb",
        "\\[b]",
    ],
)
def test_a_name_on_a_terminal_is_shown_and_not_acted_on(name: str) -> None:
    shown = printable(name)
    assert Text.from_markup(_escape_markup(name)).plain == shown
    for colour in (False, True):
        rows = format_rows([[name, "2"], ["T", name]], to=Screen(80, colour))
        report = "\n".join(wrap_line(printable(f"  {name}   2"), 80))
        for text in (rows, report):
            plain = re.sub(r"\x1b\[[\d;]*m", "", text)
            assert shown in plain
            assert plain.replace("\n", "").isprintable()
