"""A single value far off is a spike and is dropped; values that stay off are a change and are let through."""

from itertools import pairwise
from math import inf, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal, stats

from reactorwatch.errors import InputError
from reactorwatch.spc.spike import Spike, spike_limit

LIMIT = 6.0
ARL0 = 432_000.0  # 30 days of 6 s


def story(values: list[float], limit: float = LIMIT) -> str:
    """A letter a value: w withheld; s the one before was a spike; b both; . neither."""
    spike = Spike(limit)
    verdicts = [spike.update(z) for z in values]
    return "".join(".swb"[2 * verdict.quarantine + verdict.spike] for verdict in verdicts)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([0, 9, 0, 0], ".ws."),
        ([0, -9, 1, 0], ".ws."),
        ([0, 9, 9, 9, 9], ".w..."),  # a change: all but its first value is let through
        ([0, 9, 5, 0, 0], ".w..."),  # within the limit, but far from back
        ([0, 6.5, 5.5, 6.5, 5.5], ".w..."),  # a change as large as the limit is not a series of spikes
        ([0, 9, 9, 0, 9, 0], ".w..ws"),  # when a change is over, the next value beyond may be a spike
        ([0, 9, 0, 9, 0], ".wsws"),
        ([0, 9, -9, 0], ".wbs"),  # two spikes, one on either side
        ([0, 9, -9, 9, -9, 9, 0], ".wb...."),  # growing noise is let through from its third value on
        ([0, 9, -5, 0], ".ws."),  # what a filter that took the spike in says next is no change
        ([0, 9, -9, -9, 0], ".wb.."),
        ([0, 6, -6, 0], "...."),
    ],
)
def test_what_is_withheld_and_what_was_a_spike(values: list[float], expected: str) -> None:
    assert story(values) == expected
    assert story([-z for z in values]) == expected


def test_a_spike_is_reported_with_its_size_when_the_next_value_is_back() -> None:
    spike = Spike(LIMIT)
    sizes = [spike.update(z).size for z in (0.0, 12.5, 0.3, -7.0, 0.1)]
    assert sizes == [0.0, 0.0, 12.5, 0.0, -7.0]


@given(st.lists(st.floats(-20, 20), max_size=60))
def test_every_spike_was_withheld_just_before(values: list[float]) -> None:
    said = story(values)
    assert said[:1] in ("", ".", "w")
    assert all(before in "wb" for before, after in pairwise(said) if after in "sb")


@pytest.mark.parametrize("size", [7.0, 8.0, 12.0])
def test_a_shift_beyond_the_limit_loses_one_sample_and_hardly_ever_looks_like_a_spike(size: float) -> None:
    """It does if the second value is within half the limit: P(z < 3 - size) of them."""
    generator, first, spikes = np.random.default_rng(1), 0, 0
    for _ in range(500):
        said = story([0.0, *(size + generator.normal(size=20))])
        first += said.count("w")
        spikes += said.count("s")
    assert spikes <= 500 * 20 * stats.norm.cdf(LIMIT / 2 - size) + 3
    assert first <= 500 * 1.02


def test_missing_values_are_left_out_and_the_next_decides() -> None:
    spike = Spike(LIMIT)
    spike.update(9.0)
    with pytest.raises(ValueError, match="leave the sample out"):
        spike.update(nan)
    assert spike.update(0.0).spike


def test_after_a_restart_what_was_withheld_stays_undecided() -> None:
    spike = Spike(LIMIT)
    spike.update(9.0)
    spike.restart()
    assert not spike.update(0.0).spike


# --- while an alarm stands -----------------------------------------------------------------------------------


@pytest.mark.parametrize("level", [-20.0, -4.0, 3.0, 5.0, 9.0])
@pytest.mark.parametrize("spread", [0.5, 1.0, 2.0])
def test_values_about_a_new_level_are_no_spikes_while_an_alarm_stands(level: float, spread: float) -> None:
    """Of 5,000 values that a fault has moved; plainly judged, some of them are."""
    values = level + spread * np.random.default_rng(7).normal(size=5000)
    moved, plain = Spike(LIMIT), Spike(LIMIT)
    assert not any(moved.update(z, is_moved=True).spike for z in values.tolist())
    if 3.0 < abs(level) < 9.0 and spread >= 1.0:
        assert any(plain.update(z).spike for z in values.tolist())


@pytest.mark.parametrize("level", [-20.0, 0.0, 5.0])
def test_a_spike_beside_the_new_level_is_reported_with_its_distance_from_it(level: float) -> None:
    spike, noise = Spike(LIMIT), np.random.default_rng(8)
    for z in noise.normal(size=40).tolist():
        assert not spike.update(level + z, is_moved=True).spike
    assert spike.update(level + 15.0, is_moved=True).quarantine
    verdict = spike.update(level, is_moved=True)
    assert verdict.spike
    assert verdict.size == pytest.approx(15.0, abs=1.0)


def test_when_no_alarm_stands_any_more_values_are_judged_about_zero_again() -> None:
    spike = Spike(LIMIT)
    for _ in range(40):
        spike.update(8.0, is_moved=True)
    assert [spike.update(z).quarantine for z in (0.2, 8.0, 0.1)] == [False, True, False]
    assert spike.recent == []


def test_a_value_that_was_withheld_when_the_alarm_came_is_decided_by_the_next() -> None:
    spike = Spike(LIMIT)
    assert spike.update(9.0).quarantine
    assert spike.update(0.1, is_moved=True).spike
    spike.restart()
    assert spike.update(9.0).quarantine
    assert spike.update(9.0, is_moved=True) == (False, False, 0.0)


# --- how often chance does it --------------------------------------------------------------------------------


@pytest.mark.parametrize("limit", [1.0, 1.5, 2.0, 2.5])
@pytest.mark.parametrize("slowness", [0.0, 0.9])
def test_there_are_fewer_false_spikes_than_values_beyond_the_limit(limit: float, slowness: float) -> None:
    """Normal values, independent or not; the number of those beyond the limit is the bound in every record."""
    noise = np.random.default_rng(2).normal(size=100_000) * np.sqrt(1 - slowness**2)
    values = signal.lfilter([1.0], [1.0, -slowness], noise)
    spikes = story(values.tolist(), limit).replace("b", "s").count("s")
    assert 0 < spikes < np.count_nonzero(np.abs(values) > limit)


# --- the limit -----------------------------------------------------------------------------------------------


def test_normal_values_get_a_limit_of_about_six() -> None:
    generator = np.random.default_rng(3)
    limits = [spike_limit(generator.normal(size=4000), ARL0) for _ in range(50)]
    assert np.median(limits) == pytest.approx(6.0, abs=0.5)
    assert min(limits) > stats.norm.isf(0.5 / ARL0)


@pytest.mark.parametrize("rows", [600, 4000])
def test_exponential_tails_get_a_limit_that_keeps_the_promise_in_most_trainings(rows: int) -> None:
    """One standard error above the estimate: about 84 of 100; at least 75 of 100 here, which is 3 standard errors."""
    tails = stats.laplace(scale=np.sqrt(0.5))
    generator = np.random.default_rng(4)
    kept = [
        2 * tails.sf(spike_limit(tails.rvs(rows, random_state=generator), ARL0)) <= 1 / ARL0 for _ in range(200)
    ]  # fmt: skip
    assert np.mean(kept) > 0.75


def test_a_few_spikes_in_the_training_hardly_move_the_limit_however_large_they_are() -> None:
    values = np.random.default_rng(5).normal(size=1000)
    clean = spike_limit(values, ARL0)
    values[::200] = 30.0
    few = spike_limit(values, ARL0)
    values[::200] = 1e6
    assert spike_limit(values, ARL0) == few < clean + 1.5


def test_many_spikes_in_the_training_are_how_the_signal_is() -> None:
    values = np.random.default_rng(5).normal(size=1000)
    values[::30] = 30.0
    assert spike_limit(values, ARL0) > 30.0


def test_more_false_spikes_allowed_is_a_lower_limit() -> None:
    values = np.random.default_rng(6).normal(size=1000)
    limits = [spike_limit(values, arl0) for arl0 in (1e2, 1e3, 1e4, 1e6)]
    assert limits == sorted(limits)
    assert limits[0] < limits[-1]


@pytest.mark.parametrize("values", [np.zeros(49), np.full(100, nan), np.zeros((100, 2))])
def test_a_training_that_is_none_is_refused(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> None:
    with pytest.raises(InputError, match="z must be at least 50 finite values"):
        spike_limit(values, ARL0)


@pytest.mark.parametrize("limit", [0.0, -6.0, nan, inf])
def test_a_limit_that_is_none_is_refused(limit: float) -> None:
    with pytest.raises(InputError, match="limit must be a positive number"):
        Spike(limit)


# --- state ---------------------------------------------------------------------------------------------------


@given(st.lists(st.tuples(st.floats(-20, 20), st.booleans()), max_size=60), st.integers(0, 60))
def test_it_resumes_from_its_stored_state_as_if_it_had_never_stopped(
    values: list[tuple[float, bool]], cut: int
) -> None:
    through, stopped = Spike(LIMIT), Spike(LIMIT)
    expected = [through.update(z, is_moved=is_moved) for z, is_moved in values]
    said = [stopped.update(z, is_moved=is_moved) for z, is_moved in values[:cut]]
    resumed = Spike.from_bytes(stopped.to_bytes())
    assert said + [resumed.update(z, is_moved=is_moved) for z, is_moved in values[cut:]] == expected


@given(st.lists(st.tuples(st.floats(-20, 20), st.booleans()), max_size=60))
def test_whether_an_alarm_stands_or_not_no_three_values_in_a_row_are_withheld(values: list[tuple[float, bool]]) -> None:
    spike = Spike(LIMIT)
    said = "".join("w" if spike.update(z, is_moved=is_moved).quarantine else "." for z, is_moved in values)
    assert "www" not in said
