"""`diagnose` and `simulate` take any process that has equations: by name, TOML or extended model."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from monitor_node.config import MonitorConfig
from reactorwatch.cli.main import app
from reactorwatch.cli.verification import _recorded_process
from reactorwatch.errors import InputError
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.model import fingerprint
from recorder.files.recording import Recording
from tests.unit.process.test_three_tanks import measure

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
