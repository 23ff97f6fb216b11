"""Samples of one plant: losses by sequence numbers, the start of a new run, and columns of values."""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.messages_pb2 import Alarm, Sample
from recorder.samples import RunSplitter, SampleSeries, SequenceCounter

PERIOD = 6_000_000_000
SIGNALS = ("qc", "C", "T")
T = "reactor/cstr/sample/T"


@dataclass(frozen=True)
class Session:
    """A run: its rows, how far its clock is off from where the run before ended, and whether it counts from 0."""

    rows: int
    step_ns: int
    restarted: bool


@st.composite
def sessions(draw: st.DrawFn) -> list[Session]:
    """The clock may step back by any amount, and a restarted plant may also start later."""
    found: list[Session] = []
    for _ in range(draw(st.integers(1, 4))):
        restarted = draw(st.booleans())
        back_ns = draw(st.one_of(st.integers(0, 600 * PERIOD), st.integers(1, 600).map(lambda rows: rows * PERIOD)))
        later_ns = draw(st.integers(1, 600 * PERIOD))
        step_ns = later_ns if restarted and draw(st.booleans()) else -back_ns
        if restarted and found and step_ns == -(found[-1].rows - 1) * PERIOD:
            step_ns -= 1  # or each sample would have the number and the time of one before, as what comes twice has
        found.append(Session(draw(st.integers(2, 400)), step_ns, restarted))
    return found


def samples(runs: list[Session], start_ns: int) -> list[tuple[int, str, int, int]]:
    """(run, signal, number, time) in order of receipt."""
    found: list[tuple[int, str, int, int]] = []
    time_ns, number = start_ns, 0
    for run, session in enumerate(runs, start=1):
        time_ns += session.step_ns if run > 1 else 0
        number = 0 if session.restarted else number
        for row in range(session.rows):
            time_ns += PERIOD if row else 0
            found += [(run, signal, number, time_ns) for signal in SIGNALS]
            number += 1
    return found


@given(sessions(), st.integers(-(10**18), 10**18))
def test_every_sample_is_of_its_run_and_none_is_missing(runs: list[Session], start_ns: int) -> None:
    splitter = RunSplitter()
    found = samples(runs, start_ns)
    assert [splitter.update(*sample[1:]) for sample in found] == [sample[0] for sample in found]
    assert [run.last_ns - run.first_ns for run in splitter.runs] == [(run.rows - 1) * PERIOD for run in runs]
    assert [(check.lost, check.duplicated) for check in splitter.counters.values()] == [(0, 0)] * 3


@given(sessions(), st.data())
def test_what_comes_late_or_twice_within_a_run_starts_no_run(runs: list[Session], data: st.DataObject) -> None:
    """A sample is overtaken by up to three rows, or comes again within its run."""
    found = samples(runs, 0)
    place = data.draw(st.integers(0, len(found) - 1))
    later = data.draw(st.integers(0, 9))
    moved = found[place]
    same_run = [index for index, sample in enumerate(found) if sample[0] == moved[0]]
    target = min(place + later, same_run[-1])
    is_first = place < same_run[0] + len(SIGNALS)
    if not is_first:  # nothing tells that a run has started before its first sample
        found.insert(target, found.pop(place))
    found.insert(target + 1, found[target])
    splitter = RunSplitter()
    assert [splitter.update(*sample[1:]) for sample in found] == [sample[0] for sample in found]
    assert sum(check.lost for check in splitter.counters.values()) == 0
    assert sum(check.duplicated for check in splitter.counters.values()) == 1


def test_a_signal_that_was_absent_where_the_clock_stepped_back_joins_the_run_of_the_others() -> None:
    splitter = RunSplitter()
    for number in range(10):
        for signal in SIGNALS:
            splitter.update(signal, number, number * PERIOD)
    found = [splitter.update("qc", 10 + number, number * PERIOD) for number in range(20)]
    assert found == [2] * 20
    assert splitter.update("T", 30, 20 * PERIOD) == 2


def test_a_publisher_without_sequence_numbers_has_one_run_while_its_clock_advances() -> None:
    splitter = RunSplitter()
    assert [splitter.update("T", 0, time_ns) for time_ns in (5, 6, 9, 3, 4)] == [1, 1, 1, 2, 2]


@given(sessions())
def test_continuous_times_increase_and_keep_the_spacing_of_rows(runs: list[Session]) -> None:
    clock = RunSplitter()
    found = [
        (run, clock.continuous_ns(signal, Sample(sequence=n, time_ns=t)), t) for run, signal, n, t in samples(runs, 0)
    ]
    rows = [found[index] for index in range(0, len(found), len(SIGNALS))]
    assert all(found[index][1] == found[index + 2][1] for index in range(0, len(found), len(SIGNALS)))
    for before, after in pairwise(rows):
        assert after[1] > before[1]
        if after[0] == before[0]:
            assert after[1] - before[1] == after[2] - before[2]


def test_messages_about_the_run_before_stay_with_it() -> None:
    clock = RunSplitter()
    for number in range(10):
        clock.continuous_ns(T, Sample(sequence=number, time_ns=number * PERIOD))
    assert clock.continuous_ns(T, Sample(sequence=0, time_ns=2 * PERIOD)) == 10 * PERIOD
    assert clock.continuous_ns("alarm", Alarm(time_ns=9 * PERIOD)) == 9 * PERIOD
    assert clock.continuous_ns("alarm", Alarm(time_ns=2 * PERIOD)) == 10 * PERIOD


@given(
    row=st.integers(3, 97),
    which=st.sampled_from([(0,), (1,), (2,), (0, 1, 2)]),
    time_ns=st.one_of(st.integers(-(2**63), 2**63 - 1), st.integers(0, 100).map(lambda row: row * PERIOD)),
)
@example(row=3, which=(2,), time_ns=4 * PERIOD)  # the others' next row has that time already
def test_a_damaged_time_is_out_of_place_and_cuts_no_run(row: int, which: tuple[int, ...], time_ns: int) -> None:
    """Of one signal, or of all in a row that is stamped an hour early, say."""
    found = samples([Session(100, 0, restarted=True)], 0)
    expected = [1] * len(found)
    for place in (3 * row + signal for signal in which):
        found[place] = (*found[place][:3], time_ns)
    splitter = RunSplitter()
    numbers = [splitter.update(*sample[1:]) for sample in found]
    fits = (row - 1) * PERIOD < time_ns < (row + 1) * PERIOD
    strays = 0 if fits else len(which)
    assert [number for place, number in enumerate(numbers) if place // 3 != row] == expected[3:]
    assert (splitter.strays, len(splitter.runs)) == (strays, 1)
    assert [check.lost for check in splitter.counters.values()] == [0] * 3
    assert fits or [(run.first_ns, run.last_ns) for run in splitter.runs] == [(0, 99 * PERIOD)]


@given(row=st.integers(3, 97), signal=st.integers(0, 2), number=st.integers(0, 2**64 - 1))
def test_a_damaged_number_is_out_of_place_and_what_it_replaces_is_missing(row: int, signal: int, number: int) -> None:
    found = samples([Session(100, 0, restarted=True)], 0)
    found[3 * row + signal] = (1, SIGNALS[signal], number, row * PERIOD)
    splitter = RunSplitter()
    for sample in found:
        splitter.update(*sample[1:])
    damaged = int(number != row)
    assert (splitter.strays, len(splitter.runs)) == (damaged, 1)
    assert sum(check.lost for check in splitter.counters.values()) == damaged


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
    skipping = list(range(0, 8 * SequenceCounter.max_gaps, 2))
    lost, duplicated, out_of_order = counted([*skipping, 1, skipping[-1] - 1])
    assert (lost, duplicated, out_of_order) == (len(skipping) - 2, 1, 1)


def sampled(row: int, sequence: int | None = None, **given: float | str) -> messages.Sample:
    stamps = {"time_ns": 100 + row * PERIOD, "sequence": row if sequence is None else sequence}
    return messages.Sample(**{**stamps, "value": float(row), "quality": messages.QUALITY_GOOD, **given})  # type: ignore[arg-type]


def test_samples_are_collected_by_run_and_signal() -> None:
    series = SampleSeries()
    for row, sequence in enumerate((*range(5), *range(6))):
        for signal in ("qc", "T"):
            series.add(signal, sampled(row, sequence, unit="K"))
    assert [{name: list(values) for name, (_, values) in run.items()} for run in series.runs] == [
        {"qc": [0.0, 1.0, 2.0, 3.0, 4.0], "T": [0.0, 1.0, 2.0, 3.0, 4.0]},
        {"qc": [5.0, 6.0, 7.0, 8.0, 9.0, 10.0], "T": [5.0, 6.0, 7.0, 8.0, 9.0, 10.0]},
    ]
    assert series.units == {"qc": "K", "T": "K"}


def test_a_stray_is_left_out() -> None:
    series = SampleSeries()
    for row in range(10):
        series.add("T", sampled(row, 7_000 if row == 5 else None, **({"time_ns": 7} if row == 5 else {})))
    (run,) = [run for run in series.runs if any(times for times, _ in run.values())]
    assert list(run["T"][1]) == [0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 7.0, 8.0, 9.0]
    assert series.splitter.strays == 1


@pytest.mark.parametrize(
    "given", [{"quality": messages.QUALITY_BAD}, {"value": math.inf}, {"value": math.nan}, {"value": -1e300}]
)
def test_a_value_that_cannot_be_one_counts_as_not_measured(given: dict[str, Any]) -> None:
    series = SampleSeries()
    series.add("T", sampled(0, **given))
    assert [math.isnan(value) for value in series.runs[0]["T"][1]] == [True]


def test_a_message_without_quality_is_no_sample() -> None:
    series = SampleSeries()
    series.add("T", sampled(0, quality=messages.QUALITY_UNSPECIFIED))
    assert series.runs == []
