"""Units are those of the process's signals or of the file's columns, and never follow from a name alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from monitor_node.config import MonitorConfig
from monitor_node.replay.backtest import Backtest, run
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.api.files import open_messages
from reactorwatch.cli import identify
from reactorwatch.cli.backtest import choose_settings
from reactorwatch.description.choice import DEFAULT_CHOICE, ProcessChoice
from reactorwatch.errors import InputError
from reactorwatch.identification.identify import ModelForm
from reactorwatch.process import MODELS
from reactorwatch.records.record import Record
from reactorwatch.runtime.model_file import write_extended_model
from reactorwatch.spc.charts.base import format_quantity
from recorder.columns import find_model, read_run, signal_title
from recorder.files.recording import Recording
from recorder.panels.signals import OVERVIEW
from recorder.tools.convert import import_csv, read_record
from recorder.tools.player import samples_of
from tests.tables import UNITS, read_csv

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
