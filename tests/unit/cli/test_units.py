"""A record in other units than the model's is named by every command that reads it, with one check."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from monitor_node.config import MonitorConfig
from reactorwatch.cli import backtest_jobs
from reactorwatch.cli.batch import Job
from reactorwatch.cli.main import app
from reactorwatch.diagnosis.units import find_wrong_unit
from reactorwatch.errors import InputError
from reactorwatch.process.library.cstr import cstr
from reactorwatch.records.record import Record
from reactorwatch.records.write import write_table
from tests.unit.diagnosis.runs import record_of

SOUND = record_of(rows=300)
LEARNING = MonitorConfig(training_min=1e6)
"""So that nothing is watched, which would take longer."""


def with_column(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Record:
    return replace(SOUND, columns=SOUND.columns | {name: change(SOUND.columns[name])})


SPOILED = {
    "T in degrees C": (with_column("T", lambda T: T - 273.15), "taken as degrees C"),
    "T in degrees F": (with_column("T", lambda T: 1.8 * T - 459.67), "taken as degrees F"),
    "qc in m3/h": (with_column("qc", lambda qc: 0.06 * qc), "times 16.67"),
    "qc in l/h": (with_column("qc", lambda qc: 60.0 * qc), "times 0.01667"),
    "C in mol/m3": (with_column("C", lambda C: 1000.0 * C), "times 0.001"),
    "T in degrees C, and some not measured": (
        with_column("T", lambda T: np.where(np.arange(T.size) % 3 == 0, -999.0, T - 273.15)),
        "degrees C",
    ),
}
IN_OTHER_TIMES = {
    "hours as minutes": replace(SOUND, time_min=SOUND.time_min / 60.0),
    "seconds as minutes": replace(SOUND, time_min=60.0 * SOUND.time_min),
}


def remarks_of(record: Record, folder: Path) -> dict[str, str]:
    """What each command says of the units."""
    path, found = folder / "a.csv", {}
    write_table(path, record)
    job = Job(path, path, backtest_jobs.BacktestOptions(settings=LEARNING, as_json=True))
    found["backtest"] = backtest_jobs.run_job(job).remark
    for command in (["identify"], ["simulate", "-o", str(folder / "out.csv")], ["diagnose"]):
        result = CliRunner().invoke(app, [*command, str(path)])
        found[command[0]] = str(result.exception) if isinstance(result.exception, InputError) else result.stderr
    return found


@pytest.mark.parametrize("case", SPOILED)
def test_a_signal_in_another_unit_is_named_by_every_command(case: str, tmp_path: Path) -> None:
    record, hint = SPOILED[case]
    for command, said in remarks_of(record, tmp_path).items():
        assert hint in said, (command, said)
        assert "check its unit" in said or "add 273.15" in said
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.parametrize("case", IN_OTHER_TIMES)
def test_times_in_another_unit_are_named_where_they_matter(case: str, tmp_path: Path) -> None:
    said = remarks_of(IN_OTHER_TIMES[case], tmp_path)
    for command in ("backtest", "identify", "diagnose"):
        assert "check the unit of the times" in said[command], command


def test_of_a_sound_record_nothing_is_reported(tmp_path: Path) -> None:
    assert {command: "unit" in said for command, said in remarks_of(SOUND, tmp_path).items()} == dict.fromkeys(
        ("backtest", "identify", "simulate", "diagnose"), False
    )


@settings(max_examples=12)  # each looks for steady states at many inputs
@given(st.sampled_from(["qc", "C", "T"]), st.floats(allow_nan=False, allow_infinity=False))
def test_any_number_in_a_column_is_answered(name: str, value: float) -> None:
    find_wrong_unit(cstr(), SOUND.columns | {name: np.full(9, value)}, SOUND.time_min)
