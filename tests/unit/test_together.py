"""The files whose tests one worker has are there."""

from pathlib import Path

from tests.together import PIECES

ROOT = Path(__file__).parents[2]


def test_each_of_the_files_is_there() -> None:
    assert {path for path in PIECES if not (ROOT / path).is_file()} == set()
