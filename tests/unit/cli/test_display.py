"""Table rows: aligned, cut to a terminal, and plain elsewhere."""

import os
import pty
import re
import subprocess
import sys

import pytest

from reactorwatch.cli.display import (
    CAUSE,
    WRONG,
    Cell,
    Row,
    Screen,
    format_rows,
    print_report,
    print_rows,
    task,
    wrap_line,
)
from reactorwatch.progress import report_stage

ROWS: list[Row] = [
    (Cell("high", WRONG), "shewhart/T", "15 % of the coolant lost"),
    ("low", "x", "a text that is long " * 5),
]


def test_without_a_terminal_a_row_is_whole_and_has_no_escape_sequences(capsys: pytest.CaptureFixture[str]) -> None:
    print_rows(ROWS)
    first, second = capsys.readouterr().out.splitlines()
    assert first == "high  shewhart/T  15 % of the coolant lost"
    assert second == "low   x           " + ("a text that is long " * 5).rstrip()


@pytest.mark.parametrize("width", [24, 40, 80])
def test_on_a_terminal_a_row_is_one_line_that_fits(width: int) -> None:
    lines = format_rows(ROWS, 2, Screen(width)).splitlines()
    assert len(lines) == len(ROWS)
    assert max(map(len, lines)) <= width
    assert lines[1].endswith("…")


def test_a_style_is_an_escape_sequence_that_leaves_the_text() -> None:
    (line,) = format_rows([(Cell("lost", CAUSE), "x")], to=Screen(None, colour=True)).splitlines()
    assert "\x1b[36m" in line
    assert re.sub(r"\x1b\[[0-9;]*m", "", line) == "lost  x"


def test_text_from_elsewhere_neither_acts_on_the_terminal_nor_is_markup() -> None:
    (line,) = format_rows([("[red]\x1b[31m\n",)], to=Screen(60, colour=True)).splitlines()
    assert line == "[red]\\u001b[31m\\u000a"


def test_wide_characters_count_twice() -> None:
    (line,) = format_rows([("漢字漢字漢字",)], to=Screen(7)).splitlines()
    assert line == "漢字漢…"


TEXT = """leak.csv: 2400 rows over 239.9 min
The simulation is wrong: coolant leak, since 149.99 ± 0.03 min. It matters in practice.
  cause       coolant leak (coolant_flow, step)
  differs     T by 7.32 K, less than 1 % of it noise; most from 149.9 to 179.9 min (12)
  suspect: 15 % of the coolant lost (94 %; coolant_flow, step at 150.0 min), unknown (6 %)
- Alarm raised: `shewhart/T` at 150.3 min, 0.3 min after the fault

family  order  delay  one step  free run     criterion
arx     1      1      99.7      91.2 percent 1234.5
a-name-without-a-blank-that-is-longer-than-the-terminal-is-wide-and-is-kept-whole"""
REPORT = TEXT.split("\n")


@pytest.mark.parametrize("width", [40, 60, 80])
def test_a_report_is_wrapped_at_words_and_values_stay_in_their_column(width: int) -> None:
    lines = [row for line in REPORT for row in wrap_line(line, width)]
    assert max(len(line) for line in lines if "a-name" not in line) <= width
    assert " ".join(" ".join(lines).split()).startswith(" ".join(" ".join(REPORT[:6]).split()))
    first = next(number for number, line in enumerate(lines) if line.startswith("  differs     T by "))
    assert lines[first + 1].startswith(" " * 14)
    first = next(number for number, line in enumerate(lines) if line.startswith("  suspect: "))
    assert lines[first + 1].startswith(" " * 11)
    assert all(line.startswith(("- ", "  ")) for line in lines[lines.index("") - 1 : lines.index("")])


def test_the_rows_of_a_table_stay_one_line_each() -> None:
    table = ["name      value        unit", "x         1            K", "y" * 30 + "   " + "z" * 30]
    lines = [row for line in table for row in wrap_line(line, 40)]
    assert lines[:2] == table[:2]
    assert len(lines) == 3
    assert len(lines[2]) == 40


def test_a_report_elsewhere_and_json_everywhere_stay_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    print_report("\n".join(REPORT))
    assert capsys.readouterr().out.split("\n")[:-1] == REPORT
    print_report('{"text": "' + "x" * 500 + '"}', as_json=True)
    assert capsys.readouterr().out == '{"text": "' + "x" * 500 + '"}\n'


def test_the_stages_of_a_task_are_shown_nowhere_but_on_a_terminal(capfd: pytest.CaptureFixture[str]) -> None:
    with task("diagnosing"):
        report_stage("fitting cause", 1, 3)
    assert capfd.readouterr() == ("", "")


SHOWN = """
import time
from reactorwatch.cli.display import task
from reactorwatch.progress import report_stage
with task("diagnosing [a].csv"):
    for stage in (("estimating the noise",), ("compiling function", 2), ("fitting cause", 1, 3)):
        report_stage(*stage)
        time.sleep(0.3)
print("done")
"""


def test_on_a_terminal_the_stages_are_one_line_of_standard_error_that_is_erased_at_the_end() -> None:
    ours, theirs = pty.openpty()
    shown = subprocess.run([sys.executable, "-c", SHOWN], stdout=subprocess.PIPE, stderr=theirs, text=True, check=True)
    os.close(theirs)
    text = b""
    while not text.endswith(b"\x1b[2K"):
        text += os.read(ours, 4096)
    os.close(ours)
    assert shown.stdout == "done\n"
    lines = text.decode()
    for stage in ("estimating the noise", "compiling function 2", "fitting cause 1 of 3"):
        assert f"diagnosing [a].csv: {stage} " in lines
    assert lines.count("\n") == 1
