"""Tests of residuals, against their definitions, closed forms and their promised rate of false alarms."""

import math

import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.identification.residual_tests import independence, minus_log10_p, whiteness


@pytest.mark.parametrize("statistic", [0.01, 3.0, 900.0, 2e3, 1e7])
def test_with_two_degrees_of_freedom_the_probability_is_exponential(statistic: float) -> None:
    """P(chi2_2 > x) = exp(-x/2) exactly, also where that underflows."""
    assert minus_log10_p(statistic, 2) == pytest.approx(0.5 * statistic / math.log(10.0), rel=1e-13)


@pytest.mark.parametrize("statistic", [900.0, 5e3, 1e6])
def test_with_four_degrees_of_freedom_too(statistic: float) -> None:
    """P(chi2_4 > x) = exp(-x/2) (1 + x/2)."""
    expected = (0.5 * statistic - math.log1p(0.5 * statistic)) / math.log(10.0)
    assert minus_log10_p(statistic, 4) == pytest.approx(expected, rel=1e-12)


def test_half_the_probability_lies_beyond_the_median() -> None:
    """Tables: the 50 % point of chi-squared with 20 degrees of freedom is 19.337, the 1 % point 37.566."""
    assert minus_log10_p(19.337, 20) == pytest.approx(-math.log10(0.50), abs=1e-4)
    assert minus_log10_p(37.566, 20) == pytest.approx(2.0, abs=1e-4)


def test_the_whiteness_statistic_is_that_of_ljung_and_box() -> None:
    """Q = N (N+2) sum r_k^2 / (N-k), written out for five numbers and two lags."""
    e = np.array([1.0, -2.0, 3.0, -1.0, -1.0])
    r1 = (-2.0 - 6.0 - 3.0 + 1.0) / 16.0
    r2 = (3.0 + 2.0 - 3.0) / 16.0
    test = whiteness(e, lags=2)
    assert test.statistic == pytest.approx(5.0 * 7.0 * (r1**2 / 4.0 + r2**2 / 3.0))
    assert test.degrees == 2


def test_white_residuals_fail_as_often_as_promised() -> None:
    """1 % of 2,000 white records fail at the 1 % level, within three standard deviations; with holes too."""
    rng = np.random.default_rng(1)
    failures = np.zeros(3)
    for _ in range(2000):
        e = rng.standard_normal(400)
        holed = np.where(rng.random(400) < 0.1, np.nan, e)
        u = np.repeat(rng.standard_normal(40), 10)
        failures += [test.minus_log10_p > 2.0 for test in (whiteness(e), whiteness(holed), independence(e, u))]
    np.testing.assert_allclose(failures / 2000, 0.01, atol=3.0 * math.sqrt(0.01 * 0.99 / 2000) + 0.003)


def test_coloured_residuals_are_found() -> None:
    rng = np.random.default_rng(2)
    white = rng.standard_normal(2000)
    assert whiteness(white[1:] + 0.3 * white[:-1]).minus_log10_p > 6.0
    u = rng.standard_normal(2000)
    late = white.copy()
    late[5:] += 0.2 * u[:-5]
    assert independence(late, u).minus_log10_p > 6.0
    assert independence(late, u, delay=6).minus_log10_p < 6.0, "the effect comes five samples late, not more"


def test_nothing_left_is_nothing_wrong() -> None:
    assert whiteness(np.zeros(100)).minus_log10_p == 0.0
    assert independence(np.zeros(100), np.arange(100.0)).minus_log10_p == 0.0
    assert independence(np.arange(100.0), np.ones(100)).degrees == 0


def test_too_few_residuals_or_lags_are_refused() -> None:
    with pytest.raises(InputError, match="20 lags need at least 40 residuals, got 30"):
        whiteness(np.ones(30))
    with pytest.raises(InputError, match="lags must be above the 3 fitted parameters"):
        whiteness(np.ones(30), lags=3, fitted=3)
    with pytest.raises(InputError, match="equally many rows, got 50 and 49"):
        independence(np.ones(50), np.ones(49))
    with pytest.raises(InputError, match="delay and lags must be at least 1, got 0 and 20"):
        independence(np.ones(50), np.ones(50), delay=0)
    with pytest.raises(InputError, match=r"residuals must have the shape \(rows,\)"):
        whiteness(np.ones((50, 1)))
    with pytest.raises(InputError, match="20 lags need more than 20 rows with a residual and past inputs"):
        independence(np.arange(40.0), np.full(40, np.nan))
