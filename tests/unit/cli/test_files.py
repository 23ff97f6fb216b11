"""Folders, several runs in a file, and endings of outputs."""

import json
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from monitor_node.config import MonitorConfig
from monitor_node.replay.backtest import run as watch
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from plant_node.scenario import HeldRecord
from reactorwatch.api.simulation import report, simulate_along
from reactorwatch.cli import identify
from reactorwatch.cli.batch import as_table, expand_files
from reactorwatch.cli.main import app, main
from reactorwatch.contract.codec import encode
from reactorwatch.errors import InputError
from reactorwatch.identification.identify import ModelForm
from reactorwatch.process.library.cstr import cstr
from reactorwatch.records.record import Record, join_runs
from reactorwatch.records.write import check_folder_name
from reactorwatch.sentences.backtest import backtest_text
from reactorwatch.sentences.models import simulation_text
from recorder.files.recording import FILE_INDEX
from recorder.files.writer import RecordingWriter
from recorder.tools.convert import import_csv
from recorder.tools.player import samples_of


def recording(path: Path, **metadata: str) -> Path:
    with RecordingWriter(path, metadata):
        return path


def test_what_a_recorder_has_written_into_a_folder_is_one_recording(tmp_path: Path) -> None:
    recording(tmp_path / "run-1.mcap", **{FILE_INDEX: "1"})
    recording(tmp_path / "cut.mcap", cut="from 3min to the end of run-2.mcap")
    (tmp_path / "a.csv").touch()
    assert expand_files([tmp_path]) == [tmp_path, tmp_path / "a.csv"]


def test_recordings_of_another_origin_are_one_each_in_the_order_of_their_names(tmp_path: Path) -> None:
    files = [recording(tmp_path / f"{name}.mcap", source="a record") for name in "ca"]
    files.append(tmp_path / "b.csv")
    files[-1].touch()
    assert expand_files([tmp_path]) == sorted(files)


def test_a_damaged_recording_does_not_change_what_its_folder_stands_for(tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(b"this is no recording")
    assert expand_files([tmp_path]) == [damaged]
    recording(tmp_path / "whole.mcap", **{FILE_INDEX: "1"})
    assert expand_files([tmp_path]) == [tmp_path]


def test_a_pattern_is_the_files_that_are_like_it_in_order_of_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names = ["b.csv", "a.csv", "in/c.csv", "[x].csv"]
    Path("in").mkdir()
    for name in names:
        Path(name).touch()
    assert expand_files([Path("?.csv"), Path("z.csv")]) == [Path("a.csv"), Path("b.csv"), Path("z.csv")]
    assert expand_files([Path("**/*.csv")]) == [Path("[x].csv"), Path("a.csv"), Path("b.csv"), Path("in/c.csv")]
    assert expand_files([Path("[x].csv")]) == [Path("[x].csv")]  # a file of that name comes before what is like it
    assert expand_files([tmp_path / "*.csv"])[0] == tmp_path / "[x].csv"


def test_a_pattern_without_a_match_is_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"run-\*.csv: no file is called like this"):
        expand_files([tmp_path / "run-*.csv"])


def test_a_table_has_columns_as_wide_as_what_is_in_them_and_none_that_are_empty() -> None:
    rows = [{"file": "a", "why": "", "count": "10"}, {"file": "longer", "why": "", "count": ""}]
    assert as_table(rows) == "file    count\na       10\nlonger"


ROWS, FIRST = 1600, 1100


@pytest.fixture(scope="module")
def whole() -> Record:
    return simulate_record(PlantConfig(seed=3, faults=("coolant_flow:step:-0.1@130min",)), ROWS)


def cut(record: Record, back_min: float) -> Record:
    times = record.time_min - np.where(np.arange(ROWS) < FIRST, 0.0, back_min)
    return replace(record, time_min=times, runs=1 + (np.arange(ROWS) >= FIRST))


def test_each_run_is_simulated_from_its_own_first_row(whole: Record, tmp_path: Path) -> None:
    record = cut(whole, 60.05)
    simulated = simulate_along(record, cstr(), ["coolant_flow:step:-0.05@75min"])
    alone = [simulate_along(run, cstr(), ["coolant_flow:step:-0.05@75min"]) for run in record.split_runs()]
    assert np.array_equal(simulated.columns["T"], join_runs(alone).columns["T"])
    assert np.array_equal(simulated.time_min, record.time_min)
    assert simulated.runs is not None
    compared = report(record, simulated, cstr(), tmp_path)
    assert compared.to_dict()["runs"] == 2
    assert "2 runs" in simulation_text(compared)


def test_a_run_of_one_row_is_simulated_as_that_row(whole: Record) -> None:
    runs = 1 + (np.arange(ROWS) >= 500) + (np.arange(ROWS) >= 501)
    simulated = simulate_along(replace(whole, runs=runs), cstr(), [])
    assert simulated.rows == ROWS
    assert simulated.columns["T"][500] == whole.columns["T"][500]
    whole_run = simulate_along(whole, cstr(), [])
    assert np.array_equal(simulated.columns["T"][:500], whole_run.columns["T"][:500])


@pytest.mark.parametrize("model", ["arx", "oe", "armax"])
@pytest.mark.parametrize("row", [400])
def test_no_row_is_identified_from_rows_of_another_run(whole: Record, model: str, row: int) -> None:
    """However far the clock is set back, the model is the one of the same rows after a gap."""

    def identified(back_min: float) -> object:
        runs = 1 + (np.arange(ROWS) >= row)
        record = replace(whole, time_min=whole.time_min - back_min * (runs - 1), runs=runs)
        form = ModelForm(model, order=2)
        return json.loads(identify.fit(record, ("qc",), ("T",), form, as_json=True))

    after_a_gap = identified(-50.0)
    assert identified(60.0) == after_a_gap
    assert identified(0.05) == after_a_gap


@pytest.mark.parametrize("back_min", [0.25, 60.0, 60.05])
def test_a_back_test_raises_the_same_alarms_after_the_clock_was_set_back(whole: Record, back_min: float) -> None:
    settings = MonitorConfig(isolation=False, diagnose_training=False)
    straight, back = (
        watch((encode(item) for item in samples_of(record, "cstr")), settings)
        for record in (whole, cut(whole, back_min))
    )
    raised = [
        (alarm.alarm, round(alarm.raised_ns / 60e9 - minutes, 3))
        for result, minutes in ((straight, 0.0), (back, -back_min))
        for alarm, _ in result.raised_alarms
    ]
    assert raised[: len(raised) // 2] == raised[len(raised) // 2 :]
    assert len(raised) >= 4
    assert (back.samples, back.runs, back.zero) == (ROWS, 2, None)
    assert back.span_min == pytest.approx(159.8)
    assert "2 runs" in backtest_text(back)


def test_several_runs_drive_no_plant(whole: Record) -> None:
    with pytest.raises(InputError, match=r"must be one run to drive the plant, .* 2 runs"):
        HeldRecord.of(cut(whole, 60.0), cstr().inputs[0])


NO_ROUTER = "--endpoint tcp/127.0.0.1:1"
TABLES = (".csv", ".gz", ".xlsx", ".parquet")
FILES = {
    "dashboard run.csv": (".rrd",),
    "import run.csv": (".mcap",),
    "example leak": TABLES,
    "export run.mcap": TABLES,
    "simulate run.csv": TABLES,
    "recover run.mcap": (".mcap",),
    "cut run.mcap": (".mcap",),
}
"""Commands that write a file, and its endings."""

FOLDERS = ["diagnose run.csv", "backtest run.csv run.mcap", "demo", "up", f"record {NO_ROUTER}"]
"""Commands that write a folder; `record` a file, too."""

ENDINGS = [".parquet", ".csv", ".mcap", ".rrd", ".json", ".html", ".xlsx", ".part", ".7z", ""]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    rows = "".join(f"{row},100,0.1,438\n" for row in range(5))
    (tmp_path / "run.csv").write_text(f"time_min,qc,C,T\n{rows}")
    import_csv(tmp_path / "run.csv", tmp_path / "run.mcap", "cstr")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(typed: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that is said of a command that is refused."""
    monkeypatch.setattr(sys, "argv", ["reactorwatch", *shlex.split(typed)])
    with pytest.raises(SystemExit) as ended:
        main()
    shown = capsys.readouterr()
    assert (ended.value.code, shown.out) == (2, "")
    assert shown.err.count("\n") == 1
    return shown.err


def test_every_command_with_the_option_is_here() -> None:
    commands = typer.main.get_command(app)
    assert hasattr(commands, "commands")
    with_out = {
        name for name, command in commands.commands.items() if any("--out" in item.opts for item in command.params)
    }
    assert with_out == {typed.split()[0] for typed in (*FILES, *FOLDERS)}


@pytest.mark.parametrize("typed", FILES)
def test_a_file_of_another_kind_is_not_written(
    folder: Path, typed: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(folder.iterdir())
    for ending in ENDINGS:
        if ending not in FILES[typed]:
            said = refused(f"{typed} -o out{ending}", monkeypatch, capsys)
            assert f"out{ending}: the name must end in {' or '.join(FILES[typed])}, got {ending or 'no ending'}" in said
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize("typed", FOLDERS)
def test_a_folder_does_not_get_the_name_of_a_file(
    folder: Path, typed: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(folder.iterdir())
    for ending in (".parquet", ".html", ".csv"):
        said = refused(f"{typed} -o out{ending}", monkeypatch, capsys)
        assert f"--out out{ending}: no {ending} file is written, the name of a folder was expected; name it out" in said
    assert sorted(folder.iterdir()) == before


@given(st.from_regex(r"[a-z]{1,8}(\.[0-9]{1,4}|-v[0-9]\.[0-9]|)", fullmatch=True))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
def test_a_folder_may_have_a_dot_in_its_name(tmp_path: Path, name: str) -> None:
    check_folder_name(tmp_path / name, "--out")
    made = tmp_path / "made.d"
    made.mkdir(exist_ok=True)
    check_folder_name(made, "--out")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is a file, the name of a folder was expected"):
        check_folder_name(tmp_path / "file", "--out")
