"""The expected evidence of an input, against closed forms and against records with noise."""

from math import exp

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.experiment.predictions import Prediction, decision_probability, extrapolate
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant, PiecewiseLinear, Ramp, Sine
from reactorwatch.diagnosis.run import Run
from tests.unit.diagnosis.linear_tank import NOISE, NOISE_SD, PERIOD_MIN, RATE, Gain, Shift, explained, follows, tank
from tests.unit.diagnosis.linear_tank import record as tank_record

ROWS = 300
SIZES = (0.02, 0.1)
"""Of the gain and of the shift: at a level of 5 they are the same."""


def steps(reach: float, rows: int = ROWS, seed: int = 3) -> Array:
    return np.repeat(5.0 + reach * np.random.default_rng(seed).uniform(-1.0, 1.0, rows // 10), 10)


def alternatives(reach: float) -> tuple[Prediction, Prediction, Run]:
    """The two, and what the first predicts."""
    record = tank_record(steps(1.0))
    resting = np.array([5.0])
    gain, shift = (
        Prediction(item.hypothesis, item.fit, record, resting, 300, 30.0)
        for item in (explained(Gain(), SIZES[0], record), explained(Shift(), SIZES[1], record))
    )
    time_min = gain.start_min + PERIOD_MIN * np.arange(ROWS, dtype=np.float64)
    u = steps(reach)[:, None]
    outputs = gain.predict_outputs(time_min, u)
    assert outputs is not None
    return gain, shift, Run(time_min, u, outputs)


def closed_form(u: Array) -> float:
    """Part of a gain that a shift from any start cannot imitate, by least squares, in units of the noise."""
    truth = follows((1.0 + SIZES[0]) * u, 5.0 * (1.0 + SIZES[0]))
    base = follows(u, 0.0)
    of_start = exp(-RATE * PERIOD_MIN) ** np.arange(u.size)
    of_shift = 1.0 - of_start
    columns = np.column_stack([of_start, of_shift])
    left = (truth - base) - columns @ np.linalg.lstsq(columns, truth - base, rcond=None)[0]
    return float(left @ left) / NOISE_SD**2


@pytest.mark.parametrize("reach", [1.0, 4.0])
def test_of_a_linear_plant_the_expected_evidence_is_the_noncentrality_of_the_likelihood_ratio(reach: float) -> None:
    gain, shift, truth = alternatives(reach)
    np.testing.assert_allclose(
        truth.measured[:, 0], follows((1.0 + SIZES[0]) * truth.inputs[:, 0], 5.0 * (1.0 + SIZES[0])), atol=1e-6
    )
    expected = closed_form(truth.inputs[:, 0])
    assert shift.noncentrality(truth) == pytest.approx(expected, rel=0.02)  # which leaves out the second row
    assert 2.0 * (shift.loss(truth) - gain.own_loss(truth)) == pytest.approx(expected, rel=0.02)
    assert gain.noncentrality(truth) == pytest.approx(0.0, abs=1e-6)


def test_with_noise_the_evidence_scatters_about_its_expectation_as_the_probability_implies() -> None:
    gain, shift, truth = alternatives(4.0)
    expected = 2.0 * (shift.loss(truth) - gain.own_loss(truth))
    profiles = (Constant(truth.time_min),)
    both = [Hypothesis(FaultFilter(tank(), (effect,), NOISE), profiles) for effect in (Gain(), Shift())]
    random, found = np.random.default_rng(8), []
    for _ in range(150):
        noisy = Run(truth.time_min, truth.inputs, truth.measured + NOISE_SD * random.standard_normal((ROWS, 1)))
        losses = [item.fit(noisy, [np.array([size])]).loss for item, size in zip(both, SIZES, strict=True)]
        found.append(2.0 * (losses[1] - losses[0]))
    error = np.std(found) / np.sqrt(len(found))
    assert np.mean(found) == pytest.approx(expected, abs=3.5 * error)
    assert np.std(found) == pytest.approx(2.0 * np.sqrt(expected), rel=3.5 / np.sqrt(2 * len(found)))
    decided, share = np.mean(np.array(found) > 10.0), decision_probability(expected, expected)
    assert decided == pytest.approx(share, abs=3.5 * np.sqrt(share * (1.0 - share) / len(found)))


def test_evidence_that_noise_of_the_process_would_hide_does_not_count() -> None:
    _, shift, truth = alternatives(4.0)
    disturbed = explained(Shift(), SIZES[1], truth)
    disturbed.hypothesis.filter.noise = Noise(NOISE.measurement_sd, (0.1,))
    other = Prediction(disturbed.hypothesis, disturbed.fit, truth, np.array([5.0]), 300, 30.0)
    assert 0.0 < other.noncentrality(truth) < 0.7 * shift.noncentrality(truth)


@pytest.mark.parametrize(("profile", "parameters"), [(Ramp, [2.0, 10.0]), (PiecewiseLinear, [0.0, 1.0, 2.0])])
def test_what_has_set_in_stays_as_large_as_it_was_at_the_end(
    profile: type[Ramp] | type[PiecewiseLinear], parameters: list[float]
) -> None:
    record_min = np.arange(0.0, 50.0, 0.1)
    there = Ramp(record_min) if profile is Ramp else PiecewiseLinear(record_min, 3)
    later, numbers = extrapolate(there, np.array(parameters), np.arange(60.0, 70.0, 0.1), 60.0)
    np.testing.assert_allclose(later.signal(numbers).sample_value, 2.0)


def test_an_oscillation_persists() -> None:
    parameters, later_min = np.array([0.6, -0.8, 7.0]), np.arange(81.3, 95.0, 0.1)
    later, numbers = extrapolate(Sine(np.arange(2.0, 50.0, 0.1)), parameters, later_min, 60.0)
    angle = 2.0 * np.pi * (later_min - 2.0) / 7.0
    np.testing.assert_allclose(later.signal(numbers).sample_value, 0.6 * np.sin(angle) - 0.8 * np.cos(angle), atol=1e-9)
