"""The ending of a name that an option such as `-o` gives selects the format, or is refused."""

import shlex
import sys
from pathlib import Path

import pytest
import typer
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from reactorwatch.cli.main import app, main
from reactorwatch.errors import InputError
from reactorwatch.records.write import check_folder_name
from recorder.tools.convert import import_csv

NO_ROUTER = "--endpoint tcp/127.0.0.1:1"
TABLES = (".csv", ".gz", ".xlsx", ".parquet")
FILES = {
    "dashboard run.csv": (".rrd",),
    "import run.csv": (".mcap",),
    "example leak": TABLES,
    "export run.mcap": TABLES,
    "simulate run.csv": TABLES,
    "recover run.mcap": (".mcap",),
    "cut run.mcap": (".mcap",),
}
"""Commands that write a file, and its endings."""

FOLDERS = ["diagnose run.csv", "backtest run.csv run.mcap", "demo", "up", f"record {NO_ROUTER}"]
"""Commands that write a folder; `record` a file, too."""

ENDINGS = [".parquet", ".csv", ".mcap", ".rrd", ".json", ".html", ".xlsx", ".part", ".7z", ""]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    rows = "".join(f"{row},100,0.1,438\n" for row in range(5))
    (tmp_path / "run.csv").write_text(f"time_min,qc,C,T\n{rows}")
    import_csv(tmp_path / "run.csv", tmp_path / "run.mcap", "cstr")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(typed: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that is said of a command that is refused."""
    monkeypatch.setattr(sys, "argv", ["reactorwatch", *shlex.split(typed)])
    with pytest.raises(SystemExit) as ended:
        main()
    shown = capsys.readouterr()
    assert (ended.value.code, shown.out) == (2, "")
    assert shown.err.count("\n") == 1
    return shown.err


def test_every_command_with_the_option_is_here() -> None:
    commands = typer.main.get_command(app)
    assert hasattr(commands, "commands")
    with_out = {
        name for name, command in commands.commands.items() if any("--out" in item.opts for item in command.params)
    }
    assert with_out == {typed.split()[0] for typed in (*FILES, *FOLDERS)}


@pytest.mark.parametrize("typed", FILES)
def test_a_file_of_another_kind_is_not_written(
    folder: Path, typed: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(folder.iterdir())
    for ending in ENDINGS:
        if ending not in FILES[typed]:
            said = refused(f"{typed} -o out{ending}", monkeypatch, capsys)
            assert f"out{ending}: the name must end in {' or '.join(FILES[typed])}, got {ending or 'no ending'}" in said
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize("typed", FOLDERS)
def test_a_folder_does_not_get_the_name_of_a_file(
    folder: Path, typed: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(folder.iterdir())
    for ending in (".parquet", ".html", ".csv"):
        said = refused(f"{typed} -o out{ending}", monkeypatch, capsys)
        assert f"--out out{ending}: no {ending} file is written, the name of a folder was expected; name it out" in said
    assert sorted(folder.iterdir()) == before


@given(st.from_regex(r"[a-z]{1,8}(\.[0-9]{1,4}|-v[0-9]\.[0-9]|)", fullmatch=True))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
def test_a_folder_may_have_a_dot_in_its_name(tmp_path: Path, name: str) -> None:
    check_folder_name(tmp_path / name, "--out")
    made = tmp_path / "made.d"
    made.mkdir(exist_ok=True)
    check_folder_name(made, "--out")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is a file, the name of a folder was expected"):
        check_folder_name(tmp_path / "file", "--out")
