"""Every command with an output refuses one that would destroy something, before it does anything."""

import os
import shlex
import stat
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, get_args, get_type_hints

import pytest
import typer

from reactorwatch.cli.batch import SUMMARY
from reactorwatch.cli.diagnose import REPORT
from reactorwatch.cli.main import app, main
from reactorwatch.records import write
from recorder import RecordedMessage
from recorder.files.writer import RecordingWriter
from tests.unit.recorder import golden

NO_ROUTER = "--endpoint tcp/127.0.0.1:1"


class Case(NamedTuple):
    """A command line with an output.

    Attributes:
        typed: what stands before the output.
        inputs: the paths in it by the parameter that takes them; all that the command has.
        out: the name of the output file, or of the folder.
        written: names that are written in the folder; empty where the output is a file.
        option: that names the output.
        never_overwrites: the output must not be there at all.
    """

    typed: str
    inputs: dict[str, str]
    out: str
    written: tuple[str, ...] = ()
    option: str = "--out"
    never_overwrites: bool = False


CASES = {
    "export": [Case("export run.mcap --process model.json", {"file": "run.mcap", "process": "model.json"}, "new.csv")],
    "import": [Case("import run.csv --process model.json", {"files": "run.csv", "process": "model.json"}, "new.mcap")],
    "simulate": [
        Case("simulate run.csv --model model.json", {"file": "run.csv", "process": "model.json"}, "new.csv"),
        Case("simulate run.mcap", {"file": "run.mcap", "process": ""}, "new.csv"),
    ],
    "dashboard": [
        Case(
            "dashboard run.mcap --diagnosis report --process model.json",
            {"file": "run.mcap", "diagnosis": "report/report.rrd", "process": "model.json"},
            "new.rrd",
        ),
    ],
    "example": [Case("example leak", {}, "new.csv")],
    "recover": [Case("recover run.mcap", {"file": "run.mcap"}, "new.mcap")],
    "cut": [
        Case("cut run.mcap", {"file": "run.mcap"}, "new.mcap"),
        Case("cut recordings", {"file": "recordings/a.mcap"}, "new.mcap"),
    ],
    "backtest": [
        Case(
            "backtest run.csv run.mcap --train other.csv --process model.json --config settings.toml",
            {"files": "run.csv", "train": "other.csv", "process": "model.json", "config": "settings.toml"},
            "folder",
            SUMMARY,
        ),
        Case(
            "backtest run.csv --train other.csv --process model.json --config settings.toml",
            {"files": "run.csv", "train": "other.csv", "process": "model.json", "config": "settings.toml"},
            "new.csv",
            option="--rows",
        ),
    ],
    "diagnose": [
        Case("diagnose run.csv --process model.json", {"files": "run.csv", "process": "model.json"}, "folder", REPORT),
        Case(
            "diagnose run.csv other.csv --model model.json",
            {"files": "other.csv", "process": "model.json"},
            "folder",
            (*SUMMARY, *(f"other/{name}" for name in REPORT)),
        ),
    ],
    "record": [
        Case(f"record {NO_ROUTER} --config settings.toml", {"config": ""}, "new.mcap", never_overwrites=True),
    ],
    "up": [Case(f"up {NO_ROUTER}", {"config": "", "diagnose": "", "site": "", "record": "", "process": ""}, "folder")],
    "demo": [Case("demo", {"site": "", "process": ""}, "folder", never_overwrites=True)],
}
ALL = [case for cases in CASES.values() for case in cases]
FOLDERS = ("folder",)
OF_FILES = [case for case in ALL if case.out not in FOLDERS and not case.never_overwrites]


def paths(function: Callable[..., object]) -> set[str]:
    """The names of the parameters of a command that are paths, or may be one."""
    hints = get_type_hints(function)
    return {name for name, hint in hints.items() if name == "process" or {Path, list[Path]} & {hint, *get_args(hint)}}


def commands(of: typer.Typer = app, before: str = "") -> Iterator[tuple[str, Callable[..., object]]]:
    """All commands by name."""
    for command in of.registered_commands:
        assert command.callback is not None
        yield f"{before}{command.name}", command.callback
    for group in of.registered_groups:
        assert group.typer_instance is not None
        yield from commands(group.typer_instance, f"{before}{group.name} ")


def test_every_command_with_an_output_is_tested_here_with_every_file_that_it_reads() -> None:
    outputs = {"out", "rows"}
    found = {name: paths(command) for name, command in commands() if outputs & paths(command)}
    assert {"export", "diagnose", "record"} <= found.keys()
    assert found.keys() == CASES.keys()
    for name, parameters in found.items():
        for case in CASES[name]:
            assert case.inputs.keys() == parameters - outputs, name


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("recording") / "run.mcap"
    with RecordingWriter(path, {"plant": "cstr"}) as writer:
        for entry in golden.entries():
            writer.write(entry)
        writer.write(RecordedMessage("weather/today", b"1", "text/plain", 1, 1))
    return path.read_bytes()


@pytest.fixture
def folder(tmp_path: Path, recording: bytes, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("recordings", "report", "folder", "pictures", "folder/other"):
        (tmp_path / name).mkdir()
    record = b"time_min,qc,C,T\n0,103,0.1,440\n1,103,0.1,440\n"
    files = {
        **dict.fromkeys(("run.csv", "other.csv"), record),
        **dict.fromkeys(("run.mcap", "other.mcap", "recordings/a.mcap"), recording),
        "model.json": b'{"model": "cstr"}',
        "settings.toml": b"",
        "report/report.rrd": b"RRF2",
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def state(folder: Path) -> dict[str, tuple[int, int, bytes]]:
    """All that is in a folder: mode, inode and content by name."""
    found = {}
    for path in sorted(folder.rglob("*")):
        status = path.lstat()
        found[str(path)] = status.st_mode, status.st_ino, path.read_bytes() if stat.S_ISREG(status.st_mode) else b""
    return found


def refuse(typed: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    """RunColumns a command line that must be refused with one line and change nothing; returns the line."""
    before = state(Path())
    monkeypatch.setattr(sys, "argv", ["reactorwatch", *shlex.split(typed)])
    with pytest.raises(SystemExit) as ended:
        main()
    shown = capsys.readouterr()
    assert (ended.value.code, shown.out, shown.err.count("\n")) == (2, "", 1), shown.err
    assert state(Path()) == before
    return shown.err


def line(case: Case, out: str, extra: str = "") -> str:
    return f"{case.typed} {case.option} {out} {extra}"


@pytest.mark.parametrize("link", ["hard", "symbolic", "chain"])
@pytest.mark.parametrize(
    ("case", "source"),
    [
        pytest.param(case, source, id=f"{case.typed.split()[0]}-{source}")
        for case in ALL
        for source in case.inputs.values()
        if source
    ],
)
def test_an_output_that_is_a_file_that_is_read_is_refused_through_links_and_with_force(
    folder: Path,
    case: Case,
    source: str,
    link: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in case.written or (case.out,):
        alias = folder / (f"{case.out}/{name}" if case.written else name)
        if link == "hard":
            os.link(source, alias)
        elif link == "symbolic":
            alias.symlink_to(folder / source)
        else:
            (folder / "between").symlink_to(folder / source)
            alias.symlink_to(folder / "between")
        said = refuse(line(case, case.out, "--force"), monkeypatch, capsys)
        assert "is one of the files that are read" in said
        alias.unlink()
        (folder / "between").unlink(missing_ok=True)


@pytest.mark.parametrize("case", OF_FILES, ids=lambda case: case.typed)
def test_an_output_that_names_its_input_is_refused(
    folder: Path, case: Case, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for source in filter(None, case.inputs.values()):
        assert "is one of the files that are read" in refuse(line(case, source), monkeypatch, capsys)


@pytest.mark.parametrize("kind", ["pipe", "link to a pipe", "folder", "device"])
@pytest.mark.parametrize("case", OF_FILES, ids=lambda case: case.typed)
def test_only_regular_files_are_replaced(
    folder: Path, case: Case, kind: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = folder / case.out
    if kind == "folder":
        out.mkdir()
    elif kind == "device":  # a file that the system calls a device, as none may be touched here
        out.touch()
        real = write.file_mode
        monkeypatch.setattr(
            write, "file_mode", lambda path: stat.S_IFCHR | 0o666 if path.name == case.out else real(path)
        )
    else:
        pipe = out if kind == "pipe" else folder / "pipe"
        os.mkfifo(pipe)
        if pipe != out:
            out.symlink_to(pipe)
    said = refuse(line(case, case.out, "--force"), monkeypatch, capsys)
    assert ("it is a folder" if kind == "folder" else "only those are replaced") in said


@pytest.mark.parametrize("case", [case for case in ALL if case.written], ids=lambda case: case.typed)
def test_what_is_written_into_a_folder_replaces_regular_files_only(
    folder: Path, case: Case, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in case.written:
        os.mkfifo(folder / case.out / name)
        assert "only those are replaced" in refuse(line(case, case.out, "--force"), monkeypatch, capsys)
        (folder / case.out / name).unlink()


@pytest.mark.parametrize("kind", ["file", "pipe"])
@pytest.mark.parametrize("case", [case for case in ALL if case.out in FOLDERS], ids=lambda case: case.typed)
def test_a_folder_that_is_something_else_is_refused(
    folder: Path, case: Case, kind: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = folder / "else"
    out.touch() if kind == "file" else os.mkfifo(out)
    said = refuse(line(case, "else"), monkeypatch, capsys)
    assert "the name of a folder was expected" in said or "is there already and not empty" in said


@pytest.mark.parametrize("kind", ["file", "pipe", "link"])
def test_a_recorder_never_overwrites(
    folder: Path, kind: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (case,) = CASES["record"]
    out = folder / case.out
    if kind == "pipe":
        os.mkfifo(out)
    elif kind == "link":
        out.symlink_to(folder / "run.mcap")
    else:
        out.write_bytes(b"x")
    assert "exists already and is not overwritten" in refuse(line(case, case.out), monkeypatch, capsys)


FOREIGN = {
    "text": b"Dear diary, nothing here is a table\n",
    "zeros": bytes(100),
    "picture": b"\x89PNG\r\n\x1a\n,,,\xff\n",
    "latin": "Zür".encode("latin-1"),
}


@pytest.mark.parametrize("content", FOREIGN.values(), ids=FOREIGN.keys())
@pytest.mark.parametrize("case", [case for case in ALL if not case.never_overwrites], ids=lambda case: case.typed)
def test_a_file_of_another_kind_than_its_name_implies_is_kept_unless_force_is_given(
    folder: Path, case: Case, content: bytes, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in case.written or ((case.out,) if case in OF_FILES else ()):
        existing = folder / (f"{case.out}/{name}" if case.written else name)
        if existing.suffix == ".md" and content.startswith(b"Dear"):
            continue  # a page of text is of the kind that its suffix says
        if existing.suffix == ".csv" and b"," in content and content.startswith(b"Dear"):
            existing.write_bytes(content.replace(b",", b""))
        elif existing.suffix == ".png" and content.startswith(b"\x89PNG"):
            continue
        else:
            existing.write_bytes(content)
        assert "replace it with --force" in refuse(line(case, case.out), monkeypatch, capsys)
        assert write.check_output_file(existing, force=True) == existing
        existing.unlink()


def test_force_replaces_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "new.csv").write_bytes(bytes(100))
    monkeypatch.setattr(sys, "argv", shlex.split("reactorwatch export run.mcap -o new.csv --force"))
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    assert (folder / "new.csv").read_text().startswith("time_min,")
