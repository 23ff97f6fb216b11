"""Linear models: ARX is least squares, the others the minimum of an independent solver, and all find known plants."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.optimize import least_squares as scipy_least_squares

from reactorwatch.errors import InputError
from reactorwatch.identification.data import plan_run
from reactorwatch.identification.least_squares import _triangle, least_squares
from reactorwatch.identification.linear import fit_linear, stabilize
from reactorwatch.identification.linear_model import (
    Kind,
    LinearModel,
    fit_percent,
    is_stable,
    predict_with_gradient,
    simulate,
    standard_deviations,
)
from reactorwatch.identification.structure import Structure
from tests.unit.identification.truth import (
    ARMA,
    ARMAX,
    ARX,
    BOX_JENKINS,
    OUTPUT_ERROR,
    Array,
    Daisy,
    NoisyPlant,
    System,
    oscillating_plant,
)


def recursion(parameters: Array, inputs: Array, structure: Structure, start: Array) -> Array:
    """The recursion of one input and output, written out."""
    y = list(start)
    n, m, (d,) = structure.output_lags, structure.input_lags, structure.delays
    for k in range(len(start), len(inputs)):
        past = sum(parameters[i] * y[k - 1 - i] for i in range(n))
        driven = sum(parameters[n + j] * inputs[k - d - j] for j in range(m))
        y.append(past + driven + parameters[-1])
    return np.array(y)


@pytest.mark.parametrize("output", ["C", "T"])
def test_arx_33_of_the_daisy_record_is_that_of_lapack(daisy: Daisy, output: str) -> None:
    """Against numpy.linalg.lstsq on the unscaled regressors, written out."""
    u, y = daisy.qc[:3750], getattr(daisy, output)[:3750]
    k = np.arange(3, 3750)
    regressors = np.column_stack([y[k - 1], y[k - 2], y[k - 3], u[k - 1], u[k - 2], u[k - 3], np.ones(k.size)])
    truth, rest, _, _ = np.linalg.lstsq(regressors, y[k])
    variances = rest[0] / (k.size - 7) * np.diag(np.linalg.inv(regressors.T @ regressors))
    model = fit_linear("arx", Structure.of_order(3), u, y, daisy.time[:3750])
    np.testing.assert_allclose(model.parameters, truth, rtol=1e-7)
    np.testing.assert_allclose(model.standard_deviations, np.sqrt(variances), rtol=1e-4)
    assert model.rows == 3747


def test_a_plant_without_noise_is_found_exactly() -> None:
    plant = oscillating_plant(500, noise_sd=0.0)
    model = fit_linear("arx", Structure.of_order(2), plant.inputs, plant.clean)
    np.testing.assert_allclose(model.parameters, plant.parameters, atol=1e-11)
    np.testing.assert_allclose(model.predict(plant.inputs, plant.clean)[2:, 0], plant.clean[2:], atol=1e-9)


def fit(system: System, seed: int, order: int = 2, kind: Kind = "armax") -> tuple[LinearModel, Array]:
    u, y = system.simulate(600, seed)
    noise = {"armax": system.c, "bj": (*system.d, *system.c)}.get(kind, ())
    truth = np.array([*system.f, *np.ravel(system.b), system.offset, *noise])
    return fit_linear(kind, Structure.of_order(order, inputs=system.inputs), u, y), truth


@pytest.mark.parametrize(
    ("system", "kind"),
    [(ARX, "arx"), (OUTPUT_ERROR, "oe"), (ARMAX, "armax"), (ARMA, "armax"), (BOX_JENKINS, "bj")],
)
def test_known_parameters_lie_within_their_standard_deviations(system: System, kind: Kind) -> None:
    """Over seeds the errors divided by their standard deviations have a mean square of 1."""
    errors = []
    for seed in range(6):
        model, truth = fit(system, seed, kind=kind)
        errors.append((model.parameters - truth) / model.standard_deviations)
        assert model.noise_sd == pytest.approx(system.noise_sd, rel=0.1)
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.4
    assert np.max(np.abs(errors)) < 4.5


@pytest.mark.slow
def test_standard_deviations_of_oe_are_the_scatter_over_many_records() -> None:
    """100 records with noise of their own: observed scatter of each parameter within 25 % (three sigma of it)."""
    found, told = [], []
    for seed in range(100):
        plant = oscillating_plant(600, noise_sd=0.5, seed=seed)
        model = fit_linear("oe", Structure.of_order(2), plant.inputs, plant.measured)
        found.append(model.parameters)
        told.append(model.standard_deviations)
    np.testing.assert_allclose(np.mean(told, axis=0), np.std(found, axis=0), rtol=0.25)
    np.testing.assert_allclose(np.mean(found, axis=0), plant.parameters, atol=4.0 * np.std(found, axis=0).max() / 10.0)


def test_a_plant_with_measurement_noise_is_found_where_arx_is_biased(noisy_plant: NoisyPlant) -> None:
    """All parameters within 4 standard deviations; those of ARX are off by more than 20."""
    structure = Structure.of_order(2)
    oe = fit_linear("oe", structure, noisy_plant.inputs, noisy_plant.measured)
    arx = fit_linear("arx", structure, noisy_plant.inputs, noisy_plant.measured)
    error = np.abs(oe.parameters - noisy_plant.parameters) / oe.standard_deviations
    assert error.max() < 4.0
    assert np.max(np.abs(arx.parameters - noisy_plant.parameters) / arx.standard_deviations) > 20.0
    assert oe.noise_sd == pytest.approx(noisy_plant.noise_sd, rel=0.05)
    assert oe.kind == "oe"


def test_the_minimum_is_that_of_an_independent_solver(noisy_plant: NoisyPlant) -> None:
    """The trust-region solver of SciPy, with differences, started from the true parameters, finds nothing lower."""
    u, y = noisy_plant.inputs[:800], noisy_plant.measured[:800]
    structure = Structure.of_order(2)
    plan = plan_run(structure, u[:, None], y[:, None])

    def errors(parameters: Array) -> Array:
        run = simulate(structure, parameters, u[:, None], y[:, None], plan)
        return (y[:, None] - run)[2:, 0]

    independent = scipy_least_squares(errors, noisy_plant.parameters, xtol=1e-12, ftol=1e-14, gtol=1e-14)
    model = fit_linear("oe", structure, u, y)
    assert np.sum(errors(model.parameters) ** 2) <= 2.0 * independent.cost * (1.0 + 1e-9)
    np.testing.assert_allclose(model.parameters, independent.x, rtol=1e-4)


@pytest.mark.parametrize("output", ["C", "T"])
def test_a_higher_order_never_runs_worse_over_the_fitted_rows(daisy: Daisy, output: str) -> None:
    """On the DaISy record, whose plant is not linear; and no model of it is unstable."""
    u, y = daisy.qc[:3750], getattr(daisy, output)[:3750]
    models = [fit_linear("oe", Structure.of_order(order), u, y) for order in (1, 2, 3)]
    # The sums of squares are over rows that start one later with each order.
    squares = [np.sum(model.residuals(u, y)[3:] ** 2) for model in models]
    assert squares[0] > squares[1] * (1.0 - 1e-3)
    assert squares[1] > squares[2] * (1.0 - 1e-3)
    arx = [fit_linear("arx", Structure.of_order(order), u, y) for order in (1, 2, 3)]
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
    model = fit_linear("oe", structure, u, y + 0.3 * rng.standard_normal(2000))
    assert np.max(np.abs(model.parameters - truth) / model.standard_deviations) < 4.0
    np.testing.assert_allclose(fit_linear("arx", structure, u, y).parameters, truth, rtol=1e-9)


def test_missing_rows_still_lead_to_the_plant(noisy_plant: NoisyPlant) -> None:
    rng = np.random.default_rng(3)
    u, y = noisy_plant.inputs.copy(), noisy_plant.measured.copy()
    y[rng.random(y.size) < 0.05] = np.nan
    u[1500:1510] = np.nan
    model = fit_linear("oe", Structure.of_order(2), u, y)
    assert np.max(np.abs(model.parameters - noisy_plant.parameters) / model.standard_deviations) < 4.0


@pytest.mark.parametrize(
    ("orders", "theta"),
    [
        ((2, 2, 2, 0), [1.2, -0.5, 0.7, 0.2, 0.4, -0.3, 0.3]),
        ((2, 2, 1, 2), [1.4, -0.6, 0.9, -0.5, 0.4, 0.2, 0.1, -0.3, -0.2, 0.5, 0.1]),
    ],
    ids=["oe", "bj"],
)
def test_the_gradient_is_the_derivative_of_the_prediction(
    orders: tuple[int, int, int, int], theta: list[float]
) -> None:
    """Against central differences, over a missing output, a missing input and a gap."""
    u, y = BOX_JENKINS.simulate(80, 1)
    y[20], u[40] = np.nan, np.nan
    structure = Structure(*orders[:2], (orders[2], orders[2] + 2), 2)
    plan = plan_run(structure, u, y[:, None], np.where(np.arange(80) < 60, np.arange(80.0), np.arange(80.0) + 9.0))
    assert plan.starts.sum() == 3

    def predict(parameters: Array) -> tuple[Array, Array]:
        return predict_with_gradient(parameters, (*structure.orders, orders[-1]), u, y, plan.arrays)

    predicted, gradient = predict(np.array(theta))
    assert np.isfinite(predicted[20])
    assert np.isnan(predicted[41])
    if orders[-1] == 0:
        run = simulate(structure, np.array(theta), u, y[:, None], plan)[:, 0]
        np.testing.assert_allclose(predicted, run, rtol=1e-12)
    for i, step in enumerate(1e-6 * np.eye(len(theta))):
        difference = (predict(theta + step)[0] - predict(theta - step)[0]) / 2e-6
        np.testing.assert_allclose(np.nan_to_num(difference), gradient[:, i], atol=1e-7)


def test_the_prediction_is_the_recursion_written_out() -> None:
    u, y = ARMAX.simulate(80, 2)
    model, _ = fit(ARMAX, 2)
    a1, a2, b11, b12, b21, b22, offset, c1, c2 = model.parameters
    e, expected = np.zeros(80), np.full(80, np.nan)
    for k in range(2, 80):
        expected[k] = a1 * y[k - 1] + a2 * y[k - 2] + offset + c1 * e[k - 1] + c2 * e[k - 2]
        expected[k] += b11 * u[k - 1, 0] + b12 * u[k - 1, 1] + b21 * u[k - 2, 0] + b22 * u[k - 2, 1]
        e[k] = y[k] - expected[k]
    np.testing.assert_allclose(model.predict(u, y)[:, 0], expected, rtol=1e-9)


def test_a_box_jenkins_model_finds_white_noise_on_an_output_error_system() -> None:
    model, truth = fit(OUTPUT_ERROR, 3, order=1, kind="bj")
    assert model.parameter_count == 6
    second, _ = fit(OUTPUT_ERROR, 3, kind="bj")
    plant = slice(0, 7)
    errors = (second.parameters[plant] - truth[plant]) / second.standard_deviations[plant]
    assert np.max(np.abs(errors)) < 4.0
    assert second.noise_sd == pytest.approx(0.5, rel=0.1)
    assert second.noise_sd < model.noise_sd


def test_the_free_run_is_the_recursion_on_its_own_output() -> None:
    rng = np.random.default_rng(6)
    structure = Structure(2, 3, delay=2)
    parameters = np.array([0.9, -0.3, 1.0, 0.5, -0.2, 0.7])
    u, y = rng.standard_normal(60), rng.standard_normal(60)
    model = LinearModel("oe", structure, parameters, np.zeros((6, 6)), 0.0, 1.0, 60)
    run = model.simulate(u, y)[:, 0]
    assert np.all(np.isnan(run[:4]))
    np.testing.assert_allclose(run[4:], recursion(parameters, u, structure, y[:4])[4:], rtol=1e-12)


def test_a_free_run_bridges_missing_outputs_and_restarts_after_gaps() -> None:
    """Outputs missing in rows 10-12, an input in row 20, a gap before row 30; order 1 starts from one row."""
    rng = np.random.default_rng(7)
    u, y = rng.standard_normal(40), rng.standard_normal(40)
    y[10:13], u[20] = np.nan, np.nan
    time = np.arange(40.0)
    time[30:] += 5.0
    parameters = np.array([0.5, 1.0, 0.0])
    model = LinearModel("oe", Structure.of_order(1), parameters, np.zeros((3, 3)), 0.0, 1.0, 40)
    run = model.simulate(u, y, time)[:, 0]
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(run)), [0, 21, 30])
    assert run[13] == pytest.approx(0.5 * run[12] + u[12])
    assert run[22] == pytest.approx(0.5 * y[21] + u[21])
    assert run[31] == pytest.approx(0.5 * y[30] + u[30])


def test_fit_percent_is_100_for_the_truth_0_for_the_mean_and_minus_infinity_for_a_run_away() -> None:
    y = np.array([1.0, 2.0, 4.0, 5.0])
    assert fit_percent(y, y) == 100.0
    assert fit_percent(y, np.full(4, 3.0)) == pytest.approx(0.0)
    assert fit_percent(y, [np.nan, 2.0, 4.0, 5.0]) == 100.0
    assert fit_percent(y, [1.0, 2.0, 4.0, np.inf]) == -np.inf
    assert np.isnan(fit_percent([1.0, 1.0], [1.0, 2.0]))
    unstable = LinearModel("arx", Structure.of_order(1), np.array([9.0, 1.0, 0.0]), np.zeros((3, 3)), 0.0, 1.0, 9)
    rng = np.random.default_rng(8)
    u, measured = rng.standard_normal(300), rng.standard_normal(300)
    assert fit_percent(measured, unstable.simulate(u, measured)[:, 0]) == -np.inf


def test_as_many_rows_as_parameters_leave_no_doubt_to_estimate() -> None:
    rng = np.random.default_rng(10)
    model = fit_linear("arx", Structure.of_order(1), rng.standard_normal(4), rng.standard_normal(4))
    assert model.rows == 3
    assert np.all(np.isinf(model.standard_deviations))


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


RNG = np.random.default_rng(9)
U, Y = RNG.standard_normal(50), RNG.standard_normal(50)


@pytest.mark.parametrize(
    ("kind", "structure", "u", "y", "match"),
    [
        ("arx", Structure.of_order(1), U, np.full(50, 3.0), "output 1 is constant, 3 in all rows: there is nothing"),
        ("arx", Structure.of_order(3), U[:6], Y[:6], r"7 parameters need at least 7 rows .*, got 3 of 6"),
        ("arx", Structure.of_order(1), np.ones(50), Y, "don't determine 3 parameters: condition number"),
        ("oe", Structure.of_order(1), U, np.column_stack([Y, Y]), "outputs must have the shape"),
        ("oe", Structure.of_order(3), U[:8], Y[:8], "7 parameters need at least 7 rows"),
        ("oe", Structure.of_order(1), np.ones(50), Y, "don't determine 3 parameters"),
        ("armax", Structure.of_order(2), U[:8], Y[:8], "7 parameters need at least 7 rows of a prediction, got 6 of 8"),
        ("bj", Structure.of_order(2, inputs=0), np.empty((50, 0)), Y, r"needs an input, got none; .* use armax"),
    ],
)
def test_records_that_determine_nothing_are_refused_with_the_cause(
    kind: Kind, structure: Structure, u: Array, y: Array, match: str
) -> None:
    with pytest.raises(InputError, match=match):
        fit_linear(kind, structure, u, y)


def test_equations_that_determine_nothing_are_refused_with_the_cause() -> None:
    with pytest.raises(InputError, match=r"regressors must be finite, got \[nan\] in row 2"):
        least_squares([[1.0], [np.nan], [2.0]], [1.0, 2.0, 3.0])
    with pytest.raises(InputError, match="2 parameters need at least 2 complete rows, got 1"):
        least_squares([[1.0, 2.0]], [1.0])
    with pytest.raises(InputError, match="equally many rows, got 2 and 3"):
        least_squares([[1.0], [2.0]], [1.0, 2.0, 3.0])


ENTRIES = st.sampled_from([0.0, 1.0, -1.0, 1e-300, 1e150, np.inf, -np.inf, np.nan]) | st.floats(-1e6, 1e6)
N = 3


@settings(max_examples=200)
@given(hnp.arrays(float, (N, N), elements=ENTRIES), hnp.arrays(float, (2, N), elements=st.floats(-1e6, 1e6)))
def test_standard_deviations_are_never_nan_whatever_the_covariance(covariance: np.ndarray, matrix: np.ndarray) -> None:
    with np.errstate(over="ignore", invalid="ignore"):
        for found in (standard_deviations(covariance), standard_deviations(covariance, matrix)):
            assert np.all(found >= 0.0)


def test_standard_deviations_of_a_sound_covariance_are_the_roots_of_its_diagonal() -> None:
    factor = np.random.default_rng(1).normal(size=(N, N))
    matrix = np.random.default_rng(2).normal(size=(2, N))
    np.testing.assert_allclose(
        standard_deviations(factor @ factor.T, matrix), np.linalg.norm(matrix @ factor, axis=1), rtol=1e-12
    )
