"""Fixtures shared by the tests of several parts."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest
import structlog

from tests.running import Command

ROOT = Path(__file__).parents[1]
WAITING = ("end_to_end", "integration")
"""Folders of tests that wait for processes to start, or for as long as a cut lasts, half of the time."""

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command does: the last bits depend on it

# a test says nothing of speed, and one that fails must fail again
hypothesis.settings.register_profile("reactorwatch", deadline=None, derandomize=True)
hypothesis.settings.load_profile("reactorwatch")


def pytest_xdist_auto_num_workers() -> int:
    """One more than there are cores, as some tests wait."""
    return len(os.sched_getaffinity(0)) + 1


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mix the files that wait among those that compute, so that no core is idle; the last quarter computes.

    Workers take the files in this order. Where there is one process, the order stays that of the folders.
    """
    if not hasattr(config, "workerinput"):
        return
    files = dict.fromkeys(item.path for item in items)
    waiting = [path for path in files if path.parent.name in WAITING]
    computing = [path for path in files if path.parent.name not in WAITING]
    position = {path: 0.75 * number / len(waiting) for number, path in enumerate(waiting)}
    position |= {path: number / len(computing) for number, path in enumerate(computing)}
    items.sort(key=lambda item: position[item.path])


@pytest.fixture(scope="session")
def daisy_csv() -> Path:
    """The measured record "CSTR" of the DaISy database, which is not part of this repository."""
    shared = Path(os.environ.get("REACTORWATCH_SHARED", ROOT.parent / "shared"))
    path = shared / "data" / "daisy_cstr.csv"
    if not path.is_file():
        pytest.skip(f"the DaISy record is not at {path}; name its folder's parent in REACTORWATCH_SHARED")
    return path


@pytest.fixture(scope="session")
def given_data() -> Path:
    """Folder of measured records of other rigs and benchmarks, which are not part of this repository."""
    folder = Path(os.environ.get("REACTORWATCH_SHARED", ROOT.parent / "shared")) / "data"
    if not (folder / "tep").is_dir():
        pytest.skip(f"the given sets are not in {folder}; name its parent in REACTORWATCH_SHARED")
    return folder


@pytest.fixture
def called(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    """Run `reactorwatch` with arguments to its end within this process: to start another one takes a second."""
    from reactorwatch.cli.main import main

    def run(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
        words = ["reactorwatch", *map(str, arguments)]
        monkeypatch.setattr(sys, "argv", words)
        capsys.readouterr()
        with contextlib.chdir(cwd or Path.cwd()), pytest.raises(SystemExit) as ended:
            main()
        assert isinstance(ended.value.code, int)
        return subprocess.CompletedProcess(words, ended.value.code, *capsys.readouterr())

    return run


@pytest.fixture(autouse=True)
def _log_as_before() -> Iterator[None]:
    """What one test configures of the log, which holds on to that test's standard error, is not left to the next."""
    yield
    structlog.reset_defaults()
