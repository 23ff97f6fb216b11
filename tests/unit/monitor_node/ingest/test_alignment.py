"""Samples become rows, whatever happens to them on the way.

The sampling period is learned from the first rows; a row follows, or rows are missing before it.
"""

import math
import random

import numpy as np
import pytest

from monitor_node.ingest.alignment import (
    LEARN_FROM,
    Aligner,
    Row,
    SamplingPeriod,
    missing_in_intervals,
    regular_intervals,
)

SIGNALS = ("qc", "C", "T")
PERIOD = 100


def feed(aligner: Aligner, samples: list[tuple[str, int]]) -> list[Row]:
    """Samples as (signal, row number); the value tells where it came from, the sequence is the row number."""
    rows: list[Row] = []
    for signal, number in samples:
        rows += aligner.update(signal, number * PERIOD, number, number + SIGNALS.index(signal) / 10)
    return rows


def feed_new_run(aligner: Aligner, begin_ns: int, first: int) -> list[Row]:
    """Three rows of a run that begins at a time, and with a number."""
    return [
        row for number in range(3) for signal in SIGNALS
        for row in aligner.update(signal, begin_ns + number * PERIOD, first + number, 1.0)
    ]  # fmt: skip


def in_order(count: int) -> list[tuple[str, int]]:
    return [(signal, number) for number in range(count) for signal in SIGNALS]


def numbers(rows: list[Row]) -> list[int]:
    return [row.time_ns // PERIOD for row in rows]


def test_samples_in_order_give_every_row_at_its_last_sample() -> None:
    aligner = Aligner(SIGNALS, 4)
    assert feed(aligner, in_order(1)[:2]) == []
    rows = feed(aligner, in_order(10)[2:])
    assert numbers(rows) == list(range(10))
    assert rows[3].values == (3.0, 3.1, 3.2)
    assert [row.restarted for row in rows] == [True] + [False] * 9


def test_any_order_within_the_reordering_gives_the_same_rows() -> None:
    order, samples = random.Random(2), in_order(1)
    for start in range(3, 600, 6):
        part = in_order(200)[start : start + 6]
        order.shuffle(part)
        samples += part
    aligner = Aligner(SIGNALS, 4)
    rows = feed(aligner, samples) + aligner.flush()
    expected = feed(Aligner(SIGNALS, 4), in_order(200))
    assert [row[:2] for row in rows] == [row[:2] for row in expected]
    counts = aligner.memory.counts
    assert counts.lost == counts.late == counts.duplicated == counts.incomplete_rows == 0
    assert counts.out_of_order > 0


def test_a_missing_sample_is_waited_for_and_then_given_up() -> None:
    aligner = Aligner(SIGNALS, 3)
    samples = [item for item in in_order(6) if item != ("T", 2)]
    rows = feed(aligner, samples)
    assert numbers(rows) == list(range(6))
    assert math.isnan(rows[2].values[2])
    assert rows[2].values[:2] == (2.0, 2.1)
    assert aligner.memory.counts.incomplete_rows == 1
    assert aligner.memory.counts.lost == 1


def test_a_row_waits_no_longer_than_the_reordering() -> None:
    aligner = Aligner(SIGNALS, 3)
    rows = feed(aligner, [item for item in in_order(5) if item != ("T", 2)])
    assert numbers(rows) == [0, 1]
    assert numbers(feed(aligner, [("qc", 5)])) == [2, 3, 4]


@pytest.mark.parametrize(("awaits_all", "delay_rows"), [(False, 1), (True, 3)])
def test_a_row_without_a_value_of_the_laboratory_waits_for_one_newer_row(*, awaits_all: bool, delay_rows: int) -> None:
    """C has a value in every fifth row; what is learned of it is in the rows emitted last."""
    aligner, delays = Aligner(SIGNALS, 3, awaits_all=awaits_all), []
    for number in range(100):
        for signal in ("qc", "C", "T") if number % 5 == 0 else ("qc", "T"):
            rows = aligner.update(signal, number * PERIOD, number // 5 if signal == "C" else number, 1.0)
            delays += [number - row.time_ns // PERIOD for row in rows]
    assert max(delays[40:]) == delay_rows
    assert aligner.memory.counts.late == aligner.memory.counts.lost == 0


def test_a_signal_that_comes_late_after_a_pause_is_awaited_again() -> None:
    """C pauses for 40 rows and then comes two rows late, within the reordering of three."""
    aligner, rows = Aligner(SIGNALS, 3), []
    for number in range(120):
        samples = [("qc", number, number), ("T", number, number)]
        if number < 40:
            samples.append(("C", number, number))
        elif number >= 82:
            samples.append(("C", number - 2, number - 42))
        for signal, at, sequence in samples:
            rows += aligner.update(signal, at * PERIOD, sequence, 1.0)
    values = {row.time_ns // PERIOD: row.values[SIGNALS.index("C")] for row in rows}
    assert [number for number in range(100, 115) if math.isnan(values[number])] == []


def test_a_row_that_is_lost_altogether_holds_the_others_up_no_longer() -> None:
    aligner = Aligner(SIGNALS, 3)
    rows = feed(aligner, [item for item in in_order(5) if item[1] != 2])
    assert numbers(rows) == [0, 1]
    assert numbers(feed(aligner, [(signal, 5) for signal in SIGNALS] + [(signal, 6) for signal in SIGNALS])) == [
        3,
        4,
        5,
        6,
    ]
    assert aligner.memory.counts.incomplete_rows == 0
    assert aligner.memory.counts.lost == 3


def test_rows_apart_in_time_are_not_waited_between() -> None:
    """A gap in time without a gap in the numbers is the publisher's own."""
    aligner = Aligner(SIGNALS, 3)
    rows = [
        row for number in range(4) for signal in SIGNALS for row in aligner.update(signal, number**2 * 900, number, 0.0)
    ]
    assert len(rows) == 4


def test_a_sample_of_a_row_that_has_left_is_late_and_changes_nothing() -> None:
    aligner = Aligner(SIGNALS, 2)
    feed(aligner, [item for item in in_order(8) if item != ("C", 3)])
    assert feed(aligner, [("C", 3)]) == []
    assert aligner.memory.counts.late == 1
    assert aligner.memory.counts.lost == 0  # it was late, not lost
    assert numbers(feed(aligner, [(signal, 8) for signal in SIGNALS])) == [8]


@pytest.mark.parametrize("when", [1, 5])
def test_the_same_sample_twice_is_a_duplicate_before_and_after_its_row_left(when: int) -> None:
    aligner = Aligner(SIGNALS, 4)
    samples = in_order(2)
    samples.insert(when, samples[when - 1])
    rows = feed(aligner, samples)
    assert numbers(rows) == [0, 1]
    assert aligner.memory.counts.duplicated == 1
    assert aligner.memory.counts.lost == 0


def test_a_publisher_that_begins_again_begins_a_new_run() -> None:
    aligner = Aligner(SIGNALS, 2)
    feed(aligner, in_order(50))
    rows = feed_new_run(aligner, 10_000, 0)
    assert [row.time_ns for row in rows] == [10_000, 10_100, 10_200]
    assert rows[0].restarted
    assert not rows[1].restarted
    assert aligner.memory.counts.restarts == 1
    assert aligner.memory.counts.lost == 0


def test_memory_is_bounded_whatever_comes() -> None:
    aligner = Aligner(SIGNALS, 5)
    source = random.Random(3)
    for sequence in range(20_000):
        aligner.update("T", source.randrange(10**15), sequence, 1.0)
        assert len(aligner.memory.pending) <= 5 + 1
        assert len(aligner.memory.emitted) <= 4 * 5


def test_a_reordering_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match=r"reorder_rows must be at least 1, got 0"):
        Aligner(SIGNALS, 0)


def test_the_end_of_a_record_gives_the_pending_rows_in_the_order_of_time() -> None:
    aligner = Aligner(SIGNALS, 8)
    feed(aligner, [*in_order(1), ("qc", 3), ("qc", 1), ("qc", 2)])
    assert numbers(aligner.flush()) == [1, 2, 3]
    assert aligner.flush() == []


def test_a_row_is_never_ahead_of_an_older_one_that_is_pending() -> None:
    """T is published in every second row, so the next T is no evidence that the row before it is complete."""
    aligner, rows = Aligner(SIGNALS, 3), list[Row]()
    for number in range(20):
        for signal in SIGNALS[: 2 + (number + 1) % 2]:
            sequence = number // 2 if signal == "T" else number
            rows += aligner.update(signal, number * PERIOD, sequence, 0.0)
    rows += aligner.flush()
    assert numbers(rows) == list(range(20))
    assert aligner.memory.counts.incomplete_rows == 10


def test_after_an_incomplete_row_a_row_that_is_lost_is_waited_for() -> None:
    """The number that is missing in a row is the one after that of the row before."""
    aligner = Aligner(SIGNALS, 2)
    before = [("qc", 1), ("C", 1), ("qc", 2), ("qc", 3)]
    assert numbers(feed(aligner, [*in_order(1), *before])) == [0, 1]
    assert numbers(feed(aligner, [("C", 2), ("C", 3), ("T", 3)])) == []
    assert numbers(feed(aligner, [("T", 2)])) == [2, 3]
    again = Aligner(SIGNALS, 2)
    assert numbers(feed(again, [*in_order(1), ("qc", 1), ("C", 1), ("qc", 3), ("qc", 4)])) == [0, 1]
    assert numbers(feed(again, [("C", 3), ("T", 3)])) == []
    assert numbers(feed(again, [("qc", 2), ("C", 2), ("T", 2)])) == [2, 3]


def test_after_an_incomplete_row_behind_a_lost_one_the_next_row_is_ready_at_once() -> None:
    aligner = Aligner(SIGNALS, 2)
    rows = feed(aligner, [*in_order(1), ("qc", 2), ("C", 2), ("qc", 3), ("qc", 4)])
    assert numbers(rows) == [0, 2]
    assert numbers(feed(aligner, [("C", 3), ("T", 3)])) == [3]


def test_a_sample_of_the_incomplete_row_emitted_last_is_late() -> None:
    aligner = Aligner(SIGNALS, 1)
    assert numbers(feed(aligner, [*in_order(1), ("qc", 1), ("qc", 2)])) == [0, 1]
    assert feed(aligner, [("C", 1)]) == []
    assert aligner.memory.counts.late == 1
    assert numbers(feed(aligner, [("C", 2), ("T", 2)])) == [2]


def test_another_number_at_the_time_of_the_newest_sample_is_a_duplicate_and_no_restart() -> None:
    aligner = Aligner(SIGNALS, 2)
    feed(aligner, in_order(5))
    assert aligner.update("T", 4 * PERIOD, 5, 0.0) == []
    assert numbers(feed(aligner, [(signal, 5) for signal in SIGNALS])) == [5]
    counts = aligner.memory.counts
    assert (counts.restarts, counts.duplicated, counts.lost) == (0, 1, 0)


@pytest.mark.parametrize(("sequence", "restarts"), [(42, 0), (41, 1)])
def test_a_step_back_is_a_restart_if_it_is_more_than_four_times_the_reordering(sequence: int, restarts: int) -> None:
    aligner = Aligner(SIGNALS, 2)
    feed(aligner, in_order(50))
    aligner.update("T", sequence * PERIOD - 1, sequence, 0.0)
    assert aligner.memory.counts.restarts == restarts


@pytest.mark.parametrize(("first", "restarts"), [(0, 1), (1, 0), (2, 0)])
def test_a_small_step_back_at_a_later_time_is_a_restart_if_it_is_to_zero(first: int, restarts: int) -> None:
    aligner = Aligner(SIGNALS, 4)
    feed(aligner, in_order(3))
    rows = feed_new_run(aligner, 10 * PERIOD, first)
    assert numbers(rows + aligner.flush()) == [10, 11, 12]
    assert aligner.memory.counts.restarts == restarts
    assert aligner.memory.counts.lost == 0


def test_a_clock_that_is_set_back_starts_a_run_though_the_numbers_continue() -> None:
    aligner = Aligner(SIGNALS, 2)
    feed(aligner, in_order(50))
    rows = feed_new_run(aligner, 10 * PERIOD, 50)
    assert numbers(rows) == [10, 11, 12]
    assert [row.restarted for row in rows] == [True, False, False]
    assert aligner.memory.counts.restarts == 1


def test_numbers_that_are_used_again_at_later_times_are_in_order_by_their_times() -> None:
    aligner = Aligner(("T",), 4)
    for number in range(10):
        aligner.update("T", number * PERIOD, number, 0.0)
    for time, sequence in ((10, 5), (12, 7), (11, 6)):
        aligner.update("T", time * PERIOD, sequence, 0.0)
    assert aligner.memory.counts.out_of_order == 1
    assert aligner.memory.counts.restarts == 0


def test_a_sample_ahead_of_the_first_is_out_of_order_and_was_never_lost() -> None:
    aligner = Aligner(SIGNALS, 4)
    feed(aligner, [("qc", 1), ("qc", 0)])
    assert aligner.memory.counts.out_of_order == 1
    assert aligner.memory.counts.lost == 0


def test_the_count_of_lost_samples_fits_into_a_message_whatever_the_numbers_are() -> None:
    aligner = Aligner(SIGNALS, 4)
    for run in range(4):
        aligner.update("T", 2 * run * PERIOD, 0, 0.0)
        aligner.update("T", (2 * run + 1) * PERIOD, 2**62 - 1, 0.0)
        assert 2**62 - 2 <= aligner.memory.counts.lost < 2**63
    assert aligner.memory.counts.restarts == 3


PERIOD_NS = 6_000_000_000


def learned() -> SamplingPeriod:
    """A period that was learned from even rows; the last is at time 0."""
    sampling = SamplingPeriod()
    for row in range(-LEARN_FROM, 1):
        sampling.update(row * PERIOD_NS)
    return sampling


@pytest.mark.parametrize(
    ("periods", "follows", "is_gap", "missing"),
    [
        (1.0, True, False, 0),
        (1.09, True, False, 0),
        (1.1, True, False, 0),
        (0.9, True, False, 0),
        (1.11, False, False, 0),
        (0.2, False, False, 0),
        (1.75, False, False, 1),
        (2.0, False, False, 1),
        (2.25, False, False, 1),
        (2.26, False, False, 0),  # no whole number of periods
        (2.5, False, False, 0),
        (2.51, False, True, 0),
        (3.1, False, True, 2),
        (-1.0, False, True, 0),
        (0.0, False, True, 0),
    ],
)
def test_an_interval_follows_or_is_a_gap_by_its_length(
    periods: float, follows: bool, is_gap: bool, missing: int
) -> None:
    assert learned().update(round(periods * PERIOD_NS)) == (follows, is_gap, missing)


def test_the_first_row_follows_nothing_and_the_next_ones_the_shortest_interval_so_far() -> None:
    sampling = SamplingPeriod()
    assert sampling.period_ns == 0.0
    intervals = [sampling.update(time_ns) for time_ns in (0, 100, 200, 340, 490, 650, 950)]
    assert [item.follows for item in intervals] == [False, True, True, True, True, False, False]
    assert [item.is_gap for item in intervals] == [False, False, False, False, False, False, True]
    assert [item.missing for item in intervals] == [0] * 7
    assert sampling.period_ns == 100.0


def test_the_period_is_the_median_of_the_first_32_intervals() -> None:
    sampling, time_ns = SamplingPeriod(), 0
    sampling.update(time_ns)
    for number in range(40):
        time_ns += 100 + number
        sampling.update(time_ns)
        assert sampling.learned_ns == (None if number < 31 else 115.5)


def test_a_record_has_the_same_regular_and_missing_intervals_as_its_rows_one_by_one() -> None:
    """With the median of the record, which here is the one of the first rows."""
    steps = np.random.default_rng(1).choice([*[1.0] * 8, 1.05, 1.3, 2.0, 3.0, 6.6], 400)
    time_min = np.concatenate([np.arange(LEARN_FROM + 1), LEARN_FROM + np.cumsum(steps)]) * 0.1
    sampling = SamplingPeriod()
    intervals = [sampling.update(round(minutes * 6e10)) for minutes in time_min.tolist()][1:]
    behind = slice(LEARN_FROM, None)
    assert regular_intervals(time_min).tolist()[behind] == [item.follows for item in intervals][behind]
    assert missing_in_intervals(time_min).tolist()[behind] == [item.missing for item in intervals][behind]
