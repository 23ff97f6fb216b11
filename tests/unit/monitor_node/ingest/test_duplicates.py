"""A resumed monitor takes each sample of its plant's history that it had not processed, and no other.

The filter of samples that were processed before a restart.
"""

from copy import deepcopy

import pytest

from monitor_node.ingest.alignment import Aligner, AlignmentMemory, ReplayFilter

PERIOD = 100
SIGNALS = ("C", "T")
C, T = range(2)


def stored(rows: int, *, without: tuple[tuple[str, int], ...] = ()) -> AlignmentMemory:
    """Memory after rows of which some samples are missing."""
    aligner = Aligner(SIGNALS, 2)
    for number in range(rows):
        for signal in SIGNALS:
            if (signal, number) not in without:
                aligner.update(signal, number * PERIOD, number, 0.0)
    return deepcopy(aligner.memory)


def test_samples_of_the_stored_state_are_duplicates_and_those_after_it_are_not() -> None:
    found = ReplayFilter(stored(30))
    assert [found.is_duplicate(T, row * PERIOD, row) for row in range(40)] == [True] * 30 + [False] * 10


def test_a_filter_has_begun_with_the_first_sample() -> None:
    found = ReplayFilter(stored(3))
    assert not found.has_begun
    found.is_duplicate(T, 0, 0)
    assert found.has_begun


def test_a_monitor_without_samples_has_processed_none() -> None:
    found = ReplayFilter(stored(0))
    assert not found.is_duplicate(T, 0, 0)


def test_a_sample_that_is_missing_in_its_row_was_not_processed() -> None:
    found = ReplayFilter(stored(30, without=(("T", 27),)))
    assert [found.is_duplicate(T, row * PERIOD, row) for row in (26, 27, 28)] == [True, False, True]
    assert [found.is_duplicate(C, row * PERIOD, row) for row in (26, 27, 28)] == [True, True, True]


def test_a_sample_of_a_pending_row_is_a_duplicate_where_it_arrived() -> None:
    found = ReplayFilter(stored(30, without=(("T", 29),)))
    assert found.is_duplicate(C, 29 * PERIOD, 29)
    assert not found.is_duplicate(T, 29 * PERIOD, 29)


@pytest.mark.parametrize(
    ("row", "number", "is_duplicate"),
    [(3, 3, True), (30, 3, False), (3, 30, False)],
    ids=["old", "old number at a new time", "new number at an old time"],
)
def test_a_row_older_than_those_of_the_state_was_processed_if_number_and_time_are_old(
    row: int, number: int, is_duplicate: bool
) -> None:
    assert ReplayFilter(stored(30)).is_duplicate(T, row * PERIOD, number) is is_duplicate


def test_the_sample_after_the_newest_ends_the_filter_of_its_signal_and_of_no_other() -> None:
    found = ReplayFilter(stored(30))
    assert not found.is_duplicate(T, 30 * PERIOD, 30)
    assert not found.is_duplicate(T, 29 * PERIOD, 29)
    assert found.is_duplicate(C, 29 * PERIOD, 29)


def test_a_sample_farther_on_may_come_before_the_history_and_does_not_end_the_filter() -> None:
    found = ReplayFilter(stored(30))
    assert not found.is_duplicate(T, 31 * PERIOD, 31)
    assert found.is_duplicate(T, 29 * PERIOD, 29)


def test_another_number_at_the_time_of_a_row_is_of_a_plant_that_was_restarted_and_ends_the_filter() -> None:
    found = ReplayFilter(stored(30))
    assert not found.is_duplicate(T, 25 * PERIOD, 2)
    assert not found.is_duplicate(T, 26 * PERIOD, 26)
    assert found.is_duplicate(C, 26 * PERIOD, 26)


def test_the_filter_keeps_its_place_while_the_alignment_continues() -> None:
    memory = stored(30)
    found = ReplayFilter(memory)
    memory.sequences[T].advance(500, 500 * PERIOD)
    memory.emitted[29 * PERIOD][T] = None
    assert found.is_duplicate(T, 29 * PERIOD, 29)
    assert not found.is_duplicate(T, 400 * PERIOD, 400)


def test_the_filter_is_over_once_each_signal_has_passed_what_the_state_has() -> None:
    aligner = Aligner(("qc", "T"), 5)
    for number in range(3):
        for signal in ("qc", "T"):
            aligner.update(signal, 100 * number, number, 1.0)
    replay_filter = ReplayFilter(aligner.memory)
    assert all(replay_filter.is_duplicate(index, 100 * number, number) for number in range(3) for index in range(2))
    assert not any(replay_filter.is_duplicate(0, 100 * number, number) for number in (3, 4))
    assert not replay_filter.is_over  # T may still be repeated
    assert replay_filter.is_duplicate(1, 200, 2)
    assert not any(replay_filter.is_duplicate(1, 100 * number, number) for number in (3, 4))
    assert replay_filter.is_over
