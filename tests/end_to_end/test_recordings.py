"""Commands on recordings, for users and scripts."""

import json
from pathlib import Path

import pytest

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.records.write import write_table
from recorder.files.writer import RecordingWriter
from tests.tables import read_csv

from .conftest import Command


@pytest.fixture
def recording(tmp_path: Path, called: Command) -> Path:
    """Half an hour of a plant."""
    write_table(tmp_path / "run.csv", simulate_record(PlantConfig(seed=3), 300))
    assert called("import", tmp_path / "run.csv", "-o", tmp_path / "run.mcap").returncode == 0
    return tmp_path / "run.mcap"


def test_info_lists_the_contents_as_text_and_as_json(recording: Path, called: Command) -> None:
    said = called("info", recording)
    assert said.returncode == 0
    assert "900 messages of 3 topics" in said.stdout
    assert "no sample is missing" in said.stdout
    told = json.loads(called("info", recording, "--json").stdout)
    assert (told["messages"], told["lost"], told["whole"], told["to_min"]) == (900, 0, True, 29.9)
    assert [topic["topic"].rsplit("/", 1)[1] for topic in told["topics"]] == ["C", "T", "qc"]


def test_a_cut_keeps_the_minutes_of_the_recording_and_a_folder_of_cuts_is_one_recording(
    recording: Path, tmp_path: Path, called: Command
) -> None:
    (tmp_path / "both").mkdir()
    for name, arguments in {"a": ["--to", "9.9min"], "b": ["--from", "10min", "--to", "1h"]}.items():
        done = called("cut", recording, *arguments, "-o", tmp_path / "both" / f"{name}.mcap")
        assert done.returncode == 0, done.stderr
    assert called("export", tmp_path / "both" / "b.mcap", "-o", tmp_path / "b.csv").returncode == 0
    assert read_csv(tmp_path / "b.csv").time_min[[0, -1]].tolist() == [10.0, 29.9]
    assert "900 messages" in called("info", tmp_path / "both").stdout
    assert called("export", tmp_path / "both", "-o", tmp_path / "both.csv").returncode == 0
    assert (tmp_path / "both.csv").read_bytes() == (tmp_path / "run.csv").read_bytes()


def test_recover_reports_what_it_saved_and_leaves_the_damaged_file(
    recording: Path, tmp_path: Path, called: Command
) -> None:
    content = recording.read_bytes()
    recording.write_bytes(content[:-1])
    assert called("export", recording, "-o", tmp_path / "again.csv").returncode == 2
    done = called("recover", recording)
    assert done.returncode == 0, done.stderr
    assert "saved 900 messages of 3 topics" in done.stdout
    assert recording.read_bytes() == content[:-1]
    out = tmp_path / "run-recovered.mcap"
    told = json.loads(called("recover", recording, "-o", tmp_path / "other.mcap", "--json").stdout)
    assert (told["messages"], told["orphans"]) == (900, 0)
    assert called("export", out, "-o", tmp_path / "again.csv").returncode == 0
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "run.csv").read_bytes()
    assert called("recover", recording).returncode == 2  # never over a file that is there


def test_a_file_that_is_being_written_is_not_recovered_but_can_be_looked_at(tmp_path: Path, called: Command) -> None:
    with RecordingWriter(tmp_path / "run.mcap", {"plant": "cstr"}):
        done = called("recover", tmp_path / "run.mcap.part")
        assert done.returncode == 2
        assert "is still being written" in done.stderr
        said = called("info", tmp_path / "run.mcap.part")
        assert said.returncode == 0
        assert "not whole: cut off" in said.stdout


def test_a_folder_of_recordings_serves_wherever_a_recording_does(
    recording: Path, tmp_path: Path, called: Command
) -> None:
    folder = tmp_path / "runs"
    folder.mkdir()
    called("cut", recording, "--to", "14.9min", "-o", folder / "b.mcap")
    called("cut", recording, "--from", "15min", "-o", folder / "a.mcap")
    for arguments in (
        ("identify", folder, "--json"),
        ("dashboard", folder, "-o", tmp_path / "run.rrd"),
        ("export", folder, "-o", tmp_path / "again.csv"),
        ("info", folder),
    ):
        done = called(*arguments)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "run.csv").read_bytes()
    whole, parts = (called("backtest", path, "--training", "20", "--json") for path in (recording, folder))
    assert parts.returncode == 0, parts.stderr
    assert json.loads(whole.stdout) == json.loads(parts.stdout)
