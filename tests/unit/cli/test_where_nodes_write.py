"""Paths and inputs of nodes without settings: defaults hold for any process, folders are made."""

from contextlib import nullcontext
from pathlib import Path

import pytest

from monitor_node.config import MonitorConfig
from reactorwatch.cli import up
from reactorwatch.cli.main import main
from reactorwatch.cli.option_groups import BusOptions
from reactorwatch.errors import InputError
from reactorwatch.runtime.config import BusConfig, section
from reactorwatch.runtime.event_loop import StopSignal
from recorder.__main__ import record
from recorder.config import RecorderConfig


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
