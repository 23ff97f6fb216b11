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


def uneven(off: float, count: int = 100) -> list[HeldSample]:
    """A plant whose periods are longer and shorter by a share, in turn."""
    return [
        HeldSample(round((row + off * (row % 2 - 0.5)) * PERIOD), row, float(row), "K") for row in range(count)
    ]  # fmt: skip


def delays(samples: list[HeldSample], more: list[HeldSample]) -> list[int]:
    """Number of samples after each of `more` before it is accepted, where all are."""
    run = SequenceCheck()
    taken(samples, run)
    arrived, accepted = dict[HeldSample, int](), dict[HeldSample, int]()
    for index, sample in enumerate(more):
        arrived[sample] = index
        of_run, strange = run.update(sample, REORDER_ROWS)
        assert not strange
        accepted |= dict.fromkeys(of_run, index)
    return [accepted[sample] - arrived[sample] for sample in accepted]


@pytest.mark.parametrize(
    ("more", "longest"),
    [
        (regular(100, 9, 100 * PERIOD), 0),
        (regular(100, 9, 1000 * PERIOD), 1),
        (regular(100, 9, -1000 * PERIOD), 2),
        (regular(0, 9, 1000 * PERIOD), 7),
        (regular(0, 9, -1000 * PERIOD), 7),
    ],
    ids=["none", "pause", "clock set back", "restart", "restart with the clock set back"],
)
def test_a_pause_delays_one_sample_a_set_clock_two_and_a_restart_seven(more: list[HeldSample], longest: int) -> None:
    found = delays(regular(0, 100), more)
    assert len(found) == len(more)
    assert found == [*range(longest, 0, -1), *[0] * (len(more) - longest)]


@pytest.mark.parametrize("off", [0.0, 0.1])
def test_the_next_sample_follows_within_a_quarter_of_the_spacing_and_four_mean_deviations(off: float) -> None:
    samples = uneven(off)
    for share, follows in ((0.999, True), (1.001, False)):
        for sign in (-1, 1):
            run = SequenceCheck()
            taken(samples, run)
            usual = run.spacing
            assert usual.mean_ns == pytest.approx(PERIOD, rel=0.02)
            assert usual.deviation_ns == pytest.approx(off * PERIOD, rel=0.1)
            allowed_ns = 0.25 * usual.mean_ns + 4.0 * usual.deviation_ns
            time_ns = round(samples[-1].time_ns + usual.mean_ns + sign * share * allowed_ns)
            assert run.accept_next(100, time_ns) is follows


@pytest.mark.parametrize(("late", "is_learned"), [(0.005, False), (-0.005, False), (0.02, True), (-0.02, True)])
def test_only_a_spacing_that_deviates_by_more_than_a_hundredth_updates_the_mean(late: float, is_learned: bool) -> None:
    run = SequenceCheck()
    taken(regular(0, 100), run)
    before = run.spacing.mean_ns
    assert run.accept_next(100, round((100 + late) * PERIOD))
    assert (run.spacing.mean_ns - before) / PERIOD == pytest.approx(late / 16 if is_learned else 0.0)


def test_the_spacing_is_learned_for_each_number_where_samples_are_missing() -> None:
    run = SequenceCheck()
    taken(regular(0, 100)[::3], run)
    assert run.spacing.mean_ns == PERIOD


def test_a_sample_that_is_sent_twice_is_of_the_run_both_times() -> None:
    """The alignment counts it as a duplicate."""
    samples = regular(0, 100)
    twice = [sample for sample in samples for _ in range(2)]
    assert taken(twice) == (twice, [])


@pytest.mark.parametrize(("rows", "follows"), [(32, True), (33, False)])
def test_a_late_sample_follows_backwards_as_far_as_rows_are_remembered(rows: int, follows: bool) -> None:
    samples, after = regular(0, 100), regular(100, 3, 100 * PERIOD)
    late = samples.pop(99 - rows)
    expected = ([*samples, late, *after], []) if follows else ([*samples, *after], [late])
    assert taken([*samples, late, *after]) == expected


@pytest.mark.parametrize(("periods", "follows"), [(0, False), (-1, False), (1, True), (4, True), (5, False)])
def test_before_the_spacing_is_known_a_sample_follows_within_four_times_its_mean(periods: int, follows: bool) -> None:
    samples = regular(0, 6)
    run = SequenceCheck()
    taken(samples, run)
    sample = HeldSample(samples[-1].time_ns + periods * PERIOD, 6, 0.0, "K")
    assert run.update(sample, REORDER_ROWS) == (([sample] if follows else []), [])


def test_a_sample_at_the_time_of_its_predecessor_is_refused_however_irregular_the_run_is() -> None:
    """Four mean deviations are then more than a spacing."""
    samples = uneven(0.9)
    run = SequenceCheck()
    taken(samples, run)
    assert 4.0 * run.spacing.deviation_ns > run.spacing.mean_ns
    assert not run.accept_next(100, samples[-1].time_ns)
    assert not run.accept_next(100, samples[-1].time_ns - 1)
    same = HeldSample(samples[-1].time_ns, 100, 0.0, "K")
    following = HeldSample(100 * PERIOD, 100, 100.0, "K")
    assert taken([*samples, same, following]) == ([*samples, following], [same])


@pytest.mark.parametrize(
    "strange",
    [
        [(101, 1100)],  # its time is far beyond
        [(100, 99)],  # that of the newest
        [(101, 103)],  # that of the sample which shows it
        [(103, 101)],  # its number is that of the sample
        [(99, 101)],  # or of the newest
        [(5000, -300), (5001, -299), (70, 4000)],  # two that follow each other, and one more
        [(100, 1100), (150, 1101)],  # the first has the next number
        [(5000, -300), (5000, -300)],  # twice the same
        [(5000, -300), (5004, -300)],  # two of one time
        [(100, 1100), (101, 1100)],  # two with the next numbers and of one time, which is no pause
    ],
)
def test_held_samples_are_refused_but_those_between_the_run_and_the_sample_that_follows_it(
    strange: list[tuple[int, int]],
) -> None:
    held = [HeldSample(periods * PERIOD, number, 0.0, "K") for number, periods in strange]
    before, after = regular(0, 100), regular(103, 3, 103 * PERIOD)
    assert taken([*before, *held, *after]) == ([*before, *after], held)


def test_an_early_sample_is_accepted_with_the_one_that_shows_that_it_came_early() -> None:
    """It is too early to follow by itself, and between the run and the next sample in number and time."""
    early = HeldSample(round(100.9 * PERIOD), 100, 100.0, "K")
    samples = [*regular(0, 100), early, *regular(101, 3, 101 * PERIOD)]
    assert taken(samples) == (samples, [])


@pytest.mark.parametrize(
    ("off", "steps", "is_run"),
    [
        (0.0, [(1, 1.0)] * 7, True),
        (0.0, [(1, 1.0), (1, 0.8)] * 3, False),  # one too few
        (0.0, [(1, 1.0), (1, 0.8)] * 4, True),
        (0.0, [(1, 1.0), (1, 0.7)] * 4, False),
        (0.0, [(1, 1.0), (2, 2.0)] * 4, True),
        (0.1, [(1, 1.0), (1, 0.4)] * 4, True),
        (0.1, [(1, 1.0), (1, 0.2)] * 4, False),
        (0.0, [(32, 32.0)] * 7, True),
        (0.0, [(33, 33.0)] * 7, False),
        (0.0, [*[(1, 1.0)] * 3, (33, 33.0), *[(1, 1.0)] * 3], False),
        (0.0, [(1, -1.0)] * 7, False),
        (0.0, [(0, 0.0)] * 7, False),
    ],
)
def test_eight_samples_are_a_restart_if_they_follow_each_other_as_evenly_as_the_run(
    off: float, steps: list[tuple[int, float]], is_run: bool
) -> None:
    run = SequenceCheck()
    taken(uneven(off), run)
    samples = [HeldSample(-9000 * PERIOD, 7000, 0.0, "K")]
    for numbers, periods in steps:
        last = samples[-1]
        samples.append(HeldSample(last.time_ns + round(periods * PERIOD), last.number + numbers, 0.0, "K"))
    accepted = [item for sample in samples for item in run.update(sample, REORDER_ROWS)[0]]
    assert accepted == (samples if is_run else [])


def test_samples_whose_times_fall_as_their_numbers_rise_are_no_run_at_the_start_either() -> None:
    run = SequenceCheck()
    taken(regular(0, 6), run)
    falling = [HeldSample(-row * PERIOD, 7000 + row, 0.0, "K") for row in range(20)]
    assert [item for sample in falling for item in run.update(sample, REORDER_ROWS)[0]] == []


@pytest.mark.parametrize("count", [6, 100])
@pytest.mark.parametrize(("reorder_rows", "confirmed"), [(1, 3), (5, 5), (8, 8), (20, 8)])
def test_a_restart_takes_fewer_samples_with_a_smaller_reordering(count: int, reorder_rows: int, confirmed: int) -> None:
    run = SequenceCheck()
    taken(regular(0, count), run)
    samples = regular(7000, confirmed, -9000 * PERIOD)
    accepted = [run.update(sample, reorder_rows)[0] for sample in samples]
    assert accepted == [*[[]] * (confirmed - 1), samples]
