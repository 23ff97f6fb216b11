"""A live recording describes the process of each of its plants, with its equations if they are of the catalogue."""

from dataclasses import replace
from pathlib import Path

import pytest
from mcap.records import Metadata

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.cli.diagnose import DiagnosisOptions, load_case
from reactorwatch.contract.codec import encode
from reactorwatch.description.process import Process
from reactorwatch.description.read import PlantProcesses, find_process
from reactorwatch.errors import InputError
from reactorwatch.process import MODELS
from reactorwatch.process.fault import parse_fault
from recorder.config import RecorderConfig
from recorder.core import Recorder
from recorder.files.copies import Window, cut
from recorder.files.metadata import PROCESS, process_metadata, processes_in
from recorder.files.recording import Recording
from recorder.recording_files import RecordingFiles
from recorder.tools.inspect import inspect
from recorder.tools.player import samples_of
from tests.unit.plant_node.test_plant_of_any_process import RIG

START_NS = 10**18
NAMES = [make().name for make in MODELS]


def store(process: Process) -> Process:
    return processes_in([Metadata(PROCESS, process_metadata("unit", process))])["unit"]


def write_samples(files: RecordingFiles, plant: str, process: str, rows: int) -> None:
    """Write the samples of a simulated plant as a recorder of the bus does, in a new file."""
    recorder = Recorder("site", 0)
    files.start_file((), START_NS)
    for item in samples_of(simulate_record(PlantConfig(process=process), rows), plant, START_NS):
        received = recorder.on_message(encode(item)._replace(received_ns=START_NS), START_NS)
        assert received is not None
        files.write(received)


@pytest.mark.parametrize("name", NAMES)
def test_stored_equations_of_the_catalogue_are_the_same_model(name: str) -> None:
    process = find_process(name)
    stored = store(process)
    assert stored.model is not None
    assert [effect.name for effect in stored.effects] == [effect.name for effect in process.effects]
    assert stored.signals == process.signals
    assert stored.require_model().rhs == process.require_model().rhs


def test_given_constants_and_constant_deviations_are_stored_too(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(RIG, encoding="utf-8")
    rig = find_process(path)
    stored = store(rig)
    assert stored.uncertain == rig.uncertain == {"a2": 0.01}
    assert stored.require_model().parameter("a2").value == 0.62
    assert stored.units == {**rig.units}
    leak = parse_fault("leak1:constant:0.1", rig.effects)
    leaking = replace(rig, equations=leak.extend(find_process("three_tanks").require_model()))
    assert store(leaking).require_model().parameter("leak1.size").value == 0.1


def test_equations_that_are_not_of_the_catalogue_are_left_out_and_the_signals_stay() -> None:
    tanks = find_process("cascaded_tanks")
    model = tanks.require_model()
    own = replace(tanks, equations=replace(model, rhs=(2 * model.rhs[0], model.rhs[1])))
    other = replace(tanks, equations=replace(model, name="other"))
    for process in (own, other):
        stored = store(process)
        assert (stored.model, stored.signals) == (None, tanks.signals)


def test_equations_of_a_later_version_are_left_out() -> None:
    metadata = process_metadata("unit", find_process("cstr"))
    for key, value in (("equations", '{"format": "reactorwatch.model.v9"}'), ("parameters", "[]")):
        stored = processes_in([Metadata(PROCESS, {**metadata, key: value})])["unit"]
        assert (stored.model, stored.outputs) == (None, ("C", "T"))


def test_each_file_describes_the_plants_with_samples_in_it_and_a_copy_keeps_that(tmp_path: Path) -> None:
    config = RecorderConfig(plant="site", out=str(tmp_path), processes={"*": "cstr", "north": "three_tanks"})
    with RecordingFiles(config) as files:
        for plant, process in (("north", "three_tanks"), ("south", "cstr")):
            write_samples(files, plant, process, 20)
    written = sorted(tmp_path.glob("*.mcap"))
    names = [{plant: item.name for plant, item in inspect(file).processes.items()} for file in written]
    assert sorted(names, key=str) == [{"north": "three_tanks"}, {"south": "cstr"}]
    copy = tmp_path / "cut.mcap"
    cut(written, copy, Window((0, 2**62)), {})
    assert {plant: item.name for plant, item in inspect(copy).processes.items()} == names[0] | names[1]


def test_a_live_recording_is_read_and_diagnosed_with_no_option(tmp_path: Path) -> None:
    path = tmp_path / "tanks.mcap"
    with RecordingFiles(RecorderConfig(plant="tanks", out=str(path), processes={"tanks": "three_tanks"})) as files:
        write_samples(files, "tanks", "three_tanks", 200)
    described = Recording(path).process(None)
    assert described is not None
    assert (described.name, described.inputs) == ("three_tanks", ("Q1", "Q2"))
    case = load_case(path, DiagnosisOptions())
    assert case.process.require_model().name == "three_tanks"
    assert set(case.record.columns) == {"Q1", "Q2", "h1", "h2", "h3"}


def test_without_equations_a_recording_is_not_diagnosed_and_the_line_states_the_cure(tmp_path: Path) -> None:
    path, bare = tmp_path / "bare.mcap", tmp_path / "bare.toml"
    signals = RIG[RIG.index("[[signals]]") :]
    bare.write_text(f'name = "rig"\n{signals}', encoding="utf-8")
    with RecordingFiles(RecorderConfig(plant="tanks", out=str(path), processes={"tanks": str(bare)})) as files:
        write_samples(files, "tanks", "three_tanks", 30)
    with pytest.raises(InputError, match=r"^process 'rig': must have equations for this, got none; name those of"):
        load_case(path, DiagnosisOptions())


def test_a_plant_s_own_entry_goes_before_patterns() -> None:
    processes = PlantProcesses({"north_*": "cstr", "north_2": "three_tanks"})
    names = [process and process.name for process in map(processes.find, ("north_1", "north_2", "south"))]
    assert names == ["cstr", "three_tanks", None]


def test_an_unknown_process_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^unknown process 'three_tank'; did you mean 'three_tanks'\?"):
        RecordingFiles(RecorderConfig(plant="x", out=str(tmp_path / "x.mcap"), processes={"x": "three_tank"}))
    assert not list(tmp_path.iterdir())
