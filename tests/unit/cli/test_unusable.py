"""Files without a usable sample, and names that mislead."""

import json
import shlex
from pathlib import Path

import pytest

from reactorwatch.cli.batch import expand_files
from reactorwatch.contract.codec import Publication, encode
from reactorwatch.contract.messages_pb2 import QUALITY_BAD, QUALITY_GOOD, Sample
from reactorwatch.errors import InputError
from recorder import RecordedMessage
from recorder.files.recording import Recording
from recorder.files.writer import RecordingWriter
from tests.unit.cli.test_crash import run

NO_ROUTER = "--endpoint tcp/127.0.0.1:1"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "empty.csv").write_text("time_min,qc,C,T\n0,,,\n1,,,\n")
    for name, value, quality in (
        ("bad", 1.0, QUALITY_BAD),
        ("nan", float("nan"), QUALITY_GOOD),
        ("huge", 1e300, QUALITY_GOOD),
    ):
        with RecordingWriter(tmp_path / f"{name}.mcap", {}) as writer:
            for row in range(5):
                time_ns = 10**18 + row * 6 * 10**9
                for signal in ("qc", "C", "T"):
                    sample = Sample(time_ns=time_ns, sequence=row, value=value, quality=quality)
                    body = encode(Publication(f"reactor/cstr/sample/{signal}", sample))
                    writer.write(RecordedMessage(body.key, body.payload, body.encoding, time_ns, time_ns))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("file", ["empty.csv", "bad.mcap", "nan.mcap", "huge.mcap"])
@pytest.mark.parametrize("command", ["backtest {}", "backtest {} --json", "dashboard {} -o x.rrd"])
def test_without_a_usable_sample_there_is_one_line_and_an_exit_code(
    folder: Path, command: str, file: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    is_watched, as_json = command.startswith("backtest"), command.endswith("--json")
    assert run(shlex.split(command.format(file)), monkeypatch) == (3 if is_watched else 2)
    shown = capsys.readouterr()
    assert (shown.out.count("\n"), shown.err.count("\n")) == (int(as_json), 1)
    if as_json:
        found = json.loads(shown.out)
        assert (found["file"], found["watched"]) == (file, False)
        assert found["why"].startswith("holds no sample that can be used")
    assert f"{file}: holds no sample that can be used" in shown.err
    assert not (folder / "x.rrd").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--from 90min", "from 90 min to the end"),
        ("--to 1min", "from the start to 1 min"),
        ("--from 51min --to 52min", "from 51 min to 52 min"),
    ],
)
def test_a_replay_of_nothing_states_its_start_and_end(
    folder: Path, options: str, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "nothing.csv").write_text("time_min,qc,C,T\n50,1,2,3\n60,1,2,3\n")
    assert run(shlex.split(f"replay nothing.csv {options} {NO_ROUTER}"), monkeypatch) == 2
    shown = capsys.readouterr().err
    assert said in shown
    assert "inf" not in shown


def test_a_folder_that_is_called_like_a_file_does_not_end_a_pattern(folder: Path) -> None:
    (folder / "a.csv").mkdir()
    (folder / "b.csv").touch()
    assert expand_files([Path("[ab].csv")]) == [Path("b.csv")]
    (folder / "a.csv" / "in.csv").touch()
    assert expand_files([Path("[ab].csv")]) == [Path("a.csv/in.csv"), Path("b.csv")]
    (folder / "c.csv").mkdir()
    with pytest.raises(InputError, match=r"c\.csv: holds no record"):
        expand_files([Path("c.csv")])
    with pytest.raises(InputError, match="no file is called like this"):
        expand_files([Path("[c].csv")])


def test_suffixes_in_capitals_are_suffixes(folder: Path) -> None:
    (folder / "in").mkdir()
    (folder / "in" / "A.CSV").touch()
    (folder / "in" / "B.Csv").touch()
    assert expand_files([Path("in")]) == [Path("in/A.CSV"), Path("in/B.Csv")]
    (folder / "bad.mcap").rename(folder / "in" / "C.MCAP")
    assert expand_files([Path("in")]) == [Path("in/A.CSV"), Path("in/B.Csv"), Path("in/C.MCAP")]
    assert Recording(Path("in")).files == [Path("in/C.MCAP")]
