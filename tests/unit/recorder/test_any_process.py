"""Recordings of any process keep its signals, values, units and roles; a live one describes each of its plants."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.records import Metadata
from numpy.typing import NDArray

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.cli.diagnose import DiagnosisOptions, load_case
from reactorwatch.cli.info import info_object, info_text
from reactorwatch.contract.codec import encode
from reactorwatch.description.process import ROLES, Process, Signal
from reactorwatch.description.read import PlantProcesses, ProcessChoice, find_process, read_process_table
from reactorwatch.errors import InputError
from reactorwatch.process import MODELS
from reactorwatch.process.fault import parse_fault
from reactorwatch.records.record import Record, join_runs
from reactorwatch.records.write import write_table
from recorder.config import RecorderConfig, ReplayConfig
from recorder.core import Recorder
from recorder.files.copies import Window, cut
from recorder.files.recording import PROCESS, Recording, process_metadata, processes_in
from recorder.recording_files import RecordingFiles
from recorder.tools.convert import export_csv, import_csv, read_record
from recorder.tools.inspect import inspect
from recorder.tools.player import samples_of
from recorder.tools.replay import open_tape
from tests.unit.plant_node.test_plant_of_any_process import RIG
from tests.unit.recorder.recording import received, recorded
from tests.unit.records.test_csv_file import assert_same

UNITS = ("", "degC", "bar", "l/min", "%", "m3/h", "cm3/s")
NAMES = ("T", "qc", "u", "h1", "run", "time", "Zeit", "3", "TI-101.PV", "Füllstand", "a b", "50%", "x,y", 'a"b', "µ;λ")
"""Names that processes of the catalogue, time columns, columns of runs and separators have, and harmless ones."""

A_NAME = st.sampled_from(NAMES) | st.from_regex(r"[A-Za-z_][A-Za-z0-9_.:+-]{0,12}", fullmatch=True)
ALL_NS = (0, 2**63 - 1)


@st.composite
def processes(draw: st.DrawFn) -> Process:
    """Processes of 1 to 6 signals in any roles, at least one of them an output."""
    names = draw(st.lists(A_NAME, min_size=1, max_size=6, unique=True).filter(lambda given: "time_min" not in given))
    roles = ["output", *(draw(st.sampled_from(ROLES)) for _ in names[1:])]
    signals = [Signal(name, draw(st.sampled_from(UNITS)), role) for name, role in zip(names, roles, strict=True)]
    return Process("rig", tuple(draw(st.permutations(signals))))


@st.composite
def records(draw: st.DrawFn, process: Process) -> Record:
    """One run with gaps in time, and with cells and columns that were not measured; or two full and even runs."""
    is_one = "run" in [item.name for item in process.signals] or draw(st.booleans())
    values = st.floats(-1e14, 1e14) | st.just(np.nan) if is_one else st.floats(-1e14, 1e14)
    runs = []
    for start_us in draw(st.lists(st.integers(-(10**12), 10**12), min_size=2 - is_one, max_size=2 - is_one)):
        steps_us = draw(st.lists(st.sampled_from([1, 7, 10**6, 10**9]), min_size=3, max_size=8))
        steps_us = steps_us if is_one else [10**6] * len(steps_us)
        cells = st.lists(values, min_size=len(steps_us), max_size=len(steps_us))
        columns = {item.name: np.array(draw(cells)) for item in process.signals}
        runs.append(Record((start_us + np.cumsum(steps_us)) / 60e6, columns, "rig.csv", units=process.units))
    return join_runs(runs)


def described(folder: Path, process: Process) -> ProcessChoice:
    """The choice of a process by the file that describes it."""
    signals = [
        {
            "name": item.name,
            "unit": item.unit,
            "role": item.role,
            **({} if item.bounds is None else {"bounds": list(item.bounds)}),
        }
        for item in process.signals
    ]
    document = {"name": process.name, "time": {"column": "time_min"}, "file": {"header": True}, "signals": signals}
    path = folder / "rig.toml"
    path.write_text(tomli_w.dumps(document), encoding="utf-8")
    return ProcessChoice(str(path))


def signals_of(processes: Mapping[str, Process]) -> dict[str, list[tuple[str, str, str]]]:
    return {
        plant: [(item.name, item.role, item.unit) for item in process.signals] for plant, process in processes.items()
    }


@given(data=st.data(), process=processes())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25, deadline=None)
def test_a_record_of_any_process_comes_back_identical(tmp_path: Path, data: st.DataObject, process: Process) -> None:
    record, choice = data.draw(records(process)), described(tmp_path, process)
    csv, mcap, again = tmp_path / "rig.csv", tmp_path / "rig.mcap", tmp_path / "again.csv"
    write_table(csv, record)
    imported = import_csv(csv, mcap, choice=choice)
    assert_same(imported, record)
    found = inspect(mcap)
    assert signals_of(found.processes) == signals_of({"rig": process})
    assert (found.overview.lost, found.overview.duplicated, found.overview.out_of_place) == (0, 0, 0)
    sent = {entry.key for entry in Recording(mcap).messages()}
    assert sent <= {f"reactor/rig/sample/{item.name}" for item in process.signals}
    exported = export_csv(mcap, again)
    assert_same(exported, record)
    present = {name for name, values in record.columns.items() if np.isfinite(values).any()}
    assert {name: unit for name, unit in exported.units.items() if name in present} == {
        name: unit for name, unit in process.units.items() if name in present
    }
    assert again.read_bytes() == csv.read_bytes()
    assert_same(import_csv(again, mcap, choice=choice), record)
    needed = {*present, *process.inputs, *process.outputs}
    columns = {name: values for name, values in record.columns.items() if name in needed}
    assert_same(export_csv(mcap, again, choice=choice), replace(record, columns=columns))


def three_tanks_record() -> Record:
    process = find_process("three_tanks")
    columns = {name: 10.0 * number + np.sin(np.arange(30.0)) for number, name in enumerate(process.units)}
    columns["h2"][7:9] = np.nan
    return Record(np.arange(30.0) / 20, columns, "tanks.csv", units=process.units)


@pytest.fixture
def tanks(tmp_path: Path) -> Path:
    """A recording of the three tanks."""
    write_table(tmp_path / "tanks.csv", three_tanks_record())
    import_csv(tmp_path / "tanks.csv", tmp_path / "tanks.mcap", choice=ProcessChoice("three_tanks"))
    return tmp_path / "tanks.mcap"


def test_info_names_the_process_and_its_signals_by_role_with_their_units(tanks: Path) -> None:
    found = inspect(tanks)
    assert "three_tanks is a process 'three_tanks': inputs Q1, Q2 (cm3/s); outputs h1, h2, h3 (cm)" in info_text(
        found, tanks
    )
    (told,) = info_object(found, tanks)["processes"]
    assert (told["plant"], told["process"]) == ("three_tanks", "three_tanks")
    assert told["signals"]["Q2"] == {"role": "input", "unit": "cm3/s"}


def test_cut_recordings_describe_their_processes(tanks: Path, tmp_path: Path) -> None:
    expected = signals_of(inspect(tanks).processes)
    cut([tanks], tmp_path / "cut.mcap", Window(ALL_NS), {})
    cut([tanks, tmp_path / "cut.mcap"], tmp_path / "both.mcap", Window(ALL_NS), {})
    for name in ("cut", "both"):
        assert signals_of(inspect(tmp_path / f"{name}.mcap").processes) == expected
    assert signals_of(inspect(tmp_path).processes) == expected


def test_a_table_that_is_no_record_of_the_reactor_is_refused_with_the_options_that_the_command_has(
    tanks: Path, tmp_path: Path
) -> None:
    cure = "if it is no record of the reactor, name its process with --process"
    with pytest.raises(InputError, match=rf"tanks.csv, row 1: expected a column 'qc' .*{cure}, or its columns"):
        import_csv(tanks.with_suffix(".csv"), tmp_path / "x.mcap")
    assert not (tmp_path / "x.mcap").exists()
    with pytest.raises(InputError, match=f"{cure}$"):
        read_process_table(tanks.with_suffix(".csv"), find_process())


def test_without_a_description_columns_are_named_as_inputs_and_outputs(tanks: Path, tmp_path: Path) -> None:
    choice = ProcessChoice(inputs=("Q1",), outputs=("h3", "h1"))
    import_csv(tanks.with_suffix(".csv"), tmp_path / "x.mcap", choice=choice)
    assert signals_of(inspect(tmp_path / "x.mcap").processes) == {
        "plant": [("Q1", "input", ""), ("h3", "output", ""), ("h1", "output", "")]
    }
    assert list(read_record(tmp_path / "x.mcap").columns) == ["Q1", "h3", "h1"]


@pytest.mark.parametrize(("unit", "factor"), [("mm", 10.0), ("m", 0.01), ("cm", 1.0)])
def test_export_gives_the_units_of_the_process_that_it_names(tanks: Path, unit: str, factor: float) -> None:
    signals = (Signal("h1", unit), Signal("h2", unit, bounds=(factor * 29.5, factor * 90.0)))
    choice = described(tanks.parent, Process("rig", signals))
    exported, measured = export_csv(tanks, tanks.with_suffix(".parquet"), choice=choice), three_tanks_record().columns
    assert exported.units == {"h1": unit, "h2": unit}
    assert exported.columns["h1"] == pytest.approx(factor * measured["h1"], rel=1e-12)
    outside = ~(measured["h2"] >= 29.5)
    assert (np.isnan(exported.columns["h2"]) == outside).all()
    assert 2 < outside.sum() < outside.size


def test_a_recording_that_nothing_describes_gives_all_its_signals_in_the_order_of_a_known_process(
    tanks: Path, tmp_path: Path
) -> None:
    record = three_tanks_record()
    shuffled: dict[str, NDArray[Any]] = {name: record.columns[name] for name in ("h3", "Q2", "h1", "Q1", "h2")}
    for names, expected in (((*shuffled,), ["Q1", "Q2", "h1", "h2", "h3"]), (("h3", "Q2"), ["Q2", "h3"])):
        columns = {name: shuffled[name] for name in names}
        path = tmp_path / "undescribed.mcap"
        write_undescribed(path, Record(record.time_min, columns, "x", units=record.units))
        assert Recording(path).process("rig") is None
        assert list(read_record(path).columns) == expected
    write_undescribed(path, Record(record.time_min, {"z": record.time_min, "Q2": record.time_min}, "x"))
    assert list(read_record(path).columns) == ["z", "Q2"]


def write_undescribed(path: Path, record: Record) -> None:
    """Record samples as a recorder does, which knows of no process."""
    path.unlink(missing_ok=True)
    recorded(path, (received(*item) for item in samples_of(record, "rig")), metadata={"plant": "rig"})


def test_a_process_whose_name_no_plant_can_have_is_refused_with_the_cure(tmp_path: Path) -> None:
    csv = tmp_path / "rig.csv"
    csv.write_text("time_min,h\n0,1\n1,2\n")
    choice = described(tmp_path, Process("heat exchanger 1", (Signal("h"),)))
    with pytest.raises(InputError, match=r"got 'heat exchanger 1'; .* choose one by --plant"):
        import_csv(csv, tmp_path / "rig.mcap", choice=choice)
    assert import_csv(csv, tmp_path / "rig.mcap", "rig", choice=choice).rows == 2


def test_a_signal_with_the_name_of_another_column_is_not_written_over(tmp_path: Path) -> None:
    times = np.arange(3.0)
    for name in ("time_min", "run"):
        runs = None if name == "time_min" else np.array([1, 1, 2])
        record = Record(times, {name: times}, "rig.csv", runs=runs)
        with pytest.raises(
            InputError, match=rf"rig.csv: signal '{name}' has the name of a column .* column = '{name}'"
        ):
            write_table(tmp_path / "out.csv", record)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".csv", ".mcap"])
def test_a_replay_publishes_the_samples_of_any_process_under_its_signals(tanks: Path, suffix: str) -> None:
    record, file = three_tanks_record(), str(tanks.with_suffix(suffix))
    for config, signals in (
        (ReplayConfig(file, process="three_tanks"), list(record.columns)),
        (ReplayConfig(file, inputs=("Q1",), outputs=("h2",), plant="three_tanks"), ["Q1", "h2"]),
    ):
        (plant,), tape = open_tape(config)
        assert plant == "three_tanks"
        played: dict[str, list[float]] = {}
        for publication in tape():
            played.setdefault(publication.key, []).append(publication.message.value)  # type: ignore[union-attr]
        measured = {f"reactor/three_tanks/sample/{name}": record.columns[name] for name in signals}
        assert played == {key: values[np.isfinite(values)].tolist() for key, values in measured.items()}


@pytest.mark.parametrize("name", ["P*", "$x", "a#1", "ready?", "@T"])
@pytest.mark.parametrize("suffix", [".csv", ".mcap"])
def test_a_signal_that_the_bus_cannot_name_is_recorded_and_not_replayed_with_the_cure(
    tmp_path: Path, name: str, suffix: str
) -> None:
    choice, csv = described(tmp_path, Process("rig", (Signal(name), Signal("y")))), tmp_path / "rig.csv"
    write_table(csv, Record(np.arange(3.0), {name: np.arange(3.0), "y": np.arange(3.0)}, "rig.csv"))
    import_csv(csv, tmp_path / "rig.mcap", choice=choice)
    assert list(read_record(tmp_path / "rig.mcap").columns) == [name, "y"]
    with pytest.raises(InputError, match=r"must not hold .*; import it with a process that gives the signal another"):
        open_tape(ReplayConfig(str(tmp_path / f"rig{suffix}"), process=choice.process))
    assert open_tape(ReplayConfig(str(tmp_path / "rig.mcap"), outputs=("y",)))[0] == ("rig",)


START_NS = 10**18
CATALOGUE = [make().name for make in MODELS]


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


@pytest.mark.parametrize("name", CATALOGUE)
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
    assert not stored.generic
    assert store(replace(rig, generic=True)).generic
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


def test_a_later_description_of_a_plant_is_not_used() -> None:
    first, later = (Metadata(PROCESS, process_metadata("unit", find_process(name))) for name in CATALOGUE[:2])
    assert processes_in([first, later])["unit"].name == CATALOGUE[0]
    assert processes_in([later, first])["unit"].name == CATALOGUE[1]


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
