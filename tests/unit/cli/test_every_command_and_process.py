"""Every command takes a process in every form: by name, of an installed package, in TOML, in Python, and extended."""

import importlib
import json
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from reactorwatch.api.diagnosis import Case
from reactorwatch.cli.main import app
from reactorwatch.cli.processes import Processes
from reactorwatch.description.process import Process, describe_model
from reactorwatch.description.read import find_process
from reactorwatch.errors import InputError
from reactorwatch.process.library.cascaded_tanks import tanks
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import Record
from reactorwatch.records.write import write_table

DESCRIPTION = """
name = "rig"
equations = "cascaded_tanks"
[[signals]]
name = "u"
role = "input"
unit = "V"
[[signals]]
name = "x2"
role = "output"
unit = "V"
"""
CODE = """
import reactorwatch as rw
from reactorwatch.process.library.cascaded_tanks import tanks


def process():
    return rw.Process("rig", (rw.Signal("u", "V", "input"), rw.Signal("x2", "V", "output")), tanks())
"""
EXTENDED = {"format": "reactorwatch.model.v1", "model": "tanks", "effects": ["upper_leak:constant:0.01"]}
FORMS = {
    "name": "cascaded_tanks",
    "installed": "made_up_rig",
    "toml": "rig.toml",
    "python": "rig.py",
    "extended": "extended.json",
}

ENDLESS = (
    "plant_node.__main__.run",
    "monitor_node.__main__.run",
    "recorder.tools.replay.run_replay",
    "recorder.view.viewer.show",
    "reactorwatch.cli.status.run",
    "reactorwatch.cli.processes.Processes.start",
)
"""Functions that run nodes, or show them, until they are stopped."""

SLOW = (
    "reactorwatch.cli.backtest.run",
    "reactorwatch.cli.diagnose.diagnose_case",
    "reactorwatch.diagnosis.identifiability.identifiability",
)
"""Functions that take seconds, and get a process that is already loaded."""

LINES = (
    "import rig.csv --plant rig -o out.mcap",
    "export rig.mcap -o out.csv",
    "export rig.csv -o out.csv",
    "info rig.csv",
    "info rig.mcap",
    "backtest rig.csv",
    "backtest rig.mcap",
    "identify rig.csv --output x2",
    "linearise 2.0",
    "simulate rig.csv -o out.csv",
    "diagnose rig.csv -o out",
    "causes",
    "replay rig.mcap",
    "replay rig.csv",
    "plant",
    "monitor",
    "dashboard rig.csv -o out.rrd",
    "dashboard rig.mcap -o out.rrd",
    "view",
    "status",
    "up --out out",
    "up --record rig.csv --out out",
    "demo --out out",
)


class Started(Exception):  # noqa: N818 (no error)
    """A command got as far as a function of `ENDLESS` or `SLOW`, with this many processes."""


def processes_of(arguments: tuple[Any, ...]) -> Iterator[Process]:
    """Processes in what a node or a study is called with: as an object, or as its settings name it."""
    for item in arguments:
        if isinstance(item, Processes):
            for path in item._settings.values():
                tables = tomllib.loads(path.read_text(encoding="utf-8"))
                named = [tables[node] for node in ("plant", "monitor", "replay") if node in tables]
                yield from (find_process(table["process"]) for table in named)
        elif isinstance(item, Process):
            yield item
        elif isinstance(item, Case):
            yield item.process
        elif isinstance(item, ProcessModel):
            yield describe_model(item)
        elif isinstance(getattr(item, "process", None), str):
            yield find_process(item.process)


def start(*arguments: Any, **options: Any) -> NoReturn:
    found = list(processes_of((*arguments, *options.values())))
    assert {(process.inputs, process.outputs) for process in found} <= {(("u",), ("x2",))}
    raise Started(len(found))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A record of two tanks, its recording, the process in each form, and an installed package that provides it."""
    folder = tmp_path_factory.mktemp("rig")
    random = np.random.default_rng(1)
    time_min, u = np.arange(300) / 15, np.repeat(random.uniform(1.5, 2.5, 15), 20)
    level = Simulator(tanks()).run(time_min, u, np.array([4.0, 4.0])).outputs[:, 0]
    write_table(folder / "rig.csv", Record(time_min, {"u": u, "x2": level + random.normal(0.0, 0.01, level.size)}, ""))
    package = folder / "made_up-1.0.dist-info"
    package.mkdir()
    for path, text in (
        (folder / "rig.toml", DESCRIPTION),
        (folder / "rig.py", CODE),
        (folder / "extended.json", json.dumps(EXTENDED)),
        (folder / "made_up.py", CODE.replace('"rig"', '"made_up_rig"')),
        (folder / "wrong.toml", DESCRIPTION.replace('"input"', '"inptu"')),
        (folder / "wrong.py", "def process():\n    return 3\n"),
        (folder / "wrong.json", '{"format": "reactorwatch.model.v1"'),
        (package / "METADATA", "Metadata-Version: 2.1\nName: made-up\nVersion: 1.0\n"),
        (
            package / "entry_points.txt",
            "[reactorwatch.processes]\nmade_up_rig = made_up:process\nbroken_rig = made_up:missing\n",
        ),
    ):
        path.write_text(text, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(str(folder))
        importlib.invalidate_caches()
        run = CliRunner().invoke(
            app, ["import", "rig.csv", "--process", "rig.toml", "--plant", "rig", "-o", "rig.mcap"]
        )
        assert run.exit_code == 0, run.output
        yield folder


@pytest.fixture
def call(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], Result]:
    """Call a command with a process; nodes are not started, and outputs go to a folder of the test."""
    for name in (*ENDLESS, *SLOW):
        monkeypatch.setattr(name, start)

    def invoke(line: str, process: str) -> Result:
        words = [str(tmp_path / word) if word.startswith("out") else word for word in line.split()]
        return CliRunner().invoke(app, [*words, "--process", process])

    return invoke


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("line", LINES)
def test_every_command_takes_a_process_in_every_form(call: Callable[[str, str], Result], line: str, form: str) -> None:
    run = call(line, FORMS[form])
    is_started = isinstance(run.exception, Started) and run.exception.args[0] > 0
    assert is_started or (run.exit_code == 0 and run.exception is None), (run.output, run.exception)


WRONG = {
    "cascaded_tank": "unknown process 'cascaded_tank'; did you mean 'cascaded_tanks'?",
    "none.toml": "none.toml: there is no such file",
    "wrong.toml": "process file wrong.toml: signal 'u': role must be one of input, output, setpoint, mode, label",
    "wrong.py": "process file wrong.py: process(): must return a reactorwatch Process, got int",
    "wrong.json": "process file wrong.json: ",
    "broken_rig": "process 'broken_rig' of made_up:missing: AttributeError: ",
}
"""Processes, and what is wrong with them."""


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("line", LINES)
def test_every_command_refuses_a_wrong_process_before_anything_is_written(
    call: Callable[[str, str], Result], folder: Path, tmp_path: Path, line: str, wrong: str
) -> None:
    run = call(line, wrong)
    assert isinstance(run.exception, InputError), (run.output, run.exception)
    assert str(run.exception).startswith(WRONG[wrong])
    assert "\n" not in str(run.exception)
    assert list(tmp_path.iterdir()) == []
