"""`monitor` refuses an impossible fleet in one line with exit code 2, before it waits for a router."""

import sys
from pathlib import Path

import pytest

from reactorwatch.cli.main import main

NOT_PLANTS = "plants must be reactor/ and a name with or without '*'"
NO_SHARD = "shard must be like 2/5, the second of five"


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
