"""Models that learn row by row, against those of all rows at once."""

import numpy as np
import pytest

from reactorwatch.identification.linear_predictor import Kind, is_stable
from reactorwatch.identification.output_error import fit_oe
from reactorwatch.identification.prediction_error import fit_armax, fit_box_jenkins
from reactorwatch.identification.recursive_prediction_error import RecursivePredictionError
from reactorwatch.identification.structure import Scaling, Structure
from tests.unit.identification.systems import ARMA, ARMAX, BOX_JENKINS, System
from tests.unit.identification.truth import NoisyPlant, oscillating_plant


def test_recursive_prediction_error_reaches_the_batch_model(noisy_plant: NoisyPlant) -> None:
    """One pass over 4,000 rows from zero parameters: within one standard deviation of the batch minimum."""
    structure = Structure.of_order(2)
    running = RecursivePredictionError(structure, Scaling.of(noisy_plant.inputs, noisy_plant.measured))
    for u, y in zip(noisy_plant.inputs, noisy_plant.measured, strict=True):
        running.update([u], y)
    batch, model = fit_oe(structure, noisy_plant.inputs, noisy_plant.measured), running.model
    assert np.max(np.abs(model.parameters - batch.parameters) / batch.standard_deviations) < 1.0
    np.testing.assert_allclose(model.standard_deviations, batch.standard_deviations, rtol=0.2)
    assert np.max(np.abs(model.parameters - noisy_plant.parameters) / model.standard_deviations) < 4.0


@pytest.mark.parametrize(("system", "kind"), [(ARMAX, "armax"), (ARMA, "armax"), (BOX_JENKINS, "bj")])
def test_recursive_models_of_the_disturbance_reach_the_batch_models(system: System, kind: Kind) -> None:
    """One pass over 4,000 rows from zero parameters: within one standard deviation of the batch minimum."""
    u, y = system.simulate(4000, 1)
    structure = Structure.of_order(2, inputs=system.inputs)
    running = RecursivePredictionError(structure, Scaling.of(u, y), kind=kind)
    for inputs, output in zip(u, y, strict=True):
        running.update(inputs, float(output))
    batch, model = (fit_armax if kind == "armax" else fit_box_jenkins)(structure, u, y), running.model
    assert np.max(np.abs(model.parameters - batch.parameters) / batch.standard_deviations) < 1.0
    np.testing.assert_allclose(model.standard_deviations, batch.standard_deviations, rtol=0.2)
    assert model.noise_sd == pytest.approx(batch.noise_sd, rel=0.02)


def test_it_follows_a_plant_that_changes() -> None:
    """The gain doubles in the middle; with forgetting 0.99 the last parameters are those of the new plant."""
    plant = oscillating_plant(6000, noise_sd=0.1)
    u = plant.inputs
    running = RecursivePredictionError(Structure.of_order(2), forgetting=0.99)
    y = np.zeros(2)
    for k in range(2, 6000):
        gain = 1.0 if k < 3000 else 2.0
        new = 1.5 * y[1] - 0.7 * y[0] + gain * (u[k - 1] + 0.5 * u[k - 2]) + 0.3
        y = np.array([y[1], new])
        running.update([u[k]], new + 0.1 * np.random.default_rng(k).standard_normal())
    np.testing.assert_allclose(running.model.parameters, [1.5, -0.7, 2.0, 1.0, 0.3], atol=0.15)


def test_its_poles_stay_inside_the_unit_circle_whatever_comes() -> None:
    """An unstable plant's record, and noise: at every row the model is stable and everything finite."""
    rng = np.random.default_rng(2)
    running = RecursivePredictionError(Structure.of_order(2), forgetting=0.95)
    y = 0.0
    for k in range(400):
        u = rng.standard_normal()
        running.update([u], y)
        y = 1.05 * y + u if k % 100 else 0.0
        model = running.model
        assert is_stable(model.parameters[:2])
        assert np.all(np.isfinite(model.parameters))


def test_a_row_that_is_not_complete_is_refused_and_changes_nothing() -> None:
    running, untouched = (RecursivePredictionError(Structure.of_order(1)) for _ in range(2))
    rng = np.random.default_rng(3)
    for u, y in rng.standard_normal((20, 2)):
        running.update([u], y)
        untouched.update([u], y)
    for inputs, output in (([np.nan], 1.0), ([1.0], np.nan), ([1.0, 2.0], 1.0)):
        with pytest.raises(ValueError, match="a row must have 1 finite inputs and a finite output"):
            running.update(inputs, output)
    assert running.update([0.5], 0.3) == untouched.update([0.5], 0.3)
    np.testing.assert_array_equal(running.model.covariance, untouched.model.covariance)
    running.restart()
    assert running.update([1.0], 1.0) is None
    assert running.model.rows == 20
