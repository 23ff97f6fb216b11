"""The autoregression of a residual is learned from a training, with its uncertainty."""

import numpy as np
import pytest
from scipy.signal import lfilter

from reactorwatch.arrays import Array
from reactorwatch.spc.charts.base import Baseline
from reactorwatch.spc.charts.mewma import Mewma
from reactorwatch.spc.prewhitening import Prewhitener, Prewhitening, learn, memory_covariance


def autoregression(phi: float, rows: int, seed: int) -> np.ndarray:
    """Rows of x[k] = phi x[k-1] + w[k], w of unit variance, in its steady state."""
    noise = np.random.default_rng(seed).normal(size=rows + 500)
    return np.asarray(lfilter([1.0], [1.0, -phi], noise))[500:]


def innovations_of(z: np.ndarray, learned: Prewhitening) -> np.ndarray:
    whitener = Prewhitener(learned)
    return np.array([whitener.update(value) for value in z.tolist()])


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.9])
def test_what_comes_out_of_an_autoregression_is_white_and_of_unit_variance(phi: float) -> None:
    """On 20,000 new rows the first ten autocorrelations are within 4 standard errors, and what the training adds."""
    z = autoregression(phi, 40_000, seed=1)
    e = innovations_of(3.0 + 2.0 * z[20_000:], learn(3.0 + 2.0 * z[:20_000], 1e-9))
    e = e[np.isfinite(e)]
    assert np.mean(e) == pytest.approx(0.0, abs=4 * np.sqrt(2 / e.size))
    assert np.std(e) == pytest.approx(1.0, abs=4 * np.sqrt(1 / e.size))
    for lag in range(1, 11):
        assert np.mean(e[lag:] * e[:-lag]) == pytest.approx(0.0, abs=4 * np.sqrt(2 / e.size))


def test_its_uncertainty_is_that_of_many_trainings() -> None:
    """Over 2,000 trainings of 400 rows the mean, sigma and what is passed err with the variances that are told."""
    trainings = [learn(autoregression(0.5, 400, seed), 1e-9) for seed in range(2000)]
    constant = np.var([item.constant for item in trainings])
    assert constant == pytest.approx(np.mean([1.0 / item.rows for item in trainings]), rel=0.15)
    sd = np.var(np.log([item.sd for item in trainings]))
    assert sd == pytest.approx(np.mean([item.sd_variance for item in trainings]), rel=0.15)
    first = [item for item in trainings if len(item.coefficients) == 1]
    assert len(first) > 1000
    passed = np.var(np.log([item.shift_gain for item in first]))
    assert passed == pytest.approx(np.mean([item.passed_variance for item in first]), rel=0.25)


def test_a_lasting_shift_is_passed_on_by_its_informative_part() -> None:
    learned = Prewhitening(0.0, (0.5, 0.2), 2.0, 1000, 0.001, 0.001)
    assert learned.shift_gain == pytest.approx(0.3)
    assert innovations_of(np.full(10, 6.0), learned)[-1] == pytest.approx(0.3 * 6.0 / 2.0)


def test_after_a_gap_nothing_is_judged_until_the_past_is_there_again() -> None:
    learned = Prewhitening(0.0, (0.5, 0.2), 1.0, 1000, 0.001, 0.001)
    e = innovations_of(np.array([1.0, 1.0, 1.0, np.nan, 1.0, 1.0, 1.0]), learned)
    assert np.isfinite(e).tolist() == [False, False, True, False, False, False, True]


def test_rows_left_out_of_the_training_do_not_count() -> None:
    z = autoregression(0.3, 2000, seed=3)
    spoilt = z.copy()
    spoilt[500:700] = np.nan
    learned = learn(spoilt, 1e-9)
    assert learned.rows < 1800
    assert learned.sd == pytest.approx(1.0, abs=0.07)


def test_a_residual_that_does_not_vary_has_the_smallest_deviation() -> None:
    learned = learn(np.full(500, 3.0), 0.1)
    assert learned.sd == 0.1
    assert learned.constant == pytest.approx(3.0)
    assert sum(learned.coefficients) == pytest.approx(0.0, abs=1e-6)


def test_a_random_walk_is_not_taken_for_one() -> None:
    """Nothing would be a shift if all of it were passed over."""
    learned = learn(np.cumsum(np.random.default_rng(4).normal(size=1000)), 1e-9)
    assert learned.shift_gain >= 1.0 - 0.98 - 1e-12


def test_few_rows_give_their_mean_and_deviation() -> None:
    learned = learn(np.array([1.0, 2.0, 3.0, np.nan]), 1e-9)
    assert (learned.constant, learned.coefficients, learned.sd) == (2.0, (), 1.0)


def test_whole_numbers_are_filtered_like_others() -> None:
    filters = [Prewhitener(Prewhitening(0.0, (0.5,), 2.0, 1000, 0.001, 0.001)) for _ in range(2)]
    for z in (1, 2, 3, 1):
        np.testing.assert_equal(filters[0].update(z), filters[1].update(float(z)))


def delayed(rows: int, seed: int) -> Array:
    """Two white signals, of which the second follows the first a row later, with a correlation of 0.9."""
    first, own = np.random.default_rng(seed).standard_normal((2, rows))
    return np.column_stack([first[1:], 0.9 * first[:-1] + np.sqrt(1.0 - 0.9**2) * own[1:]])


def test_the_covariance_of_averages_has_what_is_correlated_over_rows() -> None:
    """C(0) + (1 - weight) (C(1) + C(1)') with a correlation of 0.9 at one row."""
    known = np.array([[1.0, 0.9 * 0.98], [0.9 * 0.98, 1.0]])
    found = memory_covariance(delayed(100_000, 5), np.eye(2), 0.02)
    directions = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2.0)
    assert directions[0] @ found @ directions[0] == pytest.approx(directions[0] @ known @ directions[0], rel=0.02)
    assert directions[1] @ found @ directions[1] == pytest.approx(1.0, rel=0.02)  # no smaller than for independent rows


@pytest.mark.parametrize("signals", [2, 5, 20])
def test_the_covariance_of_white_signals_is_as_it_is(signals: int) -> None:
    e = np.random.default_rng(6).standard_normal((20, 2000, signals))
    kept = [np.array_equal(memory_covariance(item, np.eye(signals), 0.02), np.eye(signals)) for item in e]
    assert np.count_nonzero(kept) >= 18


def test_a_mewma_of_signals_that_follow_each_other_keeps_its_run_length() -> None:
    """One for independent rows has more than twice as many alarms."""
    e, count = delayed(2000, 7), 0
    learned = Prewhitening(0.0, (), 1.0, 100_000, 5e-6, 0.0)
    chart = Mewma.design(Baseline((learned, learned), e, (1.0, 1.0), 1000.0, 0.001, {"mewma_weight": 0.02}))
    for row in delayed(400_000, 8):
        if chart.update(row).out:
            count += 1
            chart.restart()
    assert count < 1.3 * 400
