"""Properties of every chart of the catalogue."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.spc.charts.catalogue import CHARTS
from reactorwatch.spc.charts.cusum import Cusum
from reactorwatch.spc.charts.ewma import Ewma
from reactorwatch.spc.charts.shewhart import Shewhart
from reactorwatch.spc.compiled_chart import Bank, CompiledChart
from reactorwatch.stored_state import copy_of
from tests.unit.spc.members import MEMBERS, Member, value

COMPILED_CHARTS = [chart for chart in CHARTS if issubclass(chart, CompiledChart)]


@pytest.fixture(params=CHARTS, ids=lambda chart: chart.name)
def member(request: pytest.FixtureRequest) -> Member:
    assert request.param in MEMBERS, "a new chart needs a member to be checked by"
    return MEMBERS[request.param]


def restored(chart: Any) -> Any:
    """The chart from the bytes of its memory."""
    return type(chart).resume(copy_of(chart.memory))


def test_a_stopped_and_resumed_chart_equals_one_never_stopped(member: Member) -> None:
    """Stored after any of 40 samples, the chart goes on bit for bit."""
    samples = member.sample(np.random.default_rng(1), 40)
    steady, stopped = member.new(), member.new()
    for x in samples:
        stopped = restored(stopped)
        assert stopped.update(x) == steady.update(x)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
def test_what_is_no_number_is_refused_and_leaves_no_trace(member: Member, bad: float) -> None:
    samples = member.sample(np.random.default_rng(2), 5)
    chart, undisturbed = member.new(), member.new()
    for x in samples[:4]:
        assert chart.update(x) == undisturbed.update(x)
    spoilt = np.array(samples[4])
    spoilt.flat[0] = bad
    before = chart.memory.to_bytes()
    with pytest.raises(ValueError, match="a chart takes finite values"):
        chart.update(spoilt if spoilt.ndim else float(spoilt))
    assert chart.memory.to_bytes() == before
    assert chart.update(samples[4]) == undisturbed.update(samples[4])


def test_memory_is_bounded(member: Member) -> None:
    """After 3,000 samples the memory takes no more bytes than after 10, but for how long its numbers are written."""
    chart = member.new()
    sizes = []
    for x in member.sample(np.random.default_rng(3), 3000):
        chart.update(x)
        sizes.append(len(chart.memory.to_bytes()))
    assert max(sizes[10:]) <= max(sizes[:10]) + 9


def test_restarted_is_as_new(member: Member) -> None:
    samples = member.sample(np.random.default_rng(4), 20)
    chart, fresh = member.new(), member.new()
    for x in samples[:10]:
        chart.update(x)
    chart.restart()
    assert chart.memory.to_bytes() == fresh.memory.to_bytes()
    assert [chart.update(x) for x in samples[10:]] == [fresh.update(x) for x in samples[10:]]


def test_it_runs_as_long_as_computed(member: Member) -> None:
    """The mean of simulated run lengths is within 4 standard errors of the computed one."""
    chart, rng = member.new(), np.random.default_rng(5)
    lengths = []
    for _ in range(600):
        chart.restart()
        length = 0
        while True:
            samples = member.sample(rng, 25)
            out = next((i for i, x in enumerate(samples) if chart.update(x).out), None)
            length += 25 if out is None else out + 1
            if out is not None:
                break
        lengths.append(length)
    error = np.std(lengths) / np.sqrt(len(lengths))
    assert abs(np.mean(lengths) - member.run_length) < 4 * error


def test_out_means_beyond_a_limit(member: Member) -> None:
    """Every judgement of a chart without run rules is as its own numbers say."""
    chart = member.new()
    for x in member.sample(np.random.default_rng(6), 100):
        said = chart.update(x)
        beyond = not said.lower_limit <= said.statistic <= said.upper_limit
        assert said.lower_limit <= said.centre <= said.upper_limit
        assert said.out == beyond or (isinstance(chart, Shewhart) and said.out)


@pytest.mark.parametrize("kind", COMPILED_CHARTS, ids=lambda chart: chart.name)
def test_charts_of_a_bank_give_the_bits_of_the_single_chart(kind: type[CompiledChart]) -> None:
    """31 charts, some without a value at times, restarted and stored on the way: all as each by itself."""
    rng = np.random.default_rng(7)
    singles: list[CompiledChart] = [MEMBERS[kind].new() for _ in range(31)]
    bank = Bank.of(singles)
    for row in range(60):
        x, present = value(rng, 31), (rng.random(31) < 0.8).tolist()
        expected = [chart.update(v) if here else None for chart, v, here in zip(singles, x, present, strict=True)]
        is_out = any(point is not None and point.out for point in expected)
        judged = bank.judge(np.where(present, x, np.nan).tolist(), present, always=row % 2 == 0)
        assert judged == (expected if is_out or row % 2 == 0 else None)
        bank.restart(row % 31)
        singles[row % 31].restart()
        bank = Bank(kind, copy_of(bank.memory))
    assert bank.memory.numbers.T.tolist() == [chart.memory.numbers[:, 0].tolist() for chart in singles]


def test_a_memory_of_another_chart_is_refused() -> None:
    with pytest.raises(ValueError, match="the memory must be of the chart shewhart, got ewma"):
        Shewhart.resume(Ewma(0.0, 1.0).memory)


@pytest.mark.parametrize("kind", COMPILED_CHARTS, ids=lambda chart: chart.name)
def test_a_standard_deviation_of_zero_is_refused(kind: Any) -> None:
    with pytest.raises(InputError, match=r"sigma must be a positive number, got 0\.0"):
        kind(0.0, 0.0)


@pytest.mark.parametrize(
    ("new", "message"),
    [
        (lambda: Shewhart(0.0, 1.0, rules=(1, 5)), r"rules must be some of 1, 2, 3, 4, got \(1, 5\)"),
        (lambda: Shewhart(0.0, 1.0, width=-3.0), r"width must be a positive number, got -3\.0"),
        (lambda: Ewma(0.0, 1.0, weight=1.5), r"weight \(lambda\) must be in \(0, 1\], got 1\.5"),
        (lambda: Cusum(0.0, 1.0, h=-5.0), r"h must be a positive number, got -5\.0"),
    ],
)
def test_a_chart_checks_its_settings_as_its_run_length_does(new: Callable[[], object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        new()


def test_rules_count_only_points_that_complete_a_pattern() -> None:
    """Two of three beyond 2 sigma: out at the second of them, not at a point that follows near the mean."""
    chart = Shewhart(0.0, 1.0, rules=(2,))
    assert [chart.update(x).out for x in (2.1, -2.1, 0.0, 2.1, 0.0, 2.1, 0.0)] == [False] * 5 + [True, False]


def test_rule_3_wants_four_of_five_on_one_side_and_rule_4_eight_in_a_row() -> None:
    chart = Shewhart(0.0, 1.0, rules=(3, 4))
    assert [chart.update(x).out for x in (1.5, 1.5, 1.5, -0.1, 1.5)] == [False] * 4 + [True]
    chart.restart()
    assert [chart.update(0.1).out for _ in range(9)] == [False] * 7 + [True, True]
