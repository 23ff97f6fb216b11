"""Losses counted by sequence numbers."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from recorder.samples import MAX_GAPS, SequenceCounter


def counted(sequences: list[int]) -> tuple[int, int, int]:
    """(lost, duplicated, out of order) of samples of one publisher: a number's sample time grows with it."""
    check = SequenceCounter()
    for sequence in sequences:
        check.update(sequence, sequence * 100)
    return check.lost, check.duplicated, check.out_of_order


@pytest.mark.parametrize(
    ("sequences", "lost", "duplicated", "out_of_order"),
    [
        ([0, 1, 2], 0, 0, 0),
        ([7, 8, 9], 0, 0, 0),  # nobody listened before 7
        ([0, 1, 4], 2, 0, 0),
        ([0, 1, 1, 2], 0, 1, 0),
        ([0, 2, 1, 3], 0, 0, 1),
        ([0, 5, 3, 3, 6], 3, 1, 1),
        ([0, 5, 1, 2, 3, 4, 6], 0, 0, 4),
        ([3, 1, 4], 0, 1, 0),  # from before the first one seen
        ([0, 2**64 - 1], 2**64 - 2, 0, 0),
    ],
)
def test_counts(sequences: list[int], lost: int, duplicated: int, out_of_order: int) -> None:
    assert counted(sequences) == (lost, duplicated, out_of_order)


def test_a_restarted_publisher_loses_only_what_its_new_run_skipped() -> None:
    check = SequenceCounter()
    for sequence, time_ns in ((0, 0), (1, 100), (2, 200), (0, 1000), (1, 1100), (4, 1400)):
        check.update(sequence, time_ns)
    assert (check.lost, check.duplicated, check.out_of_order) == (2, 0, 0)


@given(st.permutations(range(30)), st.integers(0, 30))
def test_what_came_at_last_is_not_lost_in_whatever_order_it_came(order: list[int], taken: int) -> None:
    """Between the first and the highest number seen, what never came is lost, and nothing else."""
    sequences = [0, *(number + 1 for number in order[:taken])]
    lost, duplicated, out_of_order = counted(sequences)
    highest = [max(sequences[: place + 1]) for place in range(len(sequences))]
    assert lost == max(sequences) + 1 - len(sequences)
    assert duplicated == 0
    assert out_of_order == sum(now < top for now, top in zip(sequences, highest, strict=True))


def test_the_memory_of_gaps_is_bounded() -> None:
    skipping = list(range(0, 8 * MAX_GAPS, 2))
    lost, duplicated, out_of_order = counted([*skipping, 1, skipping[-1] - 1])
    assert (lost, duplicated, out_of_order) == (len(skipping) - 2, 1, 1)
