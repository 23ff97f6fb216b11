"""The start of a new run of a plant, by the sequence numbers and times of its samples."""

from dataclasses import dataclass
from itertools import pairwise

from hypothesis import example, given
from hypothesis import strategies as st

from reactorwatch.contract.messages_pb2 import Alarm, Sample
from recorder.samples import RunSplitter

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
