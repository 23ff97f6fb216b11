"""Settings of a run of any process: the source of its samples, the monitor and the recording are of one process."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.cli.bus_client import observed_process
from reactorwatch.cli.demo import choose_fault
from reactorwatch.cli.plant_settings import PlayedRecord, load_source
from reactorwatch.description.choice import ProcessChoice
from reactorwatch.description.find import find_process
from reactorwatch.description.process import Process, Signal
from reactorwatch.errors import InputError
from reactorwatch.process import MODELS
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.write import write_table
from recorder.config import RecorderConfig, ReplayConfig
from recorder.tools.convert import import_csv
from tests.unit.plant_node.test_plant_of_any_process import RIG

ROWS = 90


@pytest.fixture
def tanks(tmp_path: Path) -> Path:
    path = tmp_path / "tanks.csv"
    write_table(path, simulate_record(PlantConfig(process="three_tanks"), ROWS))
    return path


def test_without_a_process_the_run_is_that_of_the_reactor_as_before() -> None:
    source = load_source({}, {}, None)
    assert (source.node, source.plant, source.process) == ("plant", "cstr", "cstr")
    assert source.monitor_flags({}) == {"plant": "cstr"}


@pytest.mark.parametrize("name", [make().name for make in MODELS])
def test_a_named_process_is_the_plant_s_and_the_monitor_s_and_names_both(name: str) -> None:
    source = load_source({}, {"process": name, "seed": 7}, None)
    assert isinstance(source.settings, PlantConfig)
    assert (source.plant, source.settings.process, source.about) == (name, name, {"seed": "7"})
    assert source.settings.wait_for == ("monitor", "recorder")
    assert source.monitor_flags({"monitor": {"process": "cstr"}}) == {"plant": name, "process": name}
    assert load_source({}, {"process": name, "name": "north"}, None).plant == "north"


def test_the_process_of_the_plant_s_settings_is_the_monitor_s_unless_its_own_settings_name_one() -> None:
    tables: dict[str, dict[str, Any]] = {"plant": {"process": "three_tanks", "name": "north"}}
    source = load_source(tables, {}, None)
    assert source.monitor_flags(tables) == {"plant": "north", "process": "three_tanks"}
    stated = {**tables, "monitor": {"outputs": ["h1"]}}
    assert source.monitor_flags(stated) == {"plant": "north"}


def test_a_plant_with_deviations_is_watched_by_the_equations_that_the_monitor_names(tmp_path: Path) -> None:
    path = tmp_path / "extended.json"
    path.write_text('{"format": "reactorwatch.model.v1", "model": "cstr", "effects": ["coolant_flow:constant:-0.02"]}')
    tables = {"plant": {"model": str(path)}}
    assert load_source(tables, {}, None).monitor_flags(tables) == {"plant": "cstr"}


def test_a_table_is_played_as_its_process_and_a_third_of_it_is_the_training(tanks: Path) -> None:
    source = load_source({}, {"process": "three_tanks", "speed": 60.0}, PlayedRecord(tanks))
    assert isinstance(source.settings, ReplayConfig)
    assert (source.node, source.plant, source.settings.rate) == ("replay", "three_tanks", 60.0)
    assert source.about == {"source": str(tanks)}
    assert source.monitor_flags({}) == {"plant": "three_tanks", "process": "three_tanks", "training_rows": ROWS // 3}
    assert "training_rows" not in source.monitor_flags({"monitor": {"training_min": 5.0}})
    assert source.has_end
    assert not load_source({"replay": {"loop": True}}, {"process": "three_tanks"}, PlayedRecord(tanks)).has_end


def test_a_recording_is_played_as_the_process_that_it_describes(tanks: Path, tmp_path: Path) -> None:
    recording = tmp_path / "tanks.mcap"
    import_csv(tanks, recording, plant="east", choice=ProcessChoice("three_tanks"))
    played = load_source({}, {}, PlayedRecord(recording))
    assert (played.plant, played.process) == ("east", "three_tanks")
    assert load_source({}, {"name": "twin"}, PlayedRecord(recording)).plant == "twin"


def test_a_recording_of_a_process_that_is_in_no_catalogue_needs_its_file(tmp_path: Path) -> None:
    rig, recording, table = tmp_path / "rig.toml", tmp_path / "rig.mcap", tmp_path / "rig.csv"
    rig.write_text(RIG, encoding="utf-8")
    write_table(table, simulate_record(PlantConfig(process=str(rig)), ROWS))
    import_csv(table, recording, choice=ProcessChoice(str(rig)))
    with pytest.raises(InputError, match=r"is of process 'rig', which is in no catalogue here, .*; name its file"):
        load_source({}, {}, PlayedRecord(recording))
    assert load_source({}, {"process": str(rig)}, PlayedRecord(recording)).plant == "rig"


@pytest.mark.parametrize(("flags", "option"), [({"seed": 3}, "--seed"), ({"faults": ["leak1:step:0.1"]}, "--fault")])
def test_a_played_record_takes_no_flags_of_a_simulation(tanks: Path, flags: dict[str, Any], option: str) -> None:
    with pytest.raises(InputError, match=rf"a record is played, not simulated; leave {option} out$"):
        load_source({}, {"process": "three_tanks", **flags}, PlayedRecord(tanks))


def test_the_form_of_a_played_table_may_be_stated(tmp_path: Path) -> None:
    path = tmp_path / "bare.csv"
    path.write_text("when;u;y\n" + "".join(f"{row};{row % 3},5;{row},25\n" for row in range(ROWS)), encoding="utf-8")
    rig = tmp_path / "rig.py"
    rig.write_text(
        "from reactorwatch.description.process import Process, Signal\n"
        "def process():\n    return Process('own', (Signal('u', 'V', 'input'), Signal('y', 'V')))\n",
        encoding="utf-8",
    )
    stated = FileFormat(time="when", time_unit="s", decimal=",")
    source = load_source({}, {"process": str(rig)}, PlayedRecord(path, stated))
    assert source.rows == ROWS
    assert isinstance(source.settings, ReplayConfig)
    assert source.settings.table == stated


@pytest.mark.parametrize("name", [make().name for make in MODELS])
def test_a_demonstration_has_a_fault_of_its_process_that_moves_its_outputs(name: str) -> None:
    process = find_process(name)
    fault = str(choose_fault(None, process))
    assert fault.endswith("@150min")
    early = fault.replace("@150min", "@1min")
    faulty, sound = (simulate_record(PlantConfig(process=name, seed=1, faults=item), 150) for item in ((early,), ()))
    noise = process.operation.noise_sd
    moved = [np.abs(faulty.columns[item] - sound.columns[item]).max() / noise[item] for item in process.outputs]
    assert max(moved) > 10.0


def test_a_demonstration_of_a_process_without_faults_of_its_own_takes_one_made_from_its_equations() -> None:
    tanks = find_process("cascaded_tanks")
    own = Process("own", tanks.signals, tanks.equations)
    assert str(choose_fault(None, own)).startswith("x2.bias:step:")
    bare = Process("bare", (Signal("u", "V", "input"), Signal("y", "V")))
    with pytest.raises(InputError, match=r"^process 'bare': must have equations for this, got none; name those of"):
        choose_fault(None, bare)


def test_an_observer_takes_the_process_from_the_settings_of_the_recorder_unless_one_is_named() -> None:
    recorder = RecorderConfig(plant="north_1", processes={"north_*": "three_tanks"})
    for named, expected in ((None, "three_tanks"), ("cstr", "cstr")):
        found = observed_process(named, recorder)
        assert found is not None
        assert found.name == expected
    assert observed_process(None, RecorderConfig(plant="south")) is None
