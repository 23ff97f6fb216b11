"""Whatever a person gets wrong about recordings: one line, exit code 2, and nothing written or changed."""

import shlex
import sys
from pathlib import Path

import pytest

from reactorwatch.cli.main import main
from recorder import RecordedMessage
from recorder.files.writer import RecordingWriter
from tests.unit.recorder import golden

NO_ROUTER = "--endpoint tcp/127.0.0.1:1"


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("good") / "good.mcap"
    with RecordingWriter(path, {"plant": "cstr"}) as writer:
        for entry in golden.entries():
            writer.write(entry)
    return path.read_bytes()


@pytest.fixture
def folder(tmp_path: Path, good: bytes, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Recordings in every state, and settings."""
    files = {
        "good.mcap": good,
        "cut_off.mcap": good[:-50],
        "broken.mcap": good[: len(good) // 2] + bytes(3000) + good[len(good) // 2 + 3000 :],
        "no_bytes.mcap": b"",
        "text.mcap": b"hello",
        "run.csv": b"time_min,qc,C,T\n0,1,2,3\n1,1,2,3\n",
        "word.csv": b"time_min,qc,C,T\n0,1,x,3\n",
        "unknown_key.toml": b"[recorder]\nkeep_fies = 3\n",
        "negative.toml": b"[recorder]\nrotate_min = -1.0\n",
        "text.toml": b'[recorder]\nrotate_min = "x"\n',
        "no.toml": b"[[[",
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "folder").mkdir()
    with RecordingWriter(tmp_path / "nothing.mcap", {}):
        pass
    with RecordingWriter(tmp_path / "stranger.mcap", {}) as writer:
        writer.write(RecordedMessage("weather/today", b"1", "text/plain", 1, 1))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def state(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        (f"record -o away/x.mcap {NO_ROUTER}", "the folder away does not exist"),
        (f"record -o run.csv {NO_ROUTER}", "--out run.csv: is a file, the name of a folder was expected"),
        (f"record -o missing.csv {NO_ROUTER}", "no .csv file is written, the name of a folder was expected"),
        (f"record -o good.mcap {NO_ROUTER}", "exists already and is not overwritten; choose another name"),
        (f"record --plant a/b {NO_ROUTER}", "plant name must be"),
        ("record --endpoint nonsense", "endpoint must be like 'tcp/127.0.0.1:7447', got 'nonsense'"),
        ("record --config unknown_key.toml", "unknown key 'keep_fies'; did you mean 'keep_files'?"),
        ("record --config negative.toml", "rotate_min must be positive, or inf, got -1.0"),
        ("record --config text.toml", "Expected `float`, got `str` - at `$.rotate_min`"),
        ("record --config no.toml", "is not TOML"),
        ("record --config none.toml", "No such file"),
        ("record extra", "unexpected extra argument"),
        ("record --oout x", "No such option: --oout"),
        ("info", "Missing argument"),
        ("info none.mcap", "there is no such file"),
        ("info no_bytes.mcap", "got an empty file"),
        ("info text.mcap", "got another kind of file"),
        ("info run.csv --zone Bonn", "--zone must be a time zone"),
        ("info folder", "holds no recording"),
        ("info --jso good.mcap", "No such option: --jso"),
        ("cut good.mcap", "Missing option '--out'"),
        ("cut none.mcap -o x.mcap", "there is no such file"),
        ("cut good.mcap -o away/x.mcap", "the folder away does not exist; create it first"),
        ("cut good.mcap -o folder", "is a folder, a file name was expected"),
        ("cut good.mcap -o x.csv", "must end in .mcap"),
        ("cut good.mcap -o x", "must end in .mcap"),
        ("cut good.mcap -o good.mcap", "is one of the files that are read (good.mcap); name another file"),
        ("cut good.mcap --from 10 -o x.mcap", "--from must be a number with s, min or h, such as 10min, got '10'"),
        ("cut good.mcap --from -5 -o x.mcap", "--from must be a number with s, min or h"),
        ("cut good.mcap --from 20min --to 10min -o x.mcap", "--from must be before --to, got 20min and 10min"),
        ("cut good.mcap --from 99999min -o x.mcap", "holds no sample of that time"),
        ("cut cut_off.mcap -o x.mcap", "`reactorwatch recover cut_off.mcap` saves what is whole in it"),
        ("cut broken.mcap -o x.mcap", "`reactorwatch recover broken.mcap` saves what is whole in it"),
        ("cut no_bytes.mcap -o x.mcap", "got an empty file"),
        ("cut run.csv -o x.mcap", "got another kind of file"),
        ("cut nothing.mcap -o x.mcap", "holds no sample"),
        ("cut stranger.mcap -o x.mcap", "holds no sample"),
        ("cut folder -o x.mcap", "holds no recording"),
        ("recover none.mcap", "there is no such file"),
        ("recover no_bytes.mcap", "got an empty file"),
        ("recover text.mcap", "got another kind of file"),
        ("recover run.csv", "got another kind of file"),
        ("recover folder", "is a folder, a file was expected"),
        ("recover nothing.mcap", "holds no message that could be saved (it is whole)"),
        ("recover cut_off.mcap -o cut_off.mcap", "is one of the files that are read (cut_off.mcap); name another file"),
        ("recover cut_off.mcap -o away/x.mcap", "the folder away does not exist; create it first"),
        ("recover cut_off.mcap -o x.csv", "must end in .mcap"),
        (f"replay none.mcap {NO_ROUTER}", "there is no such file"),
        (f"replay no_bytes.mcap {NO_ROUTER}", "got an empty file"),
        (f"replay cut_off.mcap {NO_ROUTER}", "`reactorwatch recover cut_off.mcap`"),
        (f"replay nothing.mcap {NO_ROUTER}", "holds no samples"),
        (f"replay folder {NO_ROUTER}", "holds no recording"),
        (f"replay word.csv {NO_ROUTER}", "word.csv, row 2, column 'C': expected a finite number or nothing, got 'x'"),
        (f"replay run.csv --column T=t {NO_ROUTER}", "expected a column 't' in the header"),
        (f"replay good.mcap --column T=t {NO_ROUTER}", "--column is for the columns of a .csv file"),
        (f"replay good.mcap --rate 0 {NO_ROUTER}", "--rate must be a positive number or 'max', got '0'"),
        (f"replay good.mcap --rate fast {NO_ROUTER}", "--rate must be a positive number or 'max', got 'fast'"),
        (f"replay good.mcap --from 10 {NO_ROUTER}", "--from must be a number with s, min or h"),
        (f"replay good.mcap --from 20min --to 10min {NO_ROUTER}", "must be before"),
        (f"replay good.mcap --from 99999min {NO_ROUTER}", "holds nothing to play from 99999 min to the end"),
        (f"replay good.mcap --plant a/b {NO_ROUTER}", "plant name must be"),
        ("replay good.mcap --endpoint nonsense", "endpoint must be like"),
        ("replay run.csv --verify", "holds no alarms to verify; a recording (.mcap) was expected"),
        ("replay good.mcap --verify", "does not say how the monitor was set; name the settings file"),
        ("replay good.mcap --verify --from 10min", "--verify publishes nothing and takes the whole recording"),
        ("replay good.mcap --verify --loop", "leave out --loop"),
        ("replay good.mcap --verify --plant other", "holds no samples of plant 'other' (there are: cstr)"),
        ("replay cut_off.mcap --verify", "`reactorwatch recover cut_off.mcap`"),
        ("replay folder --verify", "holds no recording"),
    ],
)
def test_what_is_typed_wrong_gets_one_line_and_exit_code_2_and_leaves_all_as_it_was(
    folder: Path, typed: str, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = state(folder)
    monkeypatch.setattr(sys, "argv", ["reactorwatch", *shlex.split(typed)])
    with pytest.raises(SystemExit) as ended:
        main()
    shown = capsys.readouterr()
    assert ended.value.code == 2
    assert shown.out == ""
    assert shown.err.startswith("reactorwatch: ")
    assert shown.err.count("\n") == 1
    assert said in shown.err
    assert state(folder) == before
