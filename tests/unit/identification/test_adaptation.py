"""Gains other than that of least squares, held to padasip and to the Kalman filter's own equations."""

from typing import Any

import numpy as np
import padasip
import pytest

from reactorwatch.errors import InputError
from reactorwatch.identification.adaptation import BIAS, GAINS, AdaptiveRegression
from reactorwatch.identification.dataset import Dataset
from reactorwatch.identification.identify import ModelForm, identify
from reactorwatch.identification.rls import RecursiveLeastSquares

ROWS, TRUTH = 400, np.array([1.2, -0.5, 0.3])


def rows(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    regressors = rng.standard_normal((ROWS, TRUTH.size))
    return regressors, regressors @ TRUTH + 0.1 * rng.standard_normal(ROWS)


def learn(kind: str, gain: float | None = None) -> AdaptiveRegression:
    estimator = AdaptiveRegression(TRUTH.size, kind, gain)
    for regressor, output in zip(*rows(), strict=True):
        estimator.update(regressor, output)
    return estimator


@pytest.mark.parametrize(
    ("kind", "peer"),
    [
        ("gradient", padasip.filters.FilterLMS(3, mu=0.05, w="zeros")),
        ("normalized-gradient", padasip.filters.FilterNLMS(3, mu=0.5, eps=BIAS, w="zeros")),
    ],
)
def test_gradient_methods_give_what_padasip_gives(kind: str, peer: Any) -> None:
    regressors, outputs = rows()
    peer.run(outputs, regressors)
    assert learn(kind).parameters == pytest.approx(peer.w, rel=1e-12)


def test_a_kalman_filter_without_drift_is_least_squares() -> None:
    """From a covariance of 1e4; the standard deviations too."""
    regressors, outputs = rows()
    reference = RecursiveLeastSquares(TRUTH.size, 1.0, 1e4)
    for regressor, output in zip(regressors, outputs, strict=True):
        reference.update(regressor, output)
    estimator = learn("kalman", 0.0)
    np.testing.assert_allclose(estimator.parameters, reference.parameters, rtol=1e-9)
    np.testing.assert_allclose(estimator.unit_covariance, reference.unit_covariance, rtol=1e-6, atol=1e-12)


def test_a_kalman_filter_follows_a_random_walk_with_the_variance_of_its_riccati_equation() -> None:
    """One parameter, regressor 1: P = q/2 + sqrt(q^2/4 + q) before a row, for noise of variance 1."""
    q, rng = 0.01, np.random.default_rng(3)
    estimator = AdaptiveRegression(1, "kalman", q)
    walk, errors = 0.0, []
    for _ in range(20_000):
        walk += np.sqrt(q) * rng.standard_normal()
        errors.append(estimator.parameters[0] - walk)
        estimator.update([1.0], walk + rng.standard_normal())
    expected = q / 2 + np.sqrt(q * q / 4 + q)
    assert float(estimator.unit_covariance[0, 0]) == pytest.approx(expected, rel=1e-9)
    assert np.mean(np.square(errors[100:])) == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("kind", GAINS)
def test_identify_learns_a_plant_by_each_gain(kind: str) -> None:
    rng = np.random.default_rng(5)
    u, y = np.repeat(rng.standard_normal(1000), 3), np.zeros(3000)
    for k in range(1, 3000):
        y[k] = 0.8 * y[k - 1] + 0.5 * u[k - 1] + 0.02 * rng.standard_normal()
    data = Dataset.of(np.arange(3000.0), u, y, ("u",), "y")
    found = identify(data, ModelForm("arx", 1, recursive=True, adaptation=kind))
    assert found.a[0] == pytest.approx(0.8, abs=0.03)
    assert found.fit.free_run > 85.0


def test_a_gain_that_is_too_large_is_named() -> None:
    with pytest.raises(InputError, match="gradient adaptation diverges with a gain of 5: choose a smaller one"):
        learn("gradient", 5.0)


@pytest.mark.parametrize(
    ("form", "message"),
    [
        ({"adaptation": "lms"}, "unknown adaptation 'lms'"),
        ({"adaptation": "kalman", "recursive": False}, "add --recursive"),
        ({"adaptation": "kalman", "model": "oe"}, "adaptation kalman is for arx"),
        ({"gain": 0.1}, "of forgetting give the factor"),
        ({"adaptation": "gradient", "gain": -1.0}, "gain of gradient must be positive and finite, got -1.0"),
    ],
)
def test_choices_that_do_not_go_together_are_refused(form: dict[str, object], message: str) -> None:
    u = np.random.default_rng(6).standard_normal(60)
    with pytest.raises(InputError, match=message):
        identify(Dataset.of(np.arange(60.0), u, u), ModelForm(**({"recursive": True, "order": 1} | form)))  # type: ignore[arg-type]
