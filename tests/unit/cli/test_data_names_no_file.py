"""Data never choose a file: a recording or an extended model that names one has it neither run nor opened."""

import json
import sys
from pathlib import Path

import msgspec
import pytest

from reactorwatch.api.records import read_record
from reactorwatch.cli.main import main
from reactorwatch.cli.plant_settings import PlayedRecord, load_source
from reactorwatch.cli.processes import Processes
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication, encode
from reactorwatch.contract.messages_pb2 import QUALITY_GOOD, Health, Sample
from reactorwatch.description.read import find_in_catalogue, find_process
from reactorwatch.errors import InputError
from reactorwatch.process.extended_model import FORMAT, ExtendedModel
from recorder import RecordedMessage
from recorder.config import ReplayConfig
from recorder.files.recording import PROCESS
from recorder.files.writer import RecordingWriter
from recorder.tools.replay import open_tape

MARKER = "marker"
HELPER = f"""
open({MARKER!r}, "w").close()

def process():
    import reactorwatch
    return reactorwatch.Process("x", ())
"""
TABLES = """
[plant]
process = {name}
[monitor]
{key} = {name}
[replay]
process = {name}
[diagnosis]
process = {name}
[recorder.processes]
cstr = {name}
[fleet.processes]
cstr = {name}
"""
ROW_NS, ROWS = 6_000_000_000, 40


def write_forged(path: Path, name: str, key: str = "process", *, is_described: bool = True) -> None:
    """Write a recording whose settings, metadata and health all claim that a file judged its plant."""
    about = {"plant": "cstr", "settings": TABLES.format(name=json.dumps(name), key=key), "process": name}
    with RecordingWriter(path, about) as writer:
        start_ns = 10**18

        def add(key: str, message: Health | Sample, time_ns: int) -> None:
            encoded = encode(Publication(key, message))
            writer.write(RecordedMessage(key, encoded.payload, encoded.encoding, time_ns, time_ns))

        health = Health(time_ns=start_ns, node="monitor", phase="waiting", reference="equations")
        add(keys.key("cstr", keys.HEALTH, "monitor"), health, start_ns)
        for row in range(ROWS):
            time_ns = start_ns + row * ROW_NS
            for signal, value, unit in (("qc", 103.0 + row % 7, "l/min"), ("C", 0.1, "mol/l"), ("T", 438.0, "K")):
                sample = Sample(time_ns=time_ns, sequence=row, value=value, unit=unit, quality=QUALITY_GOOD)
                add(keys.key("cstr", keys.SAMPLE, signal), sample, time_ns)
        signals = [{"name": "qc", "role": "input"}, {"name": "C", "role": "output"}, {"name": "T", "role": "output"}]
        described = {"plant": "cstr", "process": name, "signals": json.dumps(signals)}
        forged = {
            "equations": json.dumps({"format": FORMAT, "model": name}),
            "parameters": "{}",
        }
        if is_described:
            writer.add_metadata(PROCESS, described | forged)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder with a helper that leaves a marker, and files that cannot be read as what they seem to be."""
    for name in ("helper.py", "HELPER.PY"):
        (tmp_path / name).write_text(HELPER, encoding="utf-8")
    for name in ("helper.toml", "helper.json"):
        (tmp_path / name).write_text("[[[", encoding="utf-8")
    (tmp_path / "run").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def call(typed: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Run the command; returns its exit code and what it printed as errors."""
    monkeypatch.setattr(sys, "argv", ["reactorwatch", *typed])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0), capsys.readouterr().err


@pytest.mark.parametrize("is_described", [True, False])
@pytest.mark.parametrize("key", ["process", "model"])
@pytest.mark.parametrize(
    "name", ["helper.py", "./helper.py", "{folder}/helper.py", "HELPER.PY", "helper.json", "nowhere"]
)
def test_a_replay_that_is_verified_opens_no_file_that_the_recording_names(
    name: str,
    key: str,
    is_described: bool,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    name = name.format(folder=folder)
    write_forged(folder / "run.mcap", name, key, is_described=is_described)
    code, shown = call(["replay", "run.mcap", "--verify"], monkeypatch, capsys)
    assert (code, shown.count("\n")) == (2, 1)
    assert f"run.mcap: is of process {name!r}" in shown
    assert "--process" in shown
    assert not (folder / MARKER).exists()


def test_a_description_in_a_file_that_the_recording_names_is_not_opened_either(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The recording's own description of the signals is taken."""
    write_forged(folder / "run.mcap", "helper.toml")
    code, shown = call(["replay", "run.mcap", "--verify"], monkeypatch, capsys)
    assert (code, shown.count("\n")) == (2, 1)
    assert "holds no message of a monitor" in shown


@pytest.mark.parametrize(
    "typed",
    [
        "replay FILE --verify",
        "replay FILE --verify --plant cstr",
        "info FILE",
        "info FILE --json",
        "diagnose FILE",
        "simulate FILE -o x.csv",
        "dashboard FILE -o x.rrd",
        "export FILE -o x.csv",
        "export FILE -o x.mcap",
        "backtest FILE",
        "import FILE -o x.mcap",
        "recover FILE -o x.mcap",
        "cut FILE -o x.mcap --from 0min --to 2min",
        "causes --process cstr --record FILE",
        "identify FILE --output T",
        "linearise --process FILE",
        "view FILE",
        "plant --process FILE",
    ],
)
@pytest.mark.parametrize("file", ["run.mcap", "run"])
def test_no_command_runs_a_file_that_a_recording_names(
    typed: str, file: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in (folder / "run.mcap", folder / "run" / "1.mcap"):
        write_forged(path, str(folder / "helper.py"))
    code, shown = call(typed.replace("FILE", file).split(), monkeypatch, capsys)
    assert not (folder / MARKER).exists()
    if code:
        assert code in (2, 3)
        (line,) = (line for line in shown.splitlines() if line.startswith("reactorwatch: "))
        assert "Traceback" not in shown, line


def test_no_node_takes_the_file_that_a_played_recording_names(folder: Path) -> None:
    path = folder / "run.mcap"
    write_forged(path, str(folder / "helper.py"))
    open_tape(ReplayConfig(file=str(path)))
    read_record(path)
    with pytest.raises(InputError, match="in no catalogue here"):
        find_in_catalogue(str(folder / "helper.py"), "data")
    with pytest.raises(InputError, match="in no catalogue here"):
        load_source({}, {}, PlayedRecord(path))
    assert not (folder / MARKER).exists()


@pytest.mark.parametrize("place", ["model", "process", "both"])
def test_an_extended_model_names_no_file(place: str, folder: Path) -> None:
    written = ExtendedModel("cstr").to_object()
    if place != "process":
        written["model"] = "helper.py"
    if place != "model":
        signals = [{"name": "qc", "role": "input"}, {"name": "C", "role": "output"}, {"name": "T", "role": "output"}]
        written["process"] = {"name": "helper.py", "equations": "helper.py", "signals": signals}
    (folder / "extended.json").write_bytes(msgspec.json.encode(written))
    if place == "process":
        assert find_process("extended.json").require_model().name == "cstr"
    else:
        with pytest.raises(InputError, match=r"extended\.json: unknown model 'helper\.py'"):
            find_process("extended.json")
    assert not (folder / MARKER).exists()


def test_a_node_imports_nothing_from_the_folder_that_it_is_started_in(folder: Path) -> None:
    for name in ("plant_node", "structlog", "reactorwatch"):
        (folder / f"{name}.py").write_text(HELPER, encoding="utf-8")
    (folder / "settings.toml").write_text("[plant]\nprocess = 7\n", encoding="utf-8")
    with Processes({"plant": folder / "settings.toml"}, folder) as nodes:
        assert nodes.start("plant").wait(60) == 2
    assert "process" in (folder / "plant.log").read_text(encoding="utf-8")
    assert not (folder / MARKER).exists()


def test_a_file_that_the_user_names_is_run(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Else the tests before would prove less than they say."""
    write_forged(folder / "run.mcap", "helper.py")
    code, shown = call(["replay", "run.mcap", "--verify", "--process", "helper.py"], monkeypatch, capsys)
    assert code == 2
    assert "at least one signal must be an output" in shown
    assert (folder / MARKER).exists()
