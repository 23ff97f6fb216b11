"""Options about a file's form reach the reader from each command, and clock time reaches the outputs."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import reactorwatch as rw
from reactorwatch.api.files import open_messages
from reactorwatch.cli.main import app
from reactorwatch.records.file_format import FileFormat
from recorder.tools.convert import export_csv, import_csv, read_record
from tests.unit.records.variants import SUMMER_ENDS, VARIANTS

LOCAL = VARIANTS["local time when summer time ends"]
ZERO = SUMMER_ENDS.strftime("%Y-%m-%dT%H:%M:%SZ")
BERLIN = FileFormat(zone="Europe/Berlin")
COMMANDS = [
    ["simulate", "-o", "simulated.csv"],
    ["backtest", "--training", "60"],
    ["diagnose"],
    ["identify"],
    ["import", "-o", "record.mcap"],
    ["dashboard", "-o", "record.rrd"],
    ["replay"],
    ["info"],
]


@pytest.fixture
def local(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "local.csv"
    path.write_bytes(LOCAL.content)
    return path


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command[0])
def test_each_command_that_reads_a_record_takes_the_options_about_its_form(local: Path, command: list[str]) -> None:
    refused = CliRunner().invoke(app, [*command, str(local), "--time", "clock"], standalone_mode=False)
    assert "expected a column 'clock' (--time)" in f"{refused.exception} {refused.output} {refused.stderr}"


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command[0])
def test_each_command_that_reads_a_record_takes_the_order_of_day_and_month(local: Path, command: list[str]) -> None:
    arguments = [*command, str(local), "--dates", "us"]
    refused = CliRunner().invoke(app, arguments, standalone_mode=False)
    assert "unknown --dates 'us' (valid: day-first, month-first)" in str(refused.exception)


def test_a_wrong_option_is_refused_before_the_file_is_read(local: Path) -> None:
    refused = CliRunner().invoke(app, ["identify", str(local), "--zone", "Bonn"], standalone_mode=False)
    assert "--zone must be a time zone such as Europe/Berlin or +01:00, got 'Bonn'" in str(refused.exception)


def test_clock_time_goes_into_recordings_messages_and_exports(local: Path, tmp_path: Path) -> None:
    import_csv(local, tmp_path / "a.mcap", "cstr", stated=BERLIN)
    recorded = read_record(tmp_path / "a.mcap")
    assert recorded.zero == ZERO
    assert (np.diff(recorded.time_min) == 1.0).all()
    assert open_messages(local, stated=BERLIN).zero(0) == ZERO
    export_csv(tmp_path / "a.mcap", tmp_path / "a.csv", clock=True)
    header, first, *_ = (tmp_path / "a.csv").read_text().splitlines()
    assert header == "time_min,qc,C,T,time"
    assert first.startswith("0.0,")
    assert first.endswith(f",{ZERO}")


def test_files_in_a_row_are_imported_as_one_recording(local: Path, tmp_path: Path) -> None:
    header, *rows = LOCAL.content.decode().splitlines()
    parts = [tmp_path / "first.csv", tmp_path / "second.csv"]
    for part, lines in zip(parts, (rows[:90], rows[90:]), strict=True):
        part.write_text("\n".join([header, *lines]) + "\n")
    result = CliRunner().invoke(
        app, ["import", *map(str, parts), "-o", str(tmp_path / "both.mcap"), "--zone", "Europe/Berlin"]
    )
    assert result.exit_code == 0
    assert "note: read as: time `Zeit` yyyy-mm-dd hh:mm:ss in Europe/Berlin" in result.stdout
    import_csv(local, tmp_path / "whole.mcap", "cstr", stated=BERLIN)
    both, whole = (read_record(tmp_path / f"{name}.mcap") for name in ("both", "whole"))
    assert both.zero == whole.zero
    assert both.runs is None
    assert np.array_equal(both.time_min, whole.time_min)
    assert np.array_equal(both.columns["T"], whole.columns["T"])


def test_guesses_are_shown_apart_from_json(tmp_path: Path) -> None:
    path = tmp_path / "record.csv"
    path.write_bytes(VARIANTS["decimal comma and semicolons"].content)
    result = CliRunner().invoke(app, ["backtest", str(path), "--training", "60", "--json"])
    assert json.loads(result.stdout)["samples"] == 240
    assert "read as: ; separated, decimal comma" in result.stderr


def test_from_python_the_form_is_stated_by_the_same_names(local: Path, tmp_path: Path) -> None:
    record = rw.read_record(local, zone="Europe/Berlin")
    assert record.zero == ZERO
    missing = tmp_path / "missing.csv"
    missing.write_bytes(VARIANTS["a sentinel"].content)
    assert np.isnan(rw.read_record(missing, missing=-999).columns["T"]).sum() > 0
    with pytest.raises(rw.InputError, match="unknown argument 'zones'; did you mean 'zone'"):
        rw.read_record(local, zones="Europe/Berlin")


def test_info_shows_how_any_table_is_read_and_what_is_in_it(tmp_path: Path) -> None:
    path = tmp_path / "rig.txt"
    rows = [f"{10 * row};{row / 2:.1f};{'' if row == 3 else row}" for row in range(30) if row not in (10, 11)]
    path.write_text("t;flow [m3/h];level\n" + "\n".join(rows).replace(".", ",") + "\n")
    shown = CliRunner().invoke(app, ["info", str(path)]).stdout
    assert f"{path}: 28 rows, 0 to 4.83333 min, one each 10 s" in shown
    assert "read as: ; separated, decimal comma, time `t` in s" in shown
    assert "  flow   0 to 14.5 m3/h\n  level  0 to 29 (unit not known), 1 missing\n" in shown
    assert "gap from 1.5 to 2 min" in shown
    found = json.loads(CliRunner().invoke(app, ["info", str(path), "--json", "--period", "1 s"]).stdout)
    assert (found["rows"], found["period_s"], found["gaps"], found["zero"]) == (28, pytest.approx(1.0), [], None)
    assert found["signals"]["flow"] == {"unit": "m3/h", "missing": 0, "lowest": 0.0, "highest": 14.5}


def test_a_note_on_a_simulation_is_a_line_of_its_own(local: Path) -> None:
    result = CliRunner().invoke(app, ["simulate", str(local), "--zone", "Europe/Berlin", "-o", "simulated.csv"])
    first, second = result.stdout.splitlines()
    assert first.startswith("wrote simulated.csv: 240 rows")
    assert second == "note: read as: time `Zeit` yyyy-mm-dd hh:mm:ss in Europe/Berlin"
