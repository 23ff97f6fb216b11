"""Wrong units are named, and units of signals reach the output."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from monitor_node.config import MonitorConfig
from monitor_node.replay.backtest import run
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.api.files import open_messages
from reactorwatch.cli import backtest, identify
from reactorwatch.cli.backtest import choose_settings
from reactorwatch.cli.batch import Job
from reactorwatch.cli.diagnose import write_extended_model
from reactorwatch.cli.main import app
from reactorwatch.description.read import DEFAULT_CHOICE, ProcessChoice
from reactorwatch.diagnosis.record_checks import find_wrong_unit
from reactorwatch.errors import InputError
from reactorwatch.identification.identify import ModelForm
from reactorwatch.process import MODELS
from reactorwatch.process.library.cstr import cstr
from reactorwatch.records.record import Record
from reactorwatch.records.write import write_table
from reactorwatch.results.backtest import Backtest
from reactorwatch.spc.charts.base import format_quantity
from recorder.columns import read_run
from recorder.files.recording import Recording
from recorder.panels.signals import OVERVIEW, find_model, signal_title
from recorder.tools.convert import import_csv, read_record
from recorder.tools.player import samples_of
from tests.tables import UNITS, read_csv
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
    job = Job(path, path, backtest.BacktestOptions(settings=LEARNING, as_json=True))
    found["backtest"] = backtest.run_job(job).remark
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


HEADER = "ts,flow,TI-1 [degC],TI-2"
COLUMNS = {"time_min": "ts", "qc": "flow", "C": "TI-1 [degC]", "T": "TI-2"}


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two temperatures in degC of some rig, which are no C and T of a reactor; one is stuck, spikes and steps."""
    measured = simulate_record(PlantConfig(seed=3, faults=("temperature_bias:step:20@50min",)), 700)
    temperature = measured.columns["T"] - 273.15
    temperature[400] += 50.0
    temperature[650:] = temperature[650]
    path = tmp_path_factory.mktemp("rig") / "rig.csv"
    columns = [measured.time_min, measured.columns["qc"], temperature, temperature[::-1]]
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=HEADER, comments="", fmt="%.10g")
    return path


def watched(path: Path, **options: object) -> Backtest:
    config = MonitorConfig(training_min=20.0, isolation=False, **options)  # type: ignore[arg-type]
    return run(open_messages(path, "cstr", COLUMNS, for_equations=True).messages, config)


@pytest.mark.parametrize("reference", ["auto", "arx"])
def test_alarms_on_renamed_columns_have_the_columns_units(rig: Path, reference: str) -> None:
    alarms = watched(rig, reference=reference).alarm_messages
    assert {alarm.alarm.split("/")[1] for alarm in alarms} >= {"C", "T"}
    for alarm in alarms:
        assert not any(word in alarm.text.split() for word in ("mol/l", "K", "mol/l)", "K)")), alarm.text
        assert "  " not in alarm.text
        if alarm.alarm in ("shewhart/C", "ewma/C"):
            assert " degC " in alarm.text or alarm.event == "cleared"


def test_where_the_process_is_named_columns_have_the_units_of_its_signals(rig: Path, tmp_path: Path) -> None:
    write_extended_model(tmp_path / "m.json", {"format": "reactorwatch.model.v1", "model": "cstr", "effects": []})
    columns = {"time_min": "ts", "qc": "flow", "C": "TI-2", "T": "TI-1 [degC]"}
    by_settings = choose_settings(MonitorConfig(reference="equations"), DEFAULT_CHOICE)
    assert choose_settings(MonitorConfig(), DEFAULT_CHOICE).is_default
    for choice in (by_settings, ProcessChoice(str(tmp_path / "m.json"))):
        source = open_messages(rig, "cstr", columns, choice=choice, for_equations=True)
        assert source.measured is not None
        assert source.measured.units == UNITS
        assert source.measured.columns["T"].min() > 400.0  # kelvin
        assert read_run(source.messages).units == UNITS
        with pytest.raises(InputError, match="degC"):
            open_messages(rig, "cstr", COLUMNS, choice=choice, for_equations=True)


@pytest.mark.parametrize("build", MODELS)
def test_the_signals_of_any_process_are_published_with_its_units(build: object) -> None:
    assert callable(build)
    units = build().units
    record = Record(np.arange(3.0), {name: np.arange(3.0) for name in units}, "x", units=units)
    said = {item.key.rsplit("/", 1)[1]: item.message.unit for item in samples_of(record, "p")}  # type: ignore[union-attr]
    assert said == units


def test_units_go_into_recordings_and_drawings_and_back(rig: Path, tmp_path: Path) -> None:
    import_csv(rig, tmp_path / "rig.mcap", "rig", COLUMNS)
    assert read_record(tmp_path / "rig.mcap").units == {"C": "degC"}
    drawn = read_run(Recording(tmp_path / "rig.mcap").messages())
    assert drawn.units == {"C": "degC"}
    assert {(view.title, view.unit) for view in OVERVIEW.draw(drawn)[:3]} == {("C", "degC"), ("T", ""), ("qc", "")}  # type: ignore[union-attr]
    assert find_model(drawn.units) is None
    assert find_model(UNITS) is not None
    assert signal_title("T", "K") != "T" == signal_title("T", "degC")


def test_identification_uses_the_known_unit(rig: Path) -> None:
    measured = read_csv(rig, COLUMNS)
    form = ModelForm(order=2)
    text = identify.fit(measured, ("qc",), ("C", "T"), form, as_json=False)
    assert "C (degC) from" in text
    assert "T (unit not known) from" in text
    own = replace(measured, units=UNITS)
    assert "T (K) from" in identify.fit(own, ("qc",), ("T",), form, as_json=False)


@given(
    signal=st.sampled_from(["qc", "C", "T"]),
    name=st.from_regex(r"[A-Za-z][A-Za-z0-9_.-]{2,8}", fullmatch=True),
    unit=st.sampled_from(["", "degC", "l/min", "%", "m3/h", "K"]),
    brackets=st.sampled_from(["[]", "()"]),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
def test_a_renamed_column_has_the_unit_in_its_brackets_or_none(
    tmp_path: Path, signal: str, name: str, unit: str, brackets: str
) -> None:
    column = f"{name} {brackets[0]}{unit}{brackets[1]}" if unit else name
    header = {"qc": "qc", "C": "C", "T": "T", signal: column}
    (tmp_path / "run.csv").write_text(f"time_min,{','.join(header.values())}\n0,1,2,3\n")
    expected = {key: value for key, value in {**UNITS, signal: unit}.items() if value}
    assert read_csv(tmp_path / "run.csv", {signal: column}).units == expected


def test_a_number_without_a_unit_stands_alone() -> None:
    assert (format_quantity(1.5, ""), format_quantity(1.5, "1"), format_quantity(1.5, "degC")) == (
        "1.5",
        "1.5",
        "1.5 degC",
    )
