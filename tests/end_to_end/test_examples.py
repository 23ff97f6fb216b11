"""The notebooks of `examples/` run, cell by cell, and hold no output of an earlier execution."""

import contextlib
import json
import shlex
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from tests.running import Command

from .pages import ROOT

NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))
NEEDS = {"own_data": ("pandas",)}
"""Libraries of the extra notebook that a notebook imports, besides matplotlib."""


def cells(path: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return found


def test_there_are_the_five_examples() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["fleet", "linear_models", "own_data", "reactor", "three_tanks"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_stored_without_output_and_begins_with_its_title(path: Path) -> None:
    assert "".join(cells(path)[0]["source"]).startswith("# ")
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in cells(path) if "outputs" in cell)


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=[pytest.mark.slow] if path.stem == "fleet" else [], id=path.stem) for path in NOTEBOOKS],
)
def test_every_cell_runs(path: Path, tmp_path: Path, called: Command) -> None:
    for library in ("matplotlib", *NEEDS.get(path.stem, ())):
        if find_spec(library) is None:
            pytest.skip(f"needs {library}, of the extra notebook")
    names: dict[str, Any] = {"__name__": "notebook"}
    for number, cell in enumerate(cells(path)):
        if cell["cell_type"] != "code":
            continue
        commands = [line[1:] for line in "".join(cell["source"]).splitlines() if line.startswith("!")]
        program = "".join(line for line in cell["source"] if not line.startswith("!"))
        for command in commands:
            name, *arguments = shlex.split(command)
            assert name == "reactorwatch"
            done = called(*arguments, cwd=tmp_path)
            assert done.returncode == 0, done.stderr
        with contextlib.chdir(tmp_path):
            exec(compile(program, f"{path.name}, cell {number}", "exec"), names)
    check = CHECKS.get(path.stem)
    assert check is None or eval(check, names), check


CHECKS = {
    "reactor": "found.causes[0].cause == 'coolant_flow' and after.rmse['T'].value < 0.31 < before.rmse['T'].value",
    "linear_models": "best.fit.free_run > 70 and simulated.rmse['T'].value < 0.31",
    "three_tanks": "found.verdict == 'named' and found.causes[0].cause == 'clog13'",
    "own_data": "result.alarms and abs(model.b[0] / (1 - model.a[0]) + 25) < 2",
    "fleet": "[item.causes[0].cause[:4] for item in found.values()] == ['cool', 'heat', 'conc']",
}
"""The end of each notebook: the numbers that its text states."""
