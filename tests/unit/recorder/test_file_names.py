"""Names of recordings."""

from datetime import UTC, datetime
from pathlib import Path

import pytest

from recorder.keep import FileNames

NOON = datetime(2026, 7, 1, 12, 0, 5, tzinfo=UTC)
NOON_NS = round(NOON.timestamp()) * 10**9


def test_in_a_folder_they_have_the_plant_s_name_and_the_moment() -> None:
    names = FileNames.of(Path("out"), "R-101", is_folder=True)
    assert names.first(NOON) == Path("out/R-101-20260701T120005Z.mcap")
    there = ["R-101-20260701T120005Z.mcap", "R-101-20260701T120005Z-2.mcap", "R-101-20260701T120004Z-7.mcap"]
    assert names.next(NOON_NS, there) == Path("out/R-101-20260701T120005Z-3.mcap")


def test_with_a_name_they_are_counted() -> None:
    names = FileNames.of(Path("out/run.mcap"), "R-101", is_folder=False)
    there: list[str] = []
    for _ in range(3):
        there.append(names.next(NOON_NS, there).name)
    assert there == ["run.mcap", "run-2.mcap", "run-3.mcap"]


def test_the_name_of_one_that_was_deleted_is_not_given_again() -> None:
    names = FileNames.of(Path("out/run.mcap"), "R-101", is_folder=False)
    assert names.next(NOON_NS, ["run-9.mcap", "run-10.mcap", "mine.mcap"]).name == "run-11.mcap"


def test_a_folder_whose_name_ends_like_a_recording_is_a_folder() -> None:
    assert FileNames.of(Path("run.mcap"), "R", is_folder=True).folder == Path("run.mcap")


@pytest.mark.parametrize(
    ("out", "name", "own"),
    [
        ("out", "cstr-20260701T120005Z.mcap", True),
        ("out", "cstr-20260701T120005Z-12.mcap", True),
        ("out", "cstr-2-20260701T120005Z.mcap", False),
        ("out", "cstr-20260701T120005Z-recovered.mcap", False),
        ("out", "cstr.mcap", False),
        ("run.mcap", "run.mcap", True),
        ("run.mcap", "run-2.mcap", True),
        ("run.mcap", "run-two.mcap", False),
        ("run.mcap", "rerun.mcap", False),
        ("run.mcap", "run.mcap.part", False),
        ("r.n.mcap", "run.mcap", False),
    ],
)
def test_no_foreign_file_is_taken_for_its_own(out: str, name: str, own: bool) -> None:
    assert FileNames.of(Path(out), "cstr", is_folder=False).owns(name) is own
