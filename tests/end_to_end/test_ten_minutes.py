"""The first ten minutes: in a clean clone, the commands of the page name the cause in a reader's own file."""

import filecmp
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from .conftest import COMMAND_WITHIN_S
from .given import Files
from .pages import ROOT, Block, blocks

MOST_COMMANDS = 5
"""The clone included."""
PAGE = Path("docs/getting-started.md")


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Clone of the last commit, with the compiled kernels of this tree in place of those that `make setup` compiles."""
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("needs git and the repository")
    folder = tmp_path_factory.mktemp("clean") / "clone"
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(folder)], check=True)
    for kernel in [*ROOT.glob("*/**/*.nbi"), *ROOT.glob("*/**/*.nbc")]:
        source = kernel.relative_to(ROOT).parents[1]
        if (folder / source).is_dir():
            (folder / source / "__pycache__").mkdir(exist_ok=True)
            shutil.copy2(kernel, folder / kernel.relative_to(ROOT))
    for copy in folder.rglob("*.py"):  # numba goes by the time and the size of a source
        original = ROOT / copy.relative_to(folder)
        if original.is_file() and filecmp.cmp(original, copy, shallow=False):
            shutil.copystat(original, copy)
    return folder


def first_block(clone: Path) -> Block:
    """The page's first block of commands."""
    return next(block for block in blocks((clone / PAGE).read_text(encoding="utf-8")) if block.kind == "commands")


def run(clone: Path, command: str) -> str:
    """Run a line of the page in the clone, with the interpreter and the packages of this test."""
    program, *arguments = shlex.split(command)
    started = {
        "make": ["make", "--dry-run", *arguments],  # setting up installs packages
        ".venv/bin/reactorwatch": [sys.executable, "-m", "reactorwatch", *arguments],
    }[program]
    environment = {**os.environ, "PYTHONPATH": str(clone)}
    done = subprocess.run(
        started, cwd=clone, env=environment, capture_output=True, text=True, check=False, timeout=COMMAND_WITHIN_S
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    return done.stdout


def test_from_a_clean_clone_to_a_named_cause_in_a_reader_s_own_file(
    clone: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    block = first_block(clone)
    assert len(block.commands) + 1 <= MOST_COMMANDS
    given = Files(tmp_path_factory.mktemp("given"))
    given.give(block.clauses["given"], clone)
    header = (clone / block.clauses["given"]).read_text(encoding="utf-8").split("\n", 1)[0]
    assert header != "time_min,qc,C,T", "the columns have the reader's names"
    set_up, alarms, cause = (run(clone, command) for command in block.commands)
    assert "python -m reactorwatch.codegen" in set_up
    assert "Detected since 120 min: 15 % of the coolant lost (" in alarms
    assert "coolant leak" in cause
    assert (clone / "report" / "report.html").is_file()


def test_the_clone_runs_its_own_code(clone: Path) -> None:
    line = "import reactorwatch.cli.main as main; print(main.__file__)"
    environment = {**os.environ, "PYTHONPATH": str(clone)}
    found = subprocess.run(
        [sys.executable, "-c", line], cwd=clone, env=environment, capture_output=True, text=True, check=True
    )
    assert Path(found.stdout.strip()).is_relative_to(clone)
