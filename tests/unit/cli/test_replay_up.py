"""`replay FILE --up` brings the nodes that it needs, as `up --record FILE` does."""

import shlex
import sys
from pathlib import Path
from typing import Any

import pytest

from reactorwatch.cli import up
from reactorwatch.cli.main import main


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
