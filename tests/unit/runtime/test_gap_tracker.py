"""A gap tracker knows which numbers of a stream are missing, whatever the order in which they arrive."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from reactorwatch.runtime.gap_tracker import GapTracker


class Remembering(GapTracker):
    """A tracker that remembers its gaps."""

    max_gaps = 1000


@given(st.lists(st.integers(0, 60), min_size=1))
def test_the_gaps_are_the_numbers_that_never_arrived_between_the_first_and_the_highest(numbers: list[int]) -> None:
    tracker, filled = Remembering(), 0
    skipped = 0
    for number in numbers:
        if tracker.expected is None or number >= tracker.expected:
            skipped += tracker.advance(number)
        else:
            filled += tracker.fill(number)
    missing = [number for first, last in tracker.gaps for number in range(first, last + 1)]
    assert missing == [number for number in range(numbers[0], max(numbers)) if number not in numbers]
    assert len(missing) == skipped - filled


def test_the_oldest_gaps_are_forgotten_and_a_tracker_without_a_memory_keeps_none() -> None:
    tracker, plain = Remembering(), GapTracker()
    for number in range(0, 4 * Remembering.max_gaps, 2):
        assert tracker.advance(number) == plain.advance(number) == (number > 0)
    assert (len(tracker.gaps), tracker.gaps[0]) == (Remembering.max_gaps, (1999, 1999))
    assert plain.gaps == []


@pytest.mark.parametrize(
    ("number", "time_ns", "is_next", "is_past"),
    [
        (8, 101, True, False),
        (8, 100, False, False),  # not later than the newest
        (9, 101, False, False),
        (7, 100, False, True),
        (3, 50, False, True),
        (3, 101, False, False),  # an old number at a new time: the publisher was restarted
    ],
)
def test_a_number_is_next_or_past_by_its_time_as_well(number: int, time_ns: int, is_next: bool, is_past: bool) -> None:
    tracker = GapTracker(8, 100)
    assert tracker.is_past(number, time_ns) == is_past
    assert tracker.accept_next(number, time_ns) == is_next
    assert (tracker.expected, tracker.newest_ns) == ((9, 101) if is_next else (8, 100))


def test_nothing_is_past_or_next_before_the_first_number() -> None:
    tracker = GapTracker()
    assert not tracker.is_past(0, 0)
    assert not tracker.accept_next(0, 1)
    assert tracker.newest is None
