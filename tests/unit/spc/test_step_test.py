"""A lasting step is distinguished from outliers in the innovations of any linear predictor; chance has its share."""

import numpy as np
import pytest
from scipy.signal import lfilter

from reactorwatch.arrays import Array
from reactorwatch.spc.prewhitening import Prewhitening, learn
from reactorwatch.spc.step_test import ROWS, StepTests, step_response

PREDICTORS = {
    "simulation": np.array([1.0]),
    "first order": np.array([1.0, -0.9]),
    "random walk": np.array([1.0, -1.0]),
    "smooth": np.array([1.0, -1.6, 0.64]),
    "third order": np.array([1.0, -0.5, -0.3, -0.15]),
}
"""Polynomials of predictors: the residual is that of the measurement, filtered by one."""


def learn_tests(polynomial: Array, arl0: float) -> StepTests:
    z = np.random.default_rng(0).standard_normal((2000, 1))
    response = lfilter(polynomial, [1.0], np.ones(ROWS))
    return StepTests.learn(response[None], z, [learn(z[:, 0], 1e-9)], arl0)


@pytest.mark.parametrize("name", PREDICTORS)
def test_chance_raises_no_more_than_its_share(name: str) -> None:
    arl0, rows = 500.0, 20_000
    tests = learn_tests(PREDICTORS[name], arl0)
    z, raised, was_out = np.random.default_rng(1).standard_normal(rows), 0, False
    for value in z.tolist():
        is_out = tests.update([value])
        raised += is_out and not was_out
        was_out = is_out
    assert raised <= 1.3 * rows / arl0


@pytest.mark.parametrize("name", PREDICTORS)
@pytest.mark.parametrize("size", [18.0, -18.0, 60.0])
def test_a_step_is_found_within_five_rows_with_its_size(name: str, size: float) -> None:
    polynomial = PREDICTORS[name]
    tests, rng = learn_tests(polynomial, 1e6), np.random.default_rng(2)
    found = []
    for _ in range(20):
        tests.restart()
        z = rng.standard_normal(60) + lfilter(polynomial, [1.0], size * (np.arange(60) >= 40))
        row = next(k for k, value in enumerate(z.tolist()) if tests.update([value]))
        found.append(row - 40)
        assert tests.point(0).size == pytest.approx(size, rel=0.4)
    assert min(found) >= 1
    assert max(found) <= 5


@pytest.mark.parametrize("name", PREDICTORS)
@pytest.mark.parametrize("size", [8.0, -20.0, 100.0])
def test_an_outlier_of_any_size_is_no_step(name: str, size: float) -> None:
    polynomial = PREDICTORS[name]
    tests, rng = learn_tests(polynomial, 1e6), np.random.default_rng(3)
    for _ in range(20):
        z = rng.standard_normal(60) + lfilter(polynomial, [1.0], size * (np.arange(60) == 20))
        assert not any(tests.update([value]) for value in z.tolist())


def test_missing_rows_are_left_out_and_a_step_is_found_over_them() -> None:
    tests = learn_tests(PREDICTORS["first order"], 1e6)
    z = np.random.default_rng(4).standard_normal(60)
    z += lfilter(PREDICTORS["first order"], [1.0], 20.0 * (np.arange(60) >= 40))
    z[42] = np.nan
    out = [tests.update([value]) for value in z.tolist()]
    assert not any(out[:43])
    assert out[43]


def test_a_test_resumes_bit_for_bit() -> None:
    z = np.random.default_rng(5).standard_normal(200)
    z[60] = np.nan
    one = learn_tests(PREDICTORS["smooth"], 1e3)
    for k, value in enumerate(z.tolist()):
        other = StepTests(one.numbers.copy())
        assert one.update([value]) == other.update([value])
        np.testing.assert_equal(one.point(0), other.point(0), err_msg=str(k))


def test_the_response_of_the_innovations_is_that_of_the_residual_after_prewhitening() -> None:
    learned = Prewhitening(0.0, (0.5, 0.2), 2.0, 1000, 0.0, 0.0)
    expected = lfilter([1.0, -0.5, -0.2], [2.0], lfilter(PREDICTORS["smooth"], [1.0], np.ones(ROWS)))
    np.testing.assert_allclose(
        step_response(lfilter(PREDICTORS["smooth"], [1.0], np.ones(ROWS)), learned), expected, atol=1e-12
    )
