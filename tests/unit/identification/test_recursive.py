"""Models that learn row by row, against the batch ones, and their memory."""

import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.identification.batch import fit_arx
from reactorwatch.identification.output_error import fit_oe, is_stable
from reactorwatch.identification.recursive_arx import RecursiveArx, RecursiveArxState
from reactorwatch.identification.recursive_output_error import RecursiveOutputError, RecursiveOutputErrorState
from reactorwatch.identification.structure import REPORT_ROWS, RowChoice, Scaling, Structure
from tests.unit.identification.truth import Daisy, NoisyPlant, oscillating_plant


@pytest.mark.parametrize(("order", "choice"), [(3, RowChoice()), (2, REPORT_ROWS)], ids=["all rows", "report's rows"])
def test_recursive_arx_without_forgetting_is_batch_arx(daisy: Daisy, order: int, choice: RowChoice) -> None:
    """Of C and T of the DaISy record together, in the signals' own units, standard deviations too."""
    u, y = daisy.qc[:2000], np.column_stack([daisy.C, daisy.T])[:2000]
    structure = Structure.of_order(order, outputs=2)
    recursive = RecursiveArx(structure, Scaling.of(u, y), choice=choice)
    for k in range(2000):
        recursive.update(k, u[k : k + 1], y[k])
    batch, model = fit_arx(structure, u, y, choice=choice), recursive.model
    np.testing.assert_allclose(model.parameters, batch.parameters, rtol=1e-9)
    np.testing.assert_allclose(model.standard_deviations, batch.standard_deviations, rtol=1e-6)
    np.testing.assert_allclose(model.noise_sd, batch.noise_sd, rtol=1e-9)
    assert model.condition == pytest.approx(batch.condition, rel=1e-9)
    assert model.rows == recursive.rows == batch.rows


def test_it_predicts_in_the_outputs_own_units_before_it_learns() -> None:
    plant = oscillating_plant(300, noise_sd=0.1)
    y = 440.0 + 5.0 * plant.measured
    recursive = RecursiveArx(Structure.of_order(2), Scaling.of(plant.inputs, y))
    for k in range(300):
        upcoming = recursive.predict()
        said = recursive.update(k, [plant.inputs[k]], [y[k]])
        if said is not None and upcoming is not None:
            assert said[0].prediction == pytest.approx(upcoming[0], rel=1e-13)
            assert said[0].residual == pytest.approx(y[k] - upcoming[0], abs=1e-9)
    assert said is not None
    assert said[0].residual_sd == pytest.approx(recursive.model.noise_sd[0], rel=0.1)


def test_a_gap_costs_the_rows_that_reach_over_it() -> None:
    recursive = RecursiveArx(Structure.of_order(2), period_ns=10)
    times = [0, 10, 20, 30, 60, 70, 80, 90]
    values = np.random.default_rng(1).standard_normal((8, 2))
    answered = [recursive.update(t, [u], [y]) is not None for t, (u, y) in zip(times, values, strict=True)]
    assert answered == [False, False, True, True, False, False, True, True]
    assert recursive.update(100, [np.nan], [0.0]) is None


def test_a_start_from_a_model_is_that_model() -> None:
    plant = oscillating_plant(400, noise_sd=0.1)
    structure = Structure.of_order(2)
    model = fit_arx(structure, plant.inputs, plant.measured)
    scaling = Scaling.of(plant.inputs, plant.measured)
    recursive = RecursiveArx(structure, scaling, forgetting=0.99, start=model)
    np.testing.assert_allclose(recursive.model.parameters, model.parameters, rtol=1e-9)
    running = RecursiveOutputError(structure, scaling, start=model)
    np.testing.assert_allclose(running.model.parameters, model.parameters, rtol=1e-9)
    for kind in (RecursiveArx, RecursiveOutputError):
        with pytest.raises(ValueError, match="the model to start from must have the structure"):
            kind(Structure.of_order(3), start=model)


def test_recursive_output_error_reaches_the_batch_model(noisy_plant: NoisyPlant) -> None:
    """One pass over 4,000 rows from zero parameters: within one standard deviation of the batch minimum."""
    structure = Structure.of_order(2)
    running = RecursiveOutputError(structure, Scaling.of(noisy_plant.inputs, noisy_plant.measured))
    for u, y in zip(noisy_plant.inputs, noisy_plant.measured, strict=True):
        running.update([u], y)
    batch, model = fit_oe(structure, noisy_plant.inputs, noisy_plant.measured), running.model
    assert np.max(np.abs(model.parameters - batch.parameters) / batch.standard_deviations) < 1.0
    np.testing.assert_allclose(model.standard_deviations, batch.standard_deviations, rtol=0.2)
    assert np.max(np.abs(model.parameters[0] - noisy_plant.parameters) / model.standard_deviations[0]) < 4.0


def test_it_follows_a_plant_that_changes() -> None:
    """The gain doubles in the middle; with forgetting 0.99 the last parameters are those of the new plant."""
    plant = oscillating_plant(6000, noise_sd=0.1)
    u = plant.inputs
    running = RecursiveOutputError(Structure.of_order(2), forgetting=0.99)
    y = np.zeros(2)
    for k in range(2, 6000):
        gain = 1.0 if k < 3000 else 2.0
        new = 1.5 * y[1] - 0.7 * y[0] + gain * (u[k - 1] + 0.5 * u[k - 2]) + 0.3
        y = np.array([y[1], new])
        running.update([u[k]], new + 0.1 * np.random.default_rng(k).standard_normal())
    np.testing.assert_allclose(running.model.parameters[0], [1.5, -0.7, 2.0, 1.0, 0.3], atol=0.15)


def test_its_poles_stay_inside_the_unit_circle_whatever_comes() -> None:
    """An unstable plant's record, and noise: at every row the model is stable and everything finite."""
    rng = np.random.default_rng(2)
    running = RecursiveOutputError(Structure.of_order(2), forgetting=0.95)
    y = 0.0
    for k in range(400):
        u = rng.standard_normal()
        running.update([u], y)
        y = 1.05 * y + u if k % 100 else 0.0
        model = running.model
        assert is_stable(model.parameters[0, :2])
        assert np.all(np.isfinite(model.parameters))


def test_a_row_that_is_not_complete_is_refused_and_changes_nothing() -> None:
    running = RecursiveOutputError(Structure.of_order(1))
    rng = np.random.default_rng(3)
    for u, y in rng.standard_normal((20, 2)):
        running.update([u], y)
    before = running.state
    for inputs, output in (([np.nan], 1.0), ([1.0], np.nan), ([1.0, 2.0], 1.0)):
        with pytest.raises(ValueError, match="a row must have 1 finite inputs and a finite output"):
            running.update(inputs, output)
    assert running.state == before
    running.restart()
    assert running.update([1.0], 1.0) is None
    assert running.rows == 19


def test_several_outputs_and_a_falling_forgetting_are_refused() -> None:
    with pytest.raises(InputError, match="an output-error model has one output, got 2"):
        RecursiveOutputError(Structure.of_order(1, outputs=2))
    with pytest.raises(ValueError, match=r"forgetting must be in \(0, 1\], got 1.5"):
        RecursiveArx(Structure.of_order(1), forgetting=1.5)


def test_stored_models_go_on_with_the_same_bits() -> None:
    """At every row of 60: store, restore, and both go on alike."""
    rng = np.random.default_rng(4)
    structure = Structure(2, 2, delay=2)
    arx = RecursiveArx(structure, Scaling((1.0,), (2.0,), (3.0,), (4.0,)), 0.97)
    running = RecursiveOutputError(structure, Scaling((1.0,), (2.0,), (3.0,), (4.0,)), 0.97)
    for k in range(60):
        u, y = rng.standard_normal(2)
        arx_too = RecursiveArx.from_state(RecursiveArxState.from_bytes(arx.state.to_bytes()))
        running_too = RecursiveOutputError.from_state(RecursiveOutputErrorState.from_bytes(running.state.to_bytes()))
        assert arx.update(k, [u], [y]) == arx_too.update(k, [u], [y])
        assert running.update([u], y) == running_too.update([u], y)
        assert arx.state == arx_too.state
        assert running.state == running_too.state
