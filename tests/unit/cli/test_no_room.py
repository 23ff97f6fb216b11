"""A full disk, for every command with an output: one line, exit code 2, no file left, and the result is printed.

The limit on the size of files stands for the disk: the system refuses what goes beyond it, to every writer there is.
"""

import contextlib
import io
import resource
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from reactorwatch.api import diagnosis
from tests.unit.cli.test_crash import files as files
from tests.unit.cli.test_crash import run
from tests.unit.cli.test_outputs import CASES as OUTPUTS
from tests.unit.cli.test_outputs import state
from tests.unit.diagnosis.cases import CASES

ROOM_BYTES = 64
LINES = {
    "export": ["export plant0.mcap -o new.csv"],
    "import": ["import good.csv -o new.mcap"],
    "simulate": ["simulate good.csv -o new.csv", "simulate good.csv -o new.csv --json"],
    "dashboard": ["dashboard plant0.mcap -o new.rrd"],
    "recover": ["recover plant0.mcap -o new.mcap", "recover plant0.mcap"],
    "cut": ["cut plant0.mcap -o new.mcap --from 1min"],
    "backtest": [
        "backtest good.csv plant0.mcap --jobs 1 -o new",
        "backtest good.csv plant0.mcap --jobs 1 -o there --json",
    ],
    "diagnose": [
        "diagnose good.csv -o new",
        "diagnose good.csv -o there --json",
        "diagnose good.csv other.csv --jobs 1 -o new",
    ],
    "example": ["example leak -o new.csv"],
}
ANSWERED = {"simulate", "backtest", "diagnose"}
ELSEWHERE = {"record", "up", "demo"}
"""They run until they are stopped; a recorder's full disk is an alarm: test_disk_full.py."""


def test_every_command_with_an_output_is_tested_here_or_there() -> None:
    assert LINES.keys() | ELSEWHERE == OUTPUTS.keys()


@pytest.fixture
def folder(files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for file in files.iterdir():
        (tmp_path / file.name).symlink_to(file)
    (tmp_path / "other.csv").symlink_to(files / "good.csv")
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "summary.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@contextlib.contextmanager
def no_room() -> Iterator[None]:
    """No file grows beyond a few bytes; Python ignores the signal, and the system returns the error."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (ROOM_BYTES, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("typed", [line for lines in LINES.values() for line in lines])
def test_a_full_disk_is_one_line_leaves_nothing_and_keeps_the_answer(
    folder: Path, typed: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(diagnosis, "find_causes", lambda *_: CASES["ambiguous"])
    command = typed.split()[0]
    before = state(folder)
    with no_room():
        assert run(shlex.split(typed), monkeypatch) == 2
    assert state(folder) == before
    shown = capsys.readouterr()
    lines = [line for line in shown.err.splitlines() if "too short" not in line]  # the records are
    assert len(lines) == (2 if "other.csv" in typed else 1)
    for line in lines:
        assert line.startswith("reactorwatch: ")
        assert "File too large" in line
        assert ".tmp" not in line
    assert bool(shown.out) == (command in ANSWERED)
    assert "wrote" not in shown.out


class Full(io.TextIOWrapper):
    """A stream onto a device that takes nothing."""

    def __init__(self) -> None:
        super().__init__(Path("/dev/full").open("wb", buffering=0), write_through=True)  # noqa: SIM115


@pytest.mark.parametrize(
    "typed",
    [
        *("info plant0.mcap", "info plant0.mcap --json", "identify good.csv", "linearise 100", "backtest good.csv"),
        *("charts arl shewhart", "charts design ewma --arl0 370 --shift 1", "--version", "--help", "info --help"),
        *("simulate good.csv -o new.csv", "export plant0.mcap -o new.csv", "diagnose good.csv"),
    ],
)
def test_where_nothing_can_be_printed_the_exit_code_reports_it(
    folder: Path, typed: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(diagnosis, "find_causes", lambda *_: CASES["ambiguous"])
    monkeypatch.setattr(sys, "stdout", Full())
    assert run(shlex.split(typed), monkeypatch) == 2
    said = capsys.readouterr().err
    assert said == "reactorwatch: standard output cannot be written: No space left on device\n"


def test_a_process_of_its_own_prints_the_same_and_nothing_more() -> None:
    code = "from reactorwatch.cli.main import main; main()"
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run(
            [sys.executable, "-c", code, "charts", "arl", "shewhart"], stdout=full, stderr=subprocess.PIPE, check=False
        )
        assert (done.returncode, done.stderr.count(b"\n")) == (2, 1)
        done = subprocess.run([sys.executable, "-c", code, "fly"], stderr=full, check=False)
    assert done.returncode == 2
