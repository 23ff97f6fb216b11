"""What tests of several parts share."""

import os
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest
import structlog

ROOT = Path(__file__).parents[1]

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command does: the last bits depend on it

# a test says nothing of speed, and one that fails must fail again
hypothesis.settings.register_profile("reactorwatch", deadline=None, derandomize=True)
hypothesis.settings.load_profile("reactorwatch")


def pytest_xdist_auto_num_workers() -> int:
    """One more than there are cores: half of the time tests wait, for processes to start or for what a cut lasts."""
    return len(os.sched_getaffinity(0)) + 1


def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """Some files whole, all other tests one by one; see there."""
    from tests.together import scheduling

    return scheduling(config, log) if config.getvalue("dist") == "loadgroup" else None


@pytest.fixture(scope="session")
def daisy_csv() -> Path:
    """The measured record "CSTR" of the DaISy database, which is not part of this repository."""
    shared = Path(os.environ.get("REACTORWATCH_SHARED", ROOT.parent / "shared"))
    path = shared / "data" / "daisy_cstr.csv"
    if not path.is_file():
        pytest.skip(f"the DaISy record is not at {path}; name its folder's parent in REACTORWATCH_SHARED")
    return path


@pytest.fixture(autouse=True)
def _log_as_before() -> Iterator[None]:
    """What one test configures of the log, which holds on to that test's standard error, is not left to the next."""
    yield
    structlog.reset_defaults()
