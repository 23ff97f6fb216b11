"""A plant that only its columns describe is monitored live, too: by `up --record` and `monitor`."""

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from monitor_node.config import MonitorConfig
from reactorwatch.cli.main import app
from reactorwatch.cli.my_plant import describe_in_file
from reactorwatch.description.choice import ProcessChoice
from reactorwatch.description.find import find_process
from reactorwatch.errors import InputError


def test_columns_are_described_in_a_file_that_is_gone_after_the_run() -> None:
    choice = ProcessChoice(None, ("Heater 1", "Heater 2"), ("T 1", 'a "quoted" name'))
    with describe_in_file(choice) as named:
        assert named is not None
        assert find_process(named) == choice.load()
    assert not Path(named).exists()


@pytest.mark.parametrize("named", [None, "three_tanks"])
def test_a_process_that_has_a_name_needs_no_file(named: str | None) -> None:
    with describe_in_file(ProcessChoice(named)) as found:
        assert found == named


def test_columns_without_a_record_are_refused_with_the_cure() -> None:
    run = CliRunner().invoke(app, ["up", "--input", "q", "--output", "th"])
    assert isinstance(run.exception, InputError)
    assert "are for the record of --record; name it, or leave them out" in str(run.exception)


@pytest.mark.parametrize(("arguments", "inputs"), [(["--input", "q1,q2"], ("q1", "q2")), ([], ())])
def test_the_monitor_takes_its_signals_from_columns(
    monkeypatch: pytest.MonkeyPatch, arguments: list[str], inputs: tuple[str, ...]
) -> None:
    started: list[MonitorConfig] = []

    def start(config: MonitorConfig, *_: Any, **__: Any) -> None:
        started.append(config)

    monkeypatch.setattr("monitor_node.__main__.run", start)
    run = CliRunner().invoke(app, ["monitor", "--output", "th", "--output", "p", *arguments])
    assert run.exit_code == 0, run.exception
    assert [(config.inputs, config.outputs) for config in started] == [(inputs, ("th", "p"))]
