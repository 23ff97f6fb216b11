"""Differences between a simulation and a record are located in time and along every signal, apart from noise."""

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.difference import BINS, TIME, Difference, compute_difference
from reactorwatch.sentences.diagnosis import describe_difference

ROWS, NOISE = 8000, 0.3
T_MIN: Array = np.linspace(0.0, 800.0, ROWS)


def of(error: Array, qc: Array | None = None) -> Difference:
    rng = np.random.default_rng(2)
    noise = NOISE * rng.standard_normal(ROWS)
    flow = rng.permutation(np.linspace(90.0, 110.0, ROWS)) if qc is None else qc
    return compute_difference(error + noise, noise / NOISE, NOISE, "K", T_MIN, {"qc": (flow, "l/min")}, 0.1)


def test_noise_alone_is_reported_as_noise() -> None:
    """The root mean square of 8,000 rows has a standard error of 0.8 %."""
    found = of(np.zeros(ROWS))
    assert found.rmse == pytest.approx(NOISE, rel=0.04)
    assert found.noise_share > 0.9
    assert describe_difference(found).endswith("of it noise")
    assert not found.matters


def test_the_share_of_noise_is_that_of_its_variance() -> None:
    """An error of twice the noise leaves a fifth of the mean square to the noise."""
    assert of(np.full(ROWS, 2.0 * NOISE)).noise_share == pytest.approx(0.2, abs=0.01)


def test_the_worst_stretch_of_time_and_the_worst_operating_points_are_found() -> None:
    """An error from 400 to 500 min, a second one at high flow."""
    flow = np.random.default_rng(3).permutation(np.linspace(90.0, 110.0, ROWS))
    found = of(np.where((T_MIN >= 400.0) & (T_MIN < 500.0), 3.0, 0.0) + np.where(flow > 107.5, -2.5, 0.0), flow)
    when, where = found.worst(TIME), found.worst("qc")
    assert when is not None
    assert where is not None
    assert (when.lower, when.upper) == pytest.approx((400.0, 500.0), abs=0.2)
    assert (where.lower, where.upper) == pytest.approx((107.5, 110.0), abs=0.01)
    assert where.mean < -1.0
    assert found.matters
    assert "; most from 400 to 500 min" in describe_difference(found)


def test_all_rows_lie_in_some_range() -> None:
    found = of(np.zeros(ROWS))
    for ranges in found.along.values():
        assert len(ranges) == BINS
        assert sum(part.rows for part in ranges) == ROWS


def test_a_run_that_diverged_has_no_ranges_and_reports_it() -> None:
    nothing = np.full(ROWS, np.nan)
    found = compute_difference(nothing, nothing, NOISE, "K", T_MIN, {"T": (nothing, "K")}, 0.1)
    assert found.worst("T") is None
    assert found.matters
    assert "ran away" in describe_difference(found)


def test_an_input_that_takes_two_values_has_two_ranges_at_most() -> None:
    """Quantiles that coincide are one."""
    found = of(np.zeros(ROWS), np.repeat([95.0, 105.0], ROWS // 2))
    assert len(found.along["qc"]) <= 2
    assert sum(part.rows for part in found.along["qc"]) == ROWS
