"""Settings of the nodes of a run, from files, flags and columns, and where the nodes write."""

import shlex
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from diagnosis_node.trigger import DiagnosisConfig
from monitor_node.config import MonitorConfig
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.cli import up
from reactorwatch.cli.bus_client import observed_process
from reactorwatch.cli.demo import choose_fault
from reactorwatch.cli.main import app, main
from reactorwatch.cli.my_plant import describe_in_file
from reactorwatch.cli.option_groups import BusOptions
from reactorwatch.cli.plant_settings import PlayedRecord, load_source
from reactorwatch.cli.up import diagnosis_settings
from reactorwatch.description.process import Process, Signal
from reactorwatch.description.read import ProcessChoice, find_process
from reactorwatch.errors import InputError
from reactorwatch.process import MODELS
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.write import write_table
from reactorwatch.runtime.config import BusConfig, section
from reactorwatch.runtime.event_loop import StopSignal
from recorder.__main__ import record
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


def test_columns_are_described_in_a_file_that_is_gone_after_the_run() -> None:
    choice = ProcessChoice(None, ("Heater 1", "Heater 2"), ("T 1", 'a "quoted" name'))
    with describe_in_file(choice) as named:
        assert named is not None
        assert find_process(named) == choice.load()
    assert not Path(named).exists()


@pytest.mark.parametrize("named", [None, "three_tanks"])
def test_a_process_that_has_a_name_needs_no_file(named: str | None) -> None:
    with describe_in_file(ProcessChoice(named)) as found:
        assert found == named


def test_columns_without_a_record_are_refused_with_the_cure() -> None:
    run = CliRunner().invoke(app, ["up", "--input", "q", "--output", "th"])
    assert isinstance(run.exception, InputError)
    assert "are for the record of --record; name it, or leave them out" in str(run.exception)


@pytest.mark.parametrize(("arguments", "inputs"), [(["--input", "q1,q2"], ("q1", "q2")), ([], ())])
def test_the_monitor_takes_its_signals_from_columns(
    monkeypatch: pytest.MonkeyPatch, arguments: list[str], inputs: tuple[str, ...]
) -> None:
    started: list[MonitorConfig] = []

    def start(config: MonitorConfig, *_: Any, **__: Any) -> None:
        started.append(config)

    monkeypatch.setattr("monitor_node.__main__.run", start)
    run = CliRunner().invoke(app, ["monitor", "--output", "th", "--output", "p", *arguments])
    assert run.exit_code == 0, run.exception
    assert [(config.inputs, config.outputs) for config in started] == [(inputs, ("th", "p"))]


MODEL = '{"format": "reactorwatch.model.v1", "model": "cstr"}'


def test_plant_and_model_are_those_of_the_monitor(tmp_path: Path) -> None:
    (tmp_path / "known.json").write_text(MODEL)
    monitor = MonitorConfig(plant="unit_2", process=str(tmp_path / "known.json"))
    found = diagnosis_settings({}, monitor, tmp_path / "reports")
    assert found == DiagnosisConfig(plant="unit_2", out=str(tmp_path / "reports"), process=monitor.process)


def test_settings_override_the_default_and_a_flag_overrides_both(tmp_path: Path) -> None:
    table = {"out": "here", "after_min": 12.0}
    assert diagnosis_settings({"diagnosis": table}, MonitorConfig(), None) == DiagnosisConfig(out="here", after_min=12)
    assert diagnosis_settings({"diagnosis": table}, MonitorConfig(), tmp_path).out == str(tmp_path)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"out": "FILE"}, "FILE: is a file, the name of a folder was expected"),
        ({"out": "new", "model": "none.json"}, "none.json: there is no such file"),
        ({"after": 3}, r"unknown key 'after'; did you mean 'after_min'\?"),
        ({"window_min": 10.0}, r"window_min must be in \[20, 1e\+06\], got 10"),
    ],
)
def test_an_impossible_setting_is_reported_before_anything_runs(
    table: dict[str, Any], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("FILE").write_text("")
    with pytest.raises(InputError, match=said):
        diagnosis_settings({"diagnosis": table}, MonitorConfig(), None)


NOT_PLANTS = "plants must be reactor/ and a name with or without '*'"
NO_SHARD = "shard must be like 2/5, the second of five"


ON_CLUSTER = ["--plants", "reactor/*", "--shards", "5", "--scheduler", "tcp://127.0.0.1:1", "--state", "states"]


def error_line(options: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    """The line that the command ends with."""
    monkeypatch.setattr(sys, "argv", ["reactorwatch", "monitor", "--endpoint", "tcp/127.0.0.1:1", *options])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize(
    "plants", ["", "foo", "reactor", "reactor/", "reactor/**", "reactor/a/*", "reactor/a b", "x/*"]
)
def test_plants_that_are_no_key_expression_of_plants(
    plants: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    line = error_line(["--plants", plants], monkeypatch, capsys)
    assert NOT_PLANTS in line
    assert f"got {plants!r}" in line


@pytest.mark.parametrize("shard", ["", "2", "0/5", "6/5", "-1/5", "1/0", "two/five", "1/2/3", "1/1001", "1 /2"])
def test_a_shard_that_is_none(shard: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    line = error_line(["--plants", "reactor/*", "--shard", shard], monkeypatch, capsys)
    assert NO_SHARD in line
    assert f"got {shard!r}" in line


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--shard", "1/2"], "--shard is a part of the plants that --plants names; give both"),
        (["--plants", "reactor/*", "--plant", "x"], "--plant is for the monitor of one plant"),
        (["--plants", "reactor/*", "--diagnose", "x"], "--diagnose is for the monitor of one plant"),
        (["--scheduler", "tcp://127.0.0.1:1"], "--state (a folder that all workers see): add --plants"),
        (["--plants", "reactor/*", "--scheduler", "tcp://127.0.0.1:1"], "add --shards"),
        (["--plants", "reactor/*", "--shards", "5"], "add --scheduler"),
        (["--plants", "reactor/*", "--shards", "5", "--scheduler", "tcp://127.0.0.1:1"], "add --state"),
        ([*ON_CLUSTER, "--shard", "1/5"], "--shard is one part of the plants, and --shards are all of them"),
        ([*ON_CLUSTER, "--shards", "0"], "shards must be in [1, 1000], got 0"),
        ([*ON_CLUSTER, "--process", "nowhere"], "nowhere"),
        ([*ON_CLUSTER, "--scheduler", "10.0.0.3"], "scheduler must be like tls://10.0.0.3:8786"),
        ([*ON_CLUSTER, "--scheduler", "tcp://::8786"], "got tcp://::8786"),
        ([*ON_CLUSTER, "--scheduler", "tcp://10.0.0.3:0"], "got tcp://10.0.0.3:0"),
        ([*ON_CLUSTER, "--scheduler", "tls://127.0.0.1:1"], "and certificates, of [fleet] identity or [bus], belong"),
    ],
)
def test_options_that_do_not_go_together(
    options: list[str], why: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert why in error_line(options, monkeypatch, capsys)


@pytest.mark.parametrize("options", [["--plants", "reactor/*"], []])
def test_a_folder_for_states_that_cannot_be_made(
    options: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    line = error_line([*options, "--state", str(tmp_path / "file")], monkeypatch, capsys)
    assert f"--state {tmp_path / 'file'}: is a file, the name of a folder was expected" in line


def test_a_file_that_can_hold_but_one_plants_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = tmp_path / "settings.toml"
    settings.write_text("[monitor]\nstate_file = 'x'\n")
    line = error_line(["--config", str(settings), "--plants", "reactor/*"], monkeypatch, capsys)
    assert "holds what is known of one plant; a fleet takes [fleet] state, a folder" in line


def test_settings_that_make_no_monitor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = tmp_path / "settings.toml"
    settings.write_text(
        "[monitor]\noutputs = ['p']\npriorities = {}\nreference = 'process'\n[fleet]\nplants = 'reactor/*'\n"
    )
    assert "reference" in error_line(["--config", str(settings)], monkeypatch, capsys)


@pytest.mark.parametrize("outputs", [("x2",), ("C",), ("C", "T"), ("T", "level")])
def test_default_priorities_hold_for_any_outputs(outputs: tuple[str, ...]) -> None:
    config = MonitorConfig(inputs=("u",), outputs=outputs)
    assert config.priorities == ({"T": "high"} if "T" in outputs else {})


def test_priorities_that_are_given_must_name_outputs() -> None:
    with pytest.raises(InputError, match="priorities are by output"):
        section(MonitorConfig, "monitor", {"monitor": {"outputs": ["x2"], "priorities": {"T": "high"}}}, {})


@pytest.mark.parametrize("out", ["recordings", "a/b"])
def test_a_recorder_makes_the_folder_that_it_writes_to(tmp_path: Path, out: str) -> None:
    stop = StopSignal()
    stop.set()
    record(RecorderConfig(out=str(tmp_path / out)), BusConfig(endpoint="tcp/127.0.0.1:1"), stop)
    assert (tmp_path / out).is_dir()


@pytest.mark.parametrize(
    ("settings", "flag", "expected"),
    [
        ("", None, "runs"),
        ("", "flag", "flag"),
        ("[recorder]\nout = 'set'\n", None, "set"),
        ("[recorder]\nout = 'set'\n", "flag", "flag"),
        ("[recorder]\nout = 'set/run.mcap'\n", None, "set"),
    ],
)
def test_up_records_in_the_folder_of_flag_then_settings_then_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, settings: str, flag: str | None, expected: str
) -> None:
    def stop_here(*_arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    Path("settings.toml").write_text(settings, encoding="utf-8")
    monkeypatch.setattr(up, "open_router", lambda *_: nullcontext())
    monkeypatch.setattr(up, "Processes", stop_here)
    with pytest.raises(KeyboardInterrupt):
        up.run_until_stopped(BusOptions(Path("settings.toml")), Path(flag) if flag else None, {})
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == [expected]
    assert len(list((tmp_path / expected).glob("*.toml"))) == 1


def test_up_leaves_a_recording_of_that_name_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(up, "open_router", lambda *_: nullcontext())
    (tmp_path / "run.mcap").write_bytes(b"")
    with pytest.raises(InputError, match="a recording of that name exists"):
        up.run_until_stopped(BusOptions(), tmp_path / "run.mcap", {})
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


@pytest.mark.parametrize("option", [["--endpoint", "tcp/127.0.0.1:1"], ["--config", "settings.toml"]])
def test_a_router_takes_a_file_or_settings_and_not_both(
    option: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["reactorwatch", "router", "router.json5", *option])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert "leave out --config and --endpoint" in capsys.readouterr().err


def run(typed: str, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sys, "argv", ["reactorwatch", *shlex.split(typed)])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    (tmp_path / "run.csv").write_text("time_min,qc,C,T\n0,100,0.1,440\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    made: list[tuple[Any, ...]] = []

    def run_until_stopped(*arguments: Any) -> int:
        made.append(arguments)
        return 0

    monkeypatch.setattr(up, "run_until_stopped", run_until_stopped)
    return made


@pytest.mark.parametrize(
    ("replay", "up"),
    [
        ("replay run.csv --up --rate 60", "up --record run.csv --speed 60"),
        ("replay run.csv --up --plant north --process cstr", "up --record run.csv --plant north --process cstr"),
    ],
)
def test_it_runs_what_up_runs_with_the_same_record(
    replay: str, up: str, calls: list[tuple[Any, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(replay, monkeypatch) == run(up, monkeypatch) == 0
    (target, out, flags, *rest), (up_target, up_out, up_flags, *up_rest) = calls
    assert (target.config, target.endpoint, out, rest) == (up_target.config, up_target.endpoint, up_out, up_rest)
    assert flags == {name: up_flags[name] for name in flags}
    assert not any(value for name, value in up_flags.items() if name not in flags)


@pytest.mark.parametrize(
    ("options", "named"), [("--up --from 1min", "--from"), ("--up --loop", "--loop"), ("--verify --up", "--up")]
)
def test_a_part_of_the_file_or_a_verification_is_refused_in_one_line(
    options: str,
    named: str,
    calls: list[tuple[Any, ...]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(f"replay run.csv {options}", monkeypatch) == 2
    assert calls == []
    shown = capsys.readouterr()
    assert shown.err.count("\n") == 1
    assert shown.err.rstrip().endswith(f"leave out {named}")
