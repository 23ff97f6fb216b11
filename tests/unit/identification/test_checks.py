"""Checks of a record: what is refused, why, and what passes; residual tests with their rate of false alarms."""

import math

import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.identification.checks import (
    amplitude,
    check_record,
    conditioning,
    independence,
    minus_log10_p,
    persistence,
    response_samples,
    sampling,
    variation,
    whiteness,
)
from reactorwatch.identification.data import ScaledRecord
from reactorwatch.identification.structure import Structure
from tests.unit.identification.truth import Array, Daisy, NoisyPlant

ROWS = np.arange(3000)


def sinusoids(*periods: float) -> Array:
    return np.asarray(np.sum([np.sin(2.0 * np.pi * ROWS / period) for period in periods], axis=0))


@pytest.mark.parametrize("period", [7.0, 21.3, 400.0])
@pytest.mark.parametrize("mean", [0.0, 100.0])
def test_a_single_sinusoid_is_refused_for_order_3_with_the_reason(period: float, mean: float) -> None:
    check = persistence(mean + sinusoids(period), 6)
    assert not check.passed
    assert (check.value, check.limit) == (2.0, 6.0)
    assert "as a single sinusoid does" in check.result
    assert "at least 3 sinusoids" in check.result


def test_a_sinusoid_with_a_little_noise_is_still_a_sinusoid() -> None:
    rng = np.random.default_rng(1)
    assert persistence(sinusoids(21.3) + 0.005 * rng.standard_normal(3000), 6).value == 2.0


def test_two_sinusoids_excite_order_four() -> None:
    assert persistence(sinusoids(21.3, 120.0), 6).value == 4.0
    assert persistence(sinusoids(21.3, 120.0), 4).passed


@pytest.mark.parametrize(
    "inputs",
    [
        sinusoids(21.3, 62.0, 299.0),
        sinusoids(100.0, 200.0, 330.0),
        np.sign(sinusoids(125.7)),
        np.repeat(np.random.default_rng(2).standard_normal(300), 10),
        np.random.default_rng(3).standard_normal(3000),
    ],
    ids=["three sinusoids", "three slow sinusoids", "square wave", "random steps", "white"],
)
def test_sums_of_sinusoids_square_waves_and_random_steps_pass(inputs: Array) -> None:
    assert persistence(95.0 + inputs, 6).result == "ok"


def test_a_constant_input_excites_nothing() -> None:
    check = persistence(np.full(1000, 98.7), 2)
    assert check.value == 0.0
    assert "a constant input excites none" in check.result


def test_gaps_do_not_count_as_moves() -> None:
    """A sinusoid with rows left out and times that say so is still one sinusoid."""
    kept = np.random.default_rng(4).random(3000) < 0.98
    assert persistence(sinusoids(21.3)[kept], 6, ROWS[kept].astype(float)).value == 2.0


def sampled_plant(period_min: float, noise_sd: float) -> tuple[Array, Array]:
    """An oscillating plant with the eigenvalues -1.34 +- 3.03i 1/min, its input held about 2 min, 4,000 samples."""
    rng = np.random.default_rng(5)
    pole = np.exp(complex(-1.34, 3.03) * period_min)
    a1, a2 = 2.0 * pole.real, -(abs(pole) ** 2)
    held = max(1, round(2.0 / period_min))
    u = np.repeat(rng.standard_normal(4000 // held + 1), held)[:4000]
    y = np.zeros(4000)
    for k in range(2, 4000):
        y[k] = a1 * y[k - 1] + a2 * y[k - 2] + (1.0 - a1 - a2) * u[k - 1]
    return u, y + noise_sd * rng.standard_normal(4000)


@pytest.mark.parametrize("noise_sd", [0.0, 0.05])
def test_a_sampling_rate_that_is_too_fast_gets_a_decimation_that_is_good(noise_sd: float) -> None:
    """Noise must not hide it: least squares would take it for fast dynamics."""
    u, y = sampled_plant(0.01, noise_sd)
    check = sampling(ScaledRecord.of(Structure.of_order(2), u, y))
    assert not check.passed
    assert "too fast" in check.result
    assert check.decimation > 1
    u, y = sampled_plant(0.01 * check.decimation, noise_sd)
    assert sampling(ScaledRecord.of(Structure.of_order(2), u, y)).passed


def test_a_good_sampling_rate_passes_and_a_slow_one_is_reported() -> None:
    assert sampling(ScaledRecord.of(Structure.of_order(2), *sampled_plant(0.1, 0.05))).passed
    check = sampling(ScaledRecord.of(Structure.of_order(2), *sampled_plant(1.0, 0.05)))
    assert "too slow" in check.result
    assert check.decimation == 1


def test_the_response_time_is_that_of_the_step_response() -> None:
    """With a = 0.9, 1 - 0.9^k reaches 0.95 at k = 29, whatever the delay; an input without effect has none."""
    assert response_samples(Structure(1, 1), np.array([0.9, 2.0, 0.0])) == 29.0
    assert response_samples(Structure(1, 1, delay=4), np.array([0.9, -2.0, 5.0])) == 29.0
    assert np.isnan(response_samples(Structure(1, 1), np.array([0.9, 0.0, 0.0])))
    assert np.isnan(response_samples(Structure(1, 1), np.array([1.0, 1.0, 0.0])))


def test_the_daisy_record_passes_for_orders_one_to_three(daisy: Daisy) -> None:
    for output in (daisy.C, daisy.T):
        for order in (1, 2, 3):
            checks = check_record(Structure.of_order(order), daisy.qc[:3750], output[:3750], daisy.time[:3750])
            assert [check.name for check in checks] == [
                "variation",
                "excitation",
                "sampling",
                "conditioning",
                "amplitude",
            ]
            assert all(check.passed for check in checks)


def test_the_amplitude_is_held_against_the_noise(noisy_plant: NoisyPlant) -> None:
    loud = noisy_plant.clean + 3.0 * np.std(noisy_plant.clean) * np.random.default_rng(6).standard_normal(4000)
    structure = Structure.of_order(2)
    check = amplitude(ScaledRecord.of(structure, noisy_plant.inputs, loud))
    assert not check.passed
    assert check.value == pytest.approx(1.0, abs=0.1)
    assert amplitude(ScaledRecord.of(structure, noisy_plant.inputs, noisy_plant.clean)).passed


def test_dependent_regressors_are_detected_by_their_condition_number() -> None:
    rng = np.random.default_rng(7)
    check = conditioning(ScaledRecord.of(Structure.of_order(1), np.ones(100), rng.standard_normal(100)))
    assert check.value == np.inf
    assert "nearly dependent" in check.result
    with pytest.raises(InputError, match="3 parameters need as many complete rows, got 1"):
        conditioning(ScaledRecord.of(Structure.of_order(1), np.ones(2), np.arange(2.0)))


def test_an_output_that_never_moves_ends_the_checks() -> None:
    checks = check_record(Structure.of_order(1), np.arange(50.0), np.full(50, 441.0))
    assert [check.name for check in checks] == ["variation"]
    assert "constant, 441" in checks[0].result
    assert variation([np.nan]).result == "the output has no measured value"


def test_an_input_that_does_not_excite_ends_them_before_what_needs_a_model() -> None:
    rng = np.random.default_rng(8)
    checks = check_record(Structure.of_order(3), sinusoids(30.0), sinusoids(30.0) + 0.1 * rng.standard_normal(3000))
    assert next(check.name for check in checks if not check.passed) == "excitation"
    assert "sampling" not in [check.name for check in checks]


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
