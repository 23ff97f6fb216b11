"""Lasting errors of a model away from its rows: found where they are, of the size that they have, and not elsewhere."""

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.spc.extrapolation import WEIGHT, average_inputs, fit_extrapolation

ROWS, HOLD, CHART = 1000, 50, 0.1


def staircase(rng: np.random.Generator, inputs: int) -> Array:
    """Levels of inputs, each held for `HOLD` rows, at different times."""
    levels = np.repeat(rng.standard_normal((ROWS // HOLD + 1, inputs)), HOLD, axis=0)
    return np.column_stack([np.roll(column, 17 * i) for i, column in enumerate(levels.T)])[:ROWS]


def size_at(u: Array, e: Array, sds: float) -> float:
    """Standard deviation of averages that is found so far from the mean of each input, by the median of the plants."""
    found = fit_extrapolation(average_inputs(u), e, CHART)
    assert found is not None
    averages = average_inputs(u)
    return found.extrapolation.sds(averages.mean(axis=0) + sds * averages.std(axis=0))[1]


@pytest.mark.parametrize("inputs", [1, 2, 3])
def test_white_residuals_are_found_to_grow_little(inputs: int) -> None:
    sizes = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        sizes.append(size_at(staircase(rng, inputs), rng.standard_normal((ROWS, 2)), 1.0))
    assert np.median(sizes) < 1.1


@pytest.mark.parametrize("outputs", [1, 3])
def test_a_lasting_error_that_grows_with_the_distance_is_found_to_its_size(outputs: int) -> None:
    """By construction: at each level of the input the error is normal with 0.3 standard deviations times the level.

    An average of weight 0.1 has then sqrt(1 + 19 * (0.3 u)^2) times the standard deviation of noise at a level u.
    """
    ratios = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        u, others = staircase(rng, 1), rng.standard_normal((ROWS, outputs))
        others[:, 0] += 0.3 * u[:, 0] * np.repeat(rng.standard_normal(ROWS // HOLD), HOLD)
        level = 2.0 * float(average_inputs(u).std())
        ratios.append(size_at(u, others, 2.0) / np.sqrt(1.0 + 19.0 * (0.3 * level) ** 2))
    assert 0.75 < np.median(ratios) < 1.33


def test_averages_are_those_of_the_recursion_and_go_on_where_a_value_is_missing() -> None:
    rng = np.random.default_rng(0)
    u = rng.standard_normal((200, 2))
    u[50:60, 0] = u[:5, 1] = np.nan
    newest = np.array([u[0, 0], u[5, 1]])  # before the first value, that is taken
    expected = newest.copy()
    for row, found in zip(u, average_inputs(u), strict=True):
        newest = np.where(np.isfinite(row), row, newest)
        expected += WEIGHT * (newest - expected)
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_residuals_without_noise_show_no_growth() -> None:
    found = fit_extrapolation(average_inputs(staircase(np.random.default_rng(0), 2)), np.zeros((ROWS, 1)), CHART)
    assert found is not None
    assert np.all(np.isfinite(found.sds_of_averages))
    assert found.sds_of_averages.max() < 1.1


@pytest.mark.parametrize("e", [np.full((ROWS, 2), np.nan), np.ones((9, 1))])
def test_too_few_residuals_show_no_growth(e: Array) -> None:
    assert fit_extrapolation(np.random.default_rng(0).standard_normal((len(e), 1)), e, CHART) is None


def test_an_input_that_never_moved_has_no_distance() -> None:
    rng = np.random.default_rng(0)
    u = np.column_stack([staircase(rng, 1), np.full(ROWS, 7.0)])
    found = fit_extrapolation(average_inputs(u), rng.standard_normal((ROWS, 1)), CHART)
    assert found is not None
    assert found.extrapolation.sds(np.array([u[:, 0].mean(), 9.0])) == found.extrapolation.sds(u.mean(axis=0))
