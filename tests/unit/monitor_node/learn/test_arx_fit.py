"""Identified models that judge: orders, errors of held-out rows, and the leverage in their limits."""

import numpy as np
import pytest
from scipy.signal import lfilter

from monitor_node.config import MonitorConfig
from monitor_node.learn import arx_fit
from monitor_node.learn.arx import ArxReference
from monitor_node.learn.training_rows import RowArrays
from reactorwatch.arrays import Array

ROWS = 1000


def levels(rng: np.random.Generator, rows: int, hold: int) -> Array:
    """An input with a new level every `hold` rows."""
    return np.repeat(rng.uniform(-1.0, 1.0, rows // hold + 1), hold)[:rows]


def test_held_out_residuals_are_those_of_fits_without_each_block() -> None:
    rng = np.random.default_rng(1)
    regressors, y = rng.normal(size=(205, 4)), rng.normal(size=205)
    residual, leverage = arx_fit.held_out_residuals(regressors, y)
    for block in np.array_split(np.arange(205), 10):
        others = np.delete(regressors, block, axis=0)
        theta = np.linalg.lstsq(others, np.delete(y, block), rcond=None)[0]
        assert residual[block] == pytest.approx(y[block] - regressors[block] @ theta, abs=1e-7)
        unit = np.linalg.inv(others.T @ others)
        assert leverage[block] == pytest.approx(np.diag(regressors[block] @ unit @ regressors[block].T), rel=1e-7)


def test_an_input_that_moves_in_one_block_only_is_unknown_to_the_others() -> None:
    rng = np.random.default_rng(2)
    moved = np.concatenate([np.zeros(950), np.ones(50)])
    y = 5.0 * moved + 0.1 * rng.normal(size=ROWS)
    residual, leverage = arx_fit.held_out_residuals(np.column_stack([np.ones(ROWS), moved]), y)
    assert np.mean(residual[950:]) == pytest.approx(5.0, abs=0.1)
    assert leverage[950:].min() > 1e3 * leverage[:900].max()


def fitted(inputs: Array, outputs: Array, order: int | None = None) -> tuple[ArxReference, Array]:
    models = ArxReference(MonitorConfig(inputs=("u",), outputs=("y",), process="", order=order), points=False)
    rows = RowArrays(np.arange(len(outputs)) / 60.0, inputs[:, None], outputs[:, None])
    arx_fit.learn_again(models, rows)
    return models, arx_fit.fit_models(models, rows, to_judge=True)[:, 0]


@pytest.mark.parametrize(
    ("dead_time", "noise_sd", "orders"), [(1, 0.0, {3}), (1, 0.1, {8, 20}), (15, 0.1, {20})], ids=str
)
def test_the_order_covers_dead_time_and_noise_of_measurement(dead_time: int, noise_sd: float, orders: set[int]) -> None:
    """One lag explains a first-order plant; its noise of measurement, or a dead time, takes many."""
    found = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        u = levels(rng, ROWS, 40)
        delayed = np.concatenate([np.full(dead_time, u[0]), u[:-dead_time]])
        y = lfilter([0.1], [1.0, -0.9], delayed + 0.3 * rng.normal(size=ROWS)) + noise_sd * rng.normal(size=ROWS)
        models, _ = fitted(u, np.asarray(y))
        found.append(models.predictors[0].structure.output_lags)
    assert sum(order in orders for order in found) >= 8


def test_a_stated_order_is_used() -> None:
    rng = np.random.default_rng(1)
    u = levels(rng, ROWS, 40)
    models, _ = fitted(u, lfilter([0.1], [1.0, -0.9], u) + 0.1 * rng.normal(size=ROWS), order=5)
    assert models.predictors[0].structure.output_lags == 5


@pytest.mark.parametrize(("curvature", "least", "most"), [(0.0, 1.0, 2.0), (0.5, 4.0, 64.0)], ids=["linear", "curved"])
def test_the_variance_grows_with_leverage_as_that_of_a_linear_plant_does_and_more_on_a_curved_one(
    curvature: float, least: float, most: float
) -> None:
    """The prediction of a new row has the variance 1 + phi' P phi in units of the noise's."""
    gains = []
    for seed in range(11):
        rng = np.random.default_rng(seed)
        u = levels(rng, ROWS, 40)
        y = lfilter([0.0, 0.1], [1.0, -0.9], u + curvature * u**2) + 0.0
        y = np.asarray(y) + lfilter([1.0], [1.0, -0.9], 0.01 * rng.normal(size=ROWS))
        gains.append(fitted(u, y, order=3)[0].predictors[0].leverage_gain)
    assert least <= np.median(gains) <= most
