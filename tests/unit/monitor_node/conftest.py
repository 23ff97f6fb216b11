"""Runs of a fleet, which take long to make and are only read."""

import pytest

from reactorwatch.contract.codec import Encoded, Publication

from .fleets import alone, run_of
from .warm_plant import Run, watch_warm_plant


@pytest.fixture(scope="session")
def runs() -> dict[str, list[Encoded]]:
    """Three plants; one leaks."""
    return {"a": run_of("a", 1), "b": run_of("b", 2, leak_min=30.0), "c": run_of("c", 3)}


@pytest.fixture(scope="session")
def expected(runs: dict[str, list[Encoded]]) -> dict[str, list[Publication]]:
    return {plant: alone(plant, run) for plant, run in runs.items()}


@pytest.fixture(scope="session")
def warm() -> Run:
    return watch_warm_plant()
