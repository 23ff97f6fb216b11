"""Samples of another plant are refused, and no run of the monitored plant loses one."""

import random

import pytest

from monitor_node.ingest.sequence_check import CONFIRMED, HeldSample, SequenceCheck

PERIOD = 6_000_000_000
REORDER_ROWS = 8


def regular(first: int, count: int, begin_ns: int = 0) -> list[HeldSample]:
    """A plant that counts from `first` on, one sample a period."""
    return [HeldSample(begin_ns + row * PERIOD, first + row, float(row), "K") for row in range(count)]


def taken(samples: list[HeldSample], run: SequenceCheck | None = None) -> tuple[list[HeldSample], list[HeldSample]]:
    """Those that are believed, in order, and those that are refused."""
    run = run or SequenceCheck()
    believed, refused = list[HeldSample](), list[HeldSample]()
    for sample in samples:
        if run.accept_next(sample.number, sample.time_ns):
            believed.append(sample)
        else:
            of_run, strange = run.update(sample, REORDER_ROWS)
            believed += of_run
            refused += strange
    return believed + run.release(), refused


@pytest.mark.parametrize(
    "more",
    [
        regular(100, 50, 1000 * PERIOD),  # the plant paused
        regular(0, 50, 1000 * PERIOD),  # and began to count anew
        regular(0, 50, 100 * PERIOD),  # at once
        regular(0, 50),  # with the clock of before
        regular(100, 50, -5000 * PERIOD),  # its clock was set back
        regular(5000, 50, 5000 * PERIOD),  # we were away
        [HeldSample(item.time_ns // 10 + 100 * PERIOD, *item[1:]) for item in regular(100, 50)],  # ten times as fast
        [HeldSample(item.time_ns * 10 + 100 * PERIOD, *item[1:]) for item in regular(100, 50)],  # and as slow
    ],
    ids=["paused", "began anew later", "began anew", "same clock", "set back", "lost", "faster", "slower"],
)
def test_whatever_the_plant_does_none_of_its_samples_is_lost(more: list[HeldSample]) -> None:
    samples = regular(0, 100) + more
    assert taken(samples) == (samples, [])


@pytest.mark.parametrize("off", [-50, -1, 1, 2, 50])
def test_a_wrong_number_at_the_right_time_is_refused(off: int) -> None:
    before, (true, *after) = regular(0, 100), regular(100, 20, 100 * PERIOD)
    wrong = true._replace(number=true.number + off)
    run = SequenceCheck()
    taken(before, run)
    assert not run.accept_next(wrong.number, wrong.time_ns)
    assert taken([*before, wrong, *after]) == ([*before, *after], [wrong])


def test_a_plant_of_irregular_times_loses_none() -> None:
    """Times between samples are exponential: a few are a hundredth of the usual, a few ten times as much."""
    draw = random.Random(3)
    time_ns, samples = 0, list[HeldSample]()
    for number in range(5000):
        time_ns += 1 + int(draw.expovariate(1.0) * PERIOD)
        samples.append(HeldSample(time_ns, number, 0.0, "K"))
    assert taken(samples) == (samples, [])


def test_a_plant_that_pauses_again_and_again_loses_none() -> None:
    """It says one, two or three samples at a time, after a hundred regular ones, and counts on."""
    draw, time_ns = random.Random(6), 100 * PERIOD
    samples = regular(0, 100)
    for _ in range(50):
        time_ns += draw.randrange(10, 1000) * PERIOD
        for _ in range(draw.choice((1, 2, 3))):
            samples.append(HeldSample(time_ns, len(samples), 0.0, "K"))
            time_ns += PERIOD
    assert taken(samples) == (samples, [])


def test_missing_and_shuffled_samples_are_believed() -> None:
    draw = random.Random(4)
    samples = [item for item in regular(0, 1000) if draw.random() > 0.1]
    for first in range(3, len(samples), 7):
        part = samples[first : first + 7]
        draw.shuffle(part)
        samples[first : first + 7] = part
    believed, refused = taken(samples)
    assert refused == []
    assert sorted(believed) == sorted(samples)


@pytest.mark.parametrize("numbers", [0, 300, 2**40])
def test_of_two_plants_with_one_name_the_first_is_believed_and_the_other_refused(numbers: int) -> None:
    ours, theirs = regular(0, 500), regular(numbers + 7, 300, 100 * PERIOD + PERIOD // 3)
    both = sorted(ours + theirs, key=lambda item: item.time_ns)
    believed, refused = taken(both)
    assert believed == ours
    assert refused == theirs


def test_a_bunch_of_the_other_s_samples_does_not_make_it_the_plant() -> None:
    """Those of the first are held up for seven periods again and again."""
    ours, theirs = regular(0, 500), regular(3, 300, 100 * PERIOD + PERIOD // 3)
    both = sorted(ours + theirs, key=lambda item: (item.time_ns // (7 * PERIOD), item in ours, item.time_ns))
    believed, refused = taken(both)
    assert believed == ours
    assert refused == theirs


def test_when_the_first_of_two_plants_has_gone_the_other_is_believed() -> None:
    ours, theirs = regular(0, 200), regular(1000, 400, 100 * PERIOD + PERIOD // 3)
    believed, refused = taken(sorted(ours + theirs, key=lambda item: item.time_ns))
    assert believed == ours + theirs[99:]
    assert refused == theirs[:99]


@pytest.mark.parametrize("seed", range(20))
def test_a_damaged_time_or_number_is_refused(seed: int) -> None:
    """Any bit of either is another; where the sample is still one that may have been, it is of its place in the run."""
    draw = random.Random(seed)
    samples = regular(0, 100)
    for place in range(50, 100):
        bit = draw.randrange(38, 62)  # of the time: 2**38 ns is 46 periods
        time_ns, number = samples[place - 1].time_ns, samples[place - 1].number
        strange = HeldSample(time_ns ^ (1 << bit), number, 0.0, "K")
        if draw.random() < 0.5:
            strange = HeldSample(time_ns, number ^ (1 << draw.randrange(3, 62)), 0.0, "K")
        believed, refused = taken([*samples[:place], strange, *samples[place : place + 3]])
        assert believed == samples[: place + 3]
        assert refused == [strange]


@pytest.mark.parametrize("held_up", range(1, CONFIRMED))
def test_a_second_plant_is_refused_while_the_first_is_held_up_for_less_than_a_restart_takes(held_up: int) -> None:
    """When it goes on, both take turns."""
    first, second = regular(0, 121), regular(0, held_up + 20, -9000 * PERIOD)
    turns = [sample for pair in zip(first[100:], second[held_up:], strict=False) for sample in pair]
    assert taken([*first[:100], *second[:held_up], *turns, first[120]]) == (first, second)


def test_a_first_plant_that_is_held_up_for_longer_cannot_be_distinguished_from_a_restarted_one() -> None:
    """The samples up to the decision are the same, so the second is watched, and the first refused when it is back."""
    first, second = regular(0, 120), regular(0, 60, -9000 * PERIOD)
    restart = [*first[:100], *second[:CONFIRMED]]
    assert taken(restart) == (restart, [])
    turns = [sample for pair in zip(second[CONFIRMED:], first[100:], strict=False) for sample in pair]
    believed, refused = taken([*restart, *turns, *second[CONFIRMED + 20 :]])
    assert believed == [*first[:100], *second]
    assert refused == first[100:]


def test_memory_is_bounded() -> None:
    """Whatever comes, no more than the samples that would be a run are held."""
    draw, run = random.Random(5), SequenceCheck()
    for _ in range(10_000):
        run.update(HeldSample(draw.randrange(2**40), draw.randrange(1000), 0.0, "K"), REORDER_ROWS)
        assert len(run.held) < CONFIRMED
