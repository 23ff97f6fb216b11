"""The first rows of a record set the hidden state that a simulation starts from, and count in no error."""

import json
from pathlib import Path

import numpy as np
import pytest

import reactorwatch as rw
from reactorwatch.process.library.cascaded_tanks import tanks
from reactorwatch.process.simulate import Simulator
from tests.running import Command

ROWS, SETTLE = 300, 50


def tank_record(level: float) -> rw.Record:
    """Cascaded tanks whose upper tank, which nobody measures, begins at a level."""
    rng = np.random.default_rng(2)
    u = np.repeat(rng.uniform(2.0, 4.0, ROWS // 20), 20)
    time_min = np.linspace(0.0, (ROWS - 1) * 4.0 / 60.0, ROWS)
    run = Simulator(tanks()).run(time_min, u[:, None], np.array([level, 4.0]))
    return rw.Record(time_min=time_min, signals={"u": u, "x2": run.outputs[:, 0]}, process="cascaded_tanks")


@pytest.mark.parametrize("level", [1.0, 5.0, 8.0])
def test_the_hidden_state_is_found_from_the_first_rows(level: float) -> None:
    record = tank_record(level)
    assert rw.simulate(record, settle=SETTLE).rmse["x2"].value < 1e-4


def test_settled_rows_are_left_out_of_the_error() -> None:
    record = tank_record(5.0)
    record.columns["x2"][:SETTLE] += 1.0
    record.columns["x2"][0] -= 1.0
    whole, later = (
        np.sqrt(np.mean((rw.simulate(record, settle=settle).columns["x2"] - record.columns["x2"])[settle:] ** 2))
        for settle in (0, SETTLE)
    )
    assert rw.simulate(record).rmse["x2"].value == pytest.approx(whole)
    assert rw.simulate(record, settle=SETTLE).rmse["x2"].value == pytest.approx(later)


def test_the_command_takes_it(tmp_path: Path, called: Command) -> None:
    record = tank_record(5.0)
    table = np.column_stack([record.time_min, record.columns["u"], record.columns["x2"]])
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", header="time_min,u,x2", comments="", fmt="%.12g")
    arguments = ("simulate", tmp_path / "run.csv", "--process", "cascaded_tanks", "-o", tmp_path / "out.csv", "--json")
    with_rows = json.loads(called(*arguments, "--settle", "50").stdout)["rmse"]["x2"]["value"]
    without = json.loads(called(*arguments, "--force").stdout)["rmse"]["x2"]["value"]
    assert with_rows < 1e-4
    assert without > 10.0 * with_rows


@pytest.mark.parametrize("settle", [-1, ROWS])
def test_as_many_rows_as_the_record_has_are_refused(settle: int) -> None:
    with pytest.raises(rw.InputError, match=f"settle must be at least 0 rows and less .* of a run, {ROWS}, got"):
        rw.simulate(tank_record(4.0), settle=settle)
