"""Fixtures of each test: a site, a router, a log."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import structlog

from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.http_pages import free_endpoint

from .site import Site


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with closing(Site(tmp_path / "site")) as opened:
        yield opened


@pytest.fixture
def plain_log() -> None:
    """An earlier test may have sent the log to a stream that is closed by now."""
    structlog.reset_defaults()


@pytest.fixture
def bus_config() -> Iterator[BusConfig]:
    """A router of its own for each test."""
    config = BusConfig(endpoint=free_endpoint())
    router = bus_zenoh.router(config)
    yield config
    router.close()
