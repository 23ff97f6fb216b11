"""Output-error models: exact gradients, known plants, an independent solver."""

import numpy as np
import pytest
from scipy.optimize import least_squares as scipy_least_squares

from reactorwatch.errors import InputError
from reactorwatch.identification.batch import fit_arx
from reactorwatch.identification.descent import _triangle
from reactorwatch.identification.instrumental_variable import stabilize
from reactorwatch.identification.linear_predictor import is_stable, predict_with_gradient
from reactorwatch.identification.output_error import fit_oe
from reactorwatch.identification.simulation import plan_run, simulate
from reactorwatch.identification.structure import RowChoice, Structure
from tests.unit.identification.truth import Array, Daisy, NoisyPlant, oscillating_plant


def test_a_plant_with_measurement_noise_is_found_where_arx_is_biased(noisy_plant: NoisyPlant) -> None:
    """All parameters within 4 standard deviations; those of ARX are off by more than 20."""
    structure = Structure.of_order(2)
    oe = fit_oe(structure, noisy_plant.inputs, noisy_plant.measured)
    arx = fit_arx(structure, noisy_plant.inputs, noisy_plant.measured)
    error = np.abs(oe.parameters - noisy_plant.parameters) / oe.standard_deviations
    assert error.max() < 4.0
    assert np.max(np.abs(arx.parameters - noisy_plant.parameters) / arx.standard_deviations) > 20.0
    assert oe.noise_sd == pytest.approx(noisy_plant.noise_sd, rel=0.05)
    assert oe.kind == "oe"


@pytest.mark.slow
def test_standard_deviations_are_the_scatter_over_many_records() -> None:
    """100 records with noise of their own: observed scatter of each parameter within 25 % (three sigma of it)."""
    found, told = [], []
    for seed in range(100):
        plant = oscillating_plant(600, noise_sd=0.5, seed=seed)
        model = fit_oe(Structure.of_order(2), plant.inputs, plant.measured)
        found.append(model.parameters)
        told.append(model.standard_deviations)
    np.testing.assert_allclose(np.mean(told, axis=0), np.std(found, axis=0), rtol=0.25)
    np.testing.assert_allclose(np.mean(found, axis=0), plant.parameters, atol=4.0 * np.std(found, axis=0).max() / 10.0)


def test_the_gradient_is_the_derivative_of_the_run() -> None:
    """Against central differences, with a gap and a missing input that make the run start anew."""
    rng = np.random.default_rng(1)
    structure = Structure(2, 2, delay=2)
    theta = np.array([1.2, -0.5, 0.7, 0.4, 0.3])
    u, y = rng.standard_normal((80, 1)), rng.standard_normal((80, 1))
    u[30] = np.nan
    time = np.where(np.arange(80) < 60, np.arange(80.0), np.arange(80.0) + 9.0)
    plan = plan_run(structure, u, y, time)
    assert plan.starts.sum() == 3

    def run(parameters: Array) -> tuple[Array, Array]:
        return predict_with_gradient(parameters, (2, 2, 2, 0), u, y[:, 0], plan.arrays)

    values, gradient = run(theta)
    np.testing.assert_allclose(values, simulate(structure, theta, u, y, plan)[:, 0], rtol=1e-12)
    for i in range(theta.size):
        step = np.zeros(theta.size)
        step[i] = 1e-6
        difference = (run(theta + step)[0] - run(theta - step)[0]) / 2e-6
        np.testing.assert_allclose(gradient[plan.running, i], difference[plan.running], atol=1e-7)


def test_the_minimum_is_that_of_an_independent_solver(noisy_plant: NoisyPlant) -> None:
    """The trust-region solver of SciPy, with differences, started from the true parameters, finds nothing lower."""
    u, y = noisy_plant.inputs[:800], noisy_plant.measured[:800]
    structure = Structure.of_order(2)
    plan = plan_run(structure, u[:, None], y[:, None])

    def errors(parameters: Array) -> Array:
        run = simulate(structure, parameters, u[:, None], y[:, None], plan)
        return (y[:, None] - run)[2:, 0]

    independent = scipy_least_squares(errors, noisy_plant.parameters, xtol=1e-12, ftol=1e-14, gtol=1e-14)
    model = fit_oe(structure, u, y)
    assert np.sum(errors(model.parameters) ** 2) <= 2.0 * independent.cost * (1.0 + 1e-9)
    np.testing.assert_allclose(model.parameters, independent.x, rtol=1e-4)


@pytest.mark.parametrize("output", ["C", "T"])
def test_a_higher_order_never_runs_worse_over_the_fitted_rows(daisy: Daisy, output: str) -> None:
    """On the DaISy record, whose plant is not linear; and no model of it is unstable."""
    u, y = daisy.qc[:3750], getattr(daisy, output)[:3750]
    models = [fit_oe(Structure.of_order(order), u, y) for order in (1, 2, 3)]
    # The sums of squares are over rows that start one later with each order.
    squares = [np.sum(model.residuals(u, y)[3:] ** 2) for model in models]
    assert squares[0] > squares[1] * (1.0 - 1e-3)
    assert squares[1] > squares[2] * (1.0 - 1e-3)
    arx = [fit_arx(Structure.of_order(order), u, y) for order in (1, 2, 3)]
    assert all(s < np.sum((y[:, None] - m.simulate(u, y))[3:] ** 2) for s, m in zip(squares, arx, strict=True))
    poles = [np.roots([1.0, *-model.parameters[: model.structure.output_lags]]) for model in models]
    assert all(np.abs(roots).max() < 1.0 for roots in poles)


def test_delay_several_inputs_and_no_offset() -> None:
    rng = np.random.default_rng(2)
    structure = Structure(1, 2, delay=3, inputs=2, offset=False)
    truth = np.array([0.8, 1.0, -0.5, 0.3, 0.7])
    u, y = rng.standard_normal((2000, 2)), np.zeros(2000)
    for k in range(4, 2000):
        y[k] = truth @ np.concatenate([[y[k - 1]], u[k - 3], u[k - 4]])
    model = fit_oe(structure, u, y + 0.3 * rng.standard_normal(2000))
    assert np.max(np.abs(model.parameters - truth) / model.standard_deviations) < 4.0


def test_missing_rows_and_chosen_rows_still_lead_to_the_plant(noisy_plant: NoisyPlant) -> None:
    rng = np.random.default_rng(3)
    u, y = noisy_plant.inputs.copy(), noisy_plant.measured.copy()
    y[rng.random(y.size) < 0.05] = np.nan
    u[1500:1510] = np.nan
    model = fit_oe(Structure.of_order(2), u, y)
    assert np.max(np.abs(model.parameters - noisy_plant.parameters) / model.standard_deviations) < 4.0
    chosen = fit_oe(Structure.of_order(2), u, noisy_plant.measured, choice=RowChoice(99, 6))
    assert chosen.rows < 700
    assert np.max(np.abs(chosen.parameters - noisy_plant.parameters) / chosen.standard_deviations) < 4.0


def test_stable_agrees_with_the_roots() -> None:
    """10,000 random polynomials of orders 1 to 5, about half of them stable."""
    rng = np.random.default_rng(4)
    stable_ones = 0
    for _ in range(10_000):
        order = int(rng.integers(1, 6))
        a = rng.uniform(-1.0, 1.0, order) * rng.uniform(0.3, 2.0)
        radius = np.abs(np.roots([1.0, *-a])).max()
        if abs(radius - 1.0) > 1e-9:
            assert is_stable(a) == (radius < 1.0)
            stable_ones += radius < 1.0
    assert 3000 < stable_ones < 8000
    assert not is_stable(np.array([np.nan]))


def test_poles_outside_the_circle_are_mirrored_into_it() -> None:
    structure = Structure.of_order(2)
    outside = np.array([*-np.poly([2.0, 0.5])[1:], 1.0, 1.0, 0.0])
    inside = stabilize(structure, outside)
    np.testing.assert_allclose(np.sort(np.roots([1.0, *-inside[:2]])), [0.49, 0.5], rtol=1e-12)
    np.testing.assert_array_equal(inside[2:], outside[2:])


def test_the_triangle_is_that_of_lapack() -> None:
    matrix = np.random.default_rng(5).standard_normal((50, 6))
    matrix[:, 3] = 0.0
    ours = _triangle(np.ascontiguousarray(matrix.T))
    np.testing.assert_allclose(ours.T @ ours, matrix.T @ matrix, atol=1e-12)
    np.testing.assert_array_equal(ours, np.triu(ours))


def test_records_that_determine_nothing_are_refused_with_the_cause() -> None:
    rng = np.random.default_rng(6)
    u, y = rng.standard_normal(50), rng.standard_normal(50)
    with pytest.raises(InputError, match="outputs must have the shape"):
        fit_oe(Structure.of_order(1), u, np.column_stack([y, y]))
    with pytest.raises(InputError, match="output 1 is constant"):
        fit_oe(Structure.of_order(1), u, np.zeros(50))
    with pytest.raises(InputError, match="7 parameters need at least 7 rows"):
        fit_oe(Structure.of_order(3), u[:8], y[:8])
    with pytest.raises(InputError, match="don't determine 3 parameters"):
        fit_oe(Structure.of_order(1), np.ones(50), y)
