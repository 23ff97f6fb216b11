"""A site that each test has for itself."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from .site import Site


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with closing(Site(tmp_path / "site")) as opened:
        yield opened
