"""One hypothesis: its loss, its derivatives, its way down, and the plateaus that a sensor's onset has."""

from math import inf, sqrt

import numpy as np
import pytest

from monitor_node.isolation.causes import CAUSES
from monitor_node.isolation.hypothesis import Descent, Hypothesis
from monitor_node.isolation.segment import HUBER, LOST, Stretch
from monitor_node.isolation.window import Window, window_of
from reactorwatch.kalman.ekf import Filter
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.process.profiles import RAMP, STEP
from tests.unit.monitor_node.faulty import ONSET_MIN, SENSORS, rows_of

BEGIN, SIZE = 150, 2.0


def effect_of(name: str) -> Effect:
    return next(effect for effect in CAUSES if effect.name == name)


@pytest.fixture(scope="module")
def biased() -> Window:
    rows = rows_of(f"temperature_bias:step:{SIZE}", seed=1, after_min=5.0, begin_min=40.0)
    window = window_of(rows, Filter(cstr(), SENSORS))
    assert window is not None
    return window


@pytest.fixture(scope="module")
def stretch(biased: Window) -> Stretch:
    return Stretch(biased, BEGIN, biased.time_min.size, Filter(cstr(), SENSORS))


@pytest.fixture(scope="module")
def bias() -> Hypothesis:
    return Hypothesis(cstr(), SENSORS, effect_of("temperature_bias"), STEP)


@pytest.fixture(scope="module")
def descent(stretch: Stretch, bias: Hypothesis) -> Descent:
    return Descent(bias, stretch)


def test_the_loss_is_minus_the_log_likelihood_up_to_a_constant(
    biased: Window, stretch: Stretch, bias: Hypothesis
) -> None:
    loss, w = bias.loss(stretch, SIZE, ONSET_MIN)
    assert np.max(np.abs(w)) < HUBER
    kalman = Filter(effect_of("temperature_bias").extend(cstr(), STEP), SENSORS)
    kalman.set_parameters({"temperature_bias.size": SIZE, "temperature_bias.onset": ONSET_MIN})
    part = slice(BEGIN + 1, None)
    record = biased.time_min[part], biased.inputs[part], biased.measured[part]
    likelihood = np.sum(kalman.run(*record, start=biased.states[BEGIN]).log_likelihood)
    assert loss == pytest.approx(-likelihood - 0.5 * w.size * np.log(2 * np.pi), rel=1e-9)


def test_far_values_count_in_proportion_and_those_of_a_lost_filter_as_very_far(
    biased: Window, stretch: Stretch
) -> None:
    nominal = Hypothesis(cstr(), SENSORS, effect_of("temperature_bias"), STEP)
    near, far = (nominal.loss(stretch, size, ONSET_MIN).value for size in (-40.0, -41.0))
    since = np.sum(biased.time_min >= ONSET_MIN)
    assert far - near == pytest.approx(HUBER * since * 1.0 / 0.3, rel=0.02)
    blown_up = Hypothesis(cstr(), SENSORS, effect_of("reaction_heat"), STEP)
    loss, w = blown_up.loss(stretch, 4.0, ONSET_MIN)
    assert np.isfinite(loss)
    assert np.max(w) == LOST


def test_its_slope_is_that_of_the_innovations(descent: Descent) -> None:
    """A bias sets in in the middle of the interval: it enters every value since as it is."""
    point = descent.at(SIZE, ONSET_MIN + 0.02)
    slope = descent.slope(point, 0.05)
    since = 51 - 1
    assert slope.size_sd == pytest.approx(0.3 / sqrt(since), rel=0.1)
    np.testing.assert_allclose(slope.of_w[1], 0.0, atol=1e-3)  # on the plateau


@pytest.mark.parametrize("start", [0.5, 1.5, 4.0])
def test_one_step_finds_the_size_of_a_bias(descent: Descent, start: float) -> None:
    point = descent.at(start, ONSET_MIN)
    found = descent.stepped(point, descent.slope(point, 0.05))
    assert found.loss < point.loss
    assert found.size == pytest.approx(SIZE, abs=5 * 0.3 / sqrt(50))


def test_a_step_from_the_edge_of_a_plateau_still_finds_the_size(descent: Descent) -> None:
    point = descent.at(0.5, 60.1)
    found = descent.stepped(point, descent.slope(point, 0.05))
    assert found.size == pytest.approx(SIZE, abs=5 * 0.3 / sqrt(50))


@pytest.mark.parametrize("away", [-0.3, -0.1, 0.1, 0.3])
def test_an_onset_some_rows_away_is_moved(descent: Descent, away: float) -> None:
    point = descent.at(SIZE, 60.05 + away)
    slope = descent.slope(point, 0.05)
    moved, rise = descent.jumped(point, slope)
    assert 60.0 < moved.onset_min <= 60.1
    found, sd = descent.onset(moved, rise, slope)
    assert found.onset_min == pytest.approx(60.05)
    assert sd == pytest.approx(0.1 / sqrt(12.0))


def test_sizes_stay_possible() -> None:
    loss_of_heat = effect_of("heat_loss")
    step, ramp = (Hypothesis(cstr(), SENSORS, loss_of_heat, profile) for profile in (STEP, RAMP))
    assert step.limited(-1.0, 10.0, 20.0) == 0.0
    assert step.limited(inf, 10.0, 20.0) == loss_of_heat.upper
    assert ramp.limited(inf, 10.0, 20.0) == pytest.approx(loss_of_heat.upper / 10.0)


def test_a_ramp_is_told_by_the_size_that_it_has_reached(biased: Window, stretch: Stretch) -> None:
    ramp = Hypothesis(cstr(), SENSORS, effect_of("temperature_bias"), RAMP)
    descent = Descent(ramp, stretch)
    point = descent.at(0.4, 60.0)
    slope = descent.slope(point, 0.01)
    reached, sd = descent.reached(point, slope)
    end_min = float(biased.time_min[-1])
    assert reached == pytest.approx(0.4 * (end_min - 60.0))
    by = np.array([end_min - 60.0, -0.4])  # of slope and onset
    assert sd == pytest.approx(sqrt(by @ np.linalg.inv(slope.information) @ by))
