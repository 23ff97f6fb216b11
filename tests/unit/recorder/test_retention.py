"""Retention: the recordings that are deleted."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from recorder.keep import CompleteRecording, Limits, select_deletions

FILES = [CompleteRecording(Path(f"{name}.mcap"), 100, at) for name, at in (("c", 30), ("a", 10), ("b", 20))]


@pytest.mark.parametrize(
    ("limits", "gone"),
    [
        (Limits(), []),
        (Limits(files=4), []),
        (Limits(files=3), ["a"]),
        (Limits(files=1), ["a", "b", "c"]),
        (Limits(size_bytes=350), []),
        (Limits(size_bytes=349), ["a"]),
        (Limits(size_bytes=10), ["a", "b", "c"]),
        (Limits(age_ns=30), []),
        (Limits(age_ns=25), ["a"]),
        (Limits(age_ns=15, files=3), ["a", "b"]),
    ],
)
def test_the_oldest_go_until_the_rest_and_the_file_being_written_are_within_limits(
    limits: Limits, gone: list[str]
) -> None:
    assert [path.stem for path in select_deletions(FILES, 50, limits, now_ns=40)] == gone


def test_when_no_file_is_being_written_none_goes_for_it() -> None:
    assert select_deletions(FILES, None, Limits(files=3, size_bytes=300), 40) == []
    assert [path.stem for path in select_deletions(FILES, None, Limits(files=2), 40)] == ["a"]


def test_the_last_recording_stays_however_large_it_is_and_goes_with_its_age() -> None:
    assert [path.stem for path in select_deletions(FILES, None, Limits(size_bytes=10), 40)] == ["a", "b"]
    assert [path.stem for path in select_deletions(FILES, None, Limits(age_ns=5), 40)] == ["a", "b", "c"]


def test_what_a_black_box_still_needs_stays() -> None:
    assert [path.stem for path in select_deletions(FILES, 50, Limits(files=1), 40, protected_since_ns=20)] == ["a"]


@given(
    ends=st.lists(st.integers(0, 100), max_size=8),
    sizes=st.lists(st.integers(0, 100), min_size=8, max_size=8),
    files=st.integers(1, 9),
    size=st.integers(0, 500),
)
def test_no_more_goes_than_has_to(ends: list[int], sizes: list[int], files: int, size: int) -> None:
    found = [CompleteRecording(Path(str(n)), sizes[n], end) for n, end in enumerate(ends)]
    gone = select_deletions(found, 0, Limits(size_bytes=size, files=files), 100)
    left = [item for item in found if item.path not in gone]
    assert len(left) + 1 <= files or not left
    assert sum(item.size_bytes for item in left) <= size or not left
    if gone:  # with the last of them back, it would be too much
        (back,) = (item for item in found if item.path == gone[-1])
        assert len(left) + 2 > files or sum(item.size_bytes for item in left) + back.size_bytes > size
