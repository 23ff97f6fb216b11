"""A process by name, by file or by columns is the same to every command."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import reactorwatch as rw
from monitor_node.config import MonitorConfig
from reactorwatch.api.files import open_messages
from reactorwatch.cli.main import app
from reactorwatch.cli.replay import _recorded_process
from reactorwatch.errors import InputError
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.model import fingerprint
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.record import format_utc
from recorder.files.recording import Recording
from recorder.tools.convert import export_csv, import_csv, read_record
from tests.unit.process.test_three_tanks import measure
from tests.unit.records.variants import SUMMER_ENDS, VARIANTS

DESCRIPTION = """
name = "rig"
equations = "three_tanks"
[time]
column = "sample"
unit = "s"
""" + "".join(
    f'[[signals]]\nname = "{name}"\ncolumn = "{column}"\nrole = "{role}"\nunit = "{unit}"\n'
    for name, column, role, unit in (
        ("Q1", "P101 flow", "input", "l/h"),
        ("Q2", "P102 flow", "input", "cm3/s"),
        ("h1", "L1", "output", "mm"),
        ("h2", "L2", "output", "cm"),
        ("h3", "L3", "output", "cm"),
    )
)


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """A file with other names, other units, semicolons and decimal commas, of a rig whose pipe clogs."""
    record = measure("clog13", 0.3)
    columns = dict(record.columns)
    columns["Q1"], columns["h1"] = columns["Q1"] * 3.6, columns["h1"] * 10
    cells = np.column_stack([record.time_min * 60, *columns.values()])
    lines = ["sample;P101 flow;P102 flow;L1;L2;L3"]
    lines += [";".join(f"{value:.4f}".replace(".", ",") for value in row) for row in cells]
    (tmp_path / "rig.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (tmp_path / "rig.toml").write_text(DESCRIPTION, encoding="utf-8")
    return tmp_path / "rig.csv"


def test_a_rig_with_names_and_units_of_its_own_is_diagnosed_and_simulated(rig: Path) -> None:
    process, out = str(rig.with_suffix(".toml")), rig.parent / "report"
    run = CliRunner().invoke(app, ["diagnose", str(rig), "--process", process, "-o", str(out), "--json"])
    assert run.exit_code == 0, run.output
    found = json.loads(run.stdout)
    (cause,) = found["causes"]
    assert (found["verdict"], cause["cause"]) == ("named", "clog13")
    assert cause["parameters"]["size"]["value"] == pytest.approx(0.3, rel=0.1)
    simulated = rig.parent / "simulated.csv"
    run = CliRunner().invoke(app, ["simulate", str(rig), "--process", process, "-o", str(simulated), "--json"])
    assert run.exit_code == 0, run.output
    rmse_cm = json.loads(run.stdout)["rmse"]["h1"]["value"]
    assert found["gain"]["held_out"]["h1"]["rmse_after"] < 0.2 < 1.0 < rmse_cm
    rig.with_suffix(".toml").unlink()
    watch_and_simulate(rig, out / "extended.json")


def test_a_process_without_equations_is_refused_with_the_cure(rig: Path) -> None:
    text = DESCRIPTION.replace('equations = "three_tanks"\n', "")
    rig.with_suffix(".toml").write_text(text, encoding="utf-8")
    run = CliRunner().invoke(app, ["diagnose", str(rig), "--process", str(rig.with_suffix(".toml"))])
    assert run.exit_code != 0
    assert "process 'rig': must have equations for this, got none" in str(run.exception)


CODE = """
from dataclasses import replace

import reactorwatch as rw
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.records.file_format import FileFormat


class Clog(Effect):
    \"\"\"The pipe between tanks 1 and 3 is clogged.\"\"\"

    name, label, location, unit = "pipe", "clogged pipe", "pipe13", "1"
    lower, upper, typical = 0.0, 0.99, 0.05

    def apply(self, model, size):
        opening = model.parameter("a1").symbol
        return model.substitute(opening, opening * (1 - size))


def process():
    columns = {"Q1": ("P101 flow", "l/h"), "Q2": ("P102 flow", "cm3/s"), "h1": ("L1", "mm"), "h2": ("L2", "cm"),
               "h3": ("L3", "cm")}
    signals = tuple(
        rw.Signal(name, unit, "input" if name[0] == "Q" else "output", column)
        for name, (column, unit) in columns.items()
    )
    model = replace(three_tanks(), name="code", places=())
    return rw.Process("code", signals, model, (Clog(),), file_format=FileFormat(time="sample", time_unit="s"))
"""


def watch_and_simulate(rig: Path, process: Path) -> None:
    """A rig with this process, and no other description, is sound."""
    arguments = ["simulate", str(rig), "--process", str(process), "-o", str(rig.parent / "again.csv"), "--json"]
    run = CliRunner().invoke(app, arguments)
    assert run.exit_code == 0, run.output
    assert all(item["value"] < 0.2 for item in json.loads(run.stdout)["rmse"].values())
    run = CliRunner().invoke(app, ["backtest", str(rig), "--process", str(process), "--json"])
    assert run.exit_code == 0, run.output
    assert json.loads(run.stdout)["alarms"] == []


def test_the_extended_model_of_code_is_read_without_the_code(rig: Path) -> None:
    described, out = rig.with_suffix(".py"), rig.parent / "report"
    described.write_text(CODE, encoding="utf-8")
    run = CliRunner().invoke(app, ["diagnose", str(rig), "--process", str(described), "-o", str(out)])
    assert run.exit_code == 0, run.output
    described.unlink()
    watch_and_simulate(rig, out / "extended.json")


ONE_ROW = "sample,P101 flow,P102 flow,L1,L2,L3\n0,1,1,1,1,1\n1,1,1,1,1,2\n"


@pytest.mark.parametrize(("text", "is_held"), [(CODE, False), (CODE.replace("(Clog(),)", "()"), True)])
def test_a_recording_judged_by_code_is_not_verified_by_code_that_only_it_names(
    tmp_path: Path, text: str, is_held: bool
) -> None:
    """Equations without effects of the user's own are in the recording; with such effects its code is needed."""
    (tmp_path / "rig.csv").write_text(ONE_ROW, encoding="utf-8")
    code, recording = tmp_path / "rig.py", tmp_path / "rig.mcap"
    code.write_text(text, encoding="utf-8")
    arguments = ["import", str(tmp_path / "rig.csv"), "--process", str(code), "-o", str(recording), "--plant", "rig"]
    run = CliRunner().invoke(app, arguments)
    assert run.exit_code == 0, run.output
    config = MonitorConfig(plant="rig", process=str(code))
    if is_held:
        held = _recorded_process(Recording(recording), config)
        assert held is not None
        assert fingerprint(held.require_model()) == fingerprint(replace(three_tanks(), name="code"))
    else:
        with pytest.raises(InputError, match=r"in no catalogue here.*name its file by --process"):
            _recorded_process(Recording(recording), config)


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
    assert format_utc(open_messages(local, stated=BERLIN).zero_ns or 0) == ZERO
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
