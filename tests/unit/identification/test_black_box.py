"""A polynomial state map with uncertain parameters predicts rows with honest variances."""

from functools import lru_cache
from math import inf, nan

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.identification.black_box_filter import (
    BINS,
    FLAGS,
    BlackBoxFilter,
    constants_of,
    filter_row,
)
from reactorwatch.identification.black_box_fit import (
    MOST_PARAMETERS,
    fit_black_box,
    held_out_residuals,
    largest_shapes,
    row_kinds,
)
from reactorwatch.identification.black_box_model import (
    NEXT,
    START,
    BlackBoxModel,
    Shape,
    lagged_inputs,
    prediction_errors,
)
from reactorwatch.stored_state import copy_of

NOISE_SD = np.array([0.1, 0.2])
TRAINING = 500


def simulate(inputs: Array, seed: int, noise_sd: Array = NOISE_SD) -> Array:
    """A quadratic plant with two outputs and one input, measured with noise."""
    x, rows = np.zeros(2), []
    for (u,) in inputs:
        rows.append(x)
        x = np.array([0.8 * x[0] + 0.1 * x[1] + 0.3 * u - 0.05 * u * u, 0.7 * x[1] - 0.2 * x[0] * u + 0.2 * u])
    return np.array(rows) + noise_sd * np.random.default_rng(seed).standard_normal((len(inputs), 2))


def steps(rows: int, seed: int, low: float = -1.0, high: float = 1.0) -> Array:
    """An input that is new every ten rows."""
    return np.repeat(np.random.default_rng(seed).uniform(low, high, rows // 10 + 1), 10)[:rows, None]


def following(rows: int) -> np.ndarray:
    return np.arange(rows) > 0


@lru_cache(maxsize=1)
def trained() -> tuple[BlackBoxModel, Array, Array]:
    inputs = steps(TRAINING, 1)
    outputs = simulate(inputs, 2)
    return fit_black_box(inputs, outputs, following(TRAINING), NOISE_SD / 100), inputs, outputs


def innovations(black_box: BlackBoxFilter, inputs: Array, outputs: Array) -> tuple[Array, list[bool]]:
    z, judged = np.full(outputs.shape, nan), []
    black_box.restart()  # these rows do not follow those of the training
    for k, (u, y) in enumerate(zip(inputs.tolist(), outputs.tolist(), strict=True)):
        prediction = black_box.update(u, y, [6.0] * len(y))
        judged.append(prediction is not None and prediction.judged)
        if prediction is not None and prediction.judged:
            z[k] = np.subtract(y, prediction.prediction) / prediction.sd
    return z, judged


def test_sensitivities_of_simulation_errors_are_those_of_finite_differences() -> None:
    shape = Shape(2, 1, 2, 2)
    rng = np.random.default_rng(3)
    theta = 0.1 * rng.standard_normal((2, shape.terms))
    y, u = rng.standard_normal((30, 2)), lagged_inputs(shape, rng.standard_normal((30, 1)))
    y[11, 0] = nan
    kinds = row_kinds(shape, y, u, following(30))
    errors, gram, slope = np.empty_like(y), np.empty((theta.size, theta.size)), np.empty(theta.size)
    weights = np.array([1.0, 3.0])

    def cost(parameters: Array) -> float:
        nothing = np.empty((0, 0))
        prediction_errors(
            parameters, shape.products(), shape.states, (y, u, kinds), 0.3, weights, errors, nothing, slope
        )
        return float(np.nansum(errors**2 * weights))

    prediction_errors(theta, shape.products(), shape.states, (y, u, kinds), 0.3, weights, errors, gram, slope)
    gradient = slope.copy()
    for i in range(0, theta.size, 5):
        step = np.zeros(theta.size)
        step[i] = 1e-6
        difference = cost(theta + step.reshape(theta.shape)) - cost(theta - step.reshape(theta.shape))
        assert -2.0 * gradient[i] == pytest.approx(difference / 2e-6, rel=1e-4, abs=1e-4)


def test_a_row_is_filtered_as_by_the_textbook_equations_of_state_and_parameters() -> None:
    model, inputs, outputs = trained()
    black_box = BlackBoxFilter(model)
    black_box.run(inputs, outputs, following(TRAINING))
    theta, covariance = black_box.parameters
    shape, m = model.shape, 1
    n_x, p = shape.states, 2
    first, past = FLAGS + BINS * m, shape.past * m
    x = black_box.belief[first + past : first + past + n_x].copy()
    P = black_box.belief[first + past + n_x + theta.size :].reshape(n_x + theta.size, -1).copy()
    signals_u = black_box.belief[first : first + past].copy()
    products = shape.products()

    def step(z: Array) -> Array:
        signals = np.concatenate([z[:n_x], signals_u])
        phi = np.array([np.prod(signals[[i for i in row if i >= 0]]) for row in products])
        return np.concatenate([(z[n_x:].reshape(p, -1) @ phi), z[: n_x - p], z[n_x:]])

    z = np.concatenate([x, theta])
    F = np.column_stack([(step(z + h) - step(z - h)) / 2e-6 for h in 1e-6 * np.eye(z.size)])
    prior = step(z)
    P[n_x:, n_x:] *= 1.0 + (1e-4 if np.all(np.diag(covariance) < np.diag(model.covariance)) else 0.0)
    P = F @ P @ F.T
    P[range(p), range(p)] += model.q
    H, R = np.eye(p, z.size), np.diag(model.r)
    S = H @ P @ H.T + R
    spreads, centres = np.array(model.spreads[:p]), np.array(model.centres[:p])
    measured = np.array([0.3, -0.2])
    posterior = prior + P @ H.T @ np.linalg.solve(S, (measured - centres) / spreads - prior[:p])

    prediction = black_box.update([0.4], measured.tolist(), [inf, inf])

    assert prediction is not None
    np.testing.assert_allclose(prediction.prediction, centres + spreads * prior[:p], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(prediction.sd, spreads * np.sqrt(np.diag(S)), rtol=1e-4)
    np.testing.assert_allclose(black_box.parameters[0], posterior[n_x:], rtol=1e-3, atol=1e-4)


def test_noisy_lags_leave_no_bias_where_least_squares_has_one() -> None:
    inputs = steps(2000, 4)
    x, rows = 0.0, []
    for (u,) in inputs:
        rows.append(x)
        x = 0.9 * x + 0.1 * u
    outputs = np.array(rows)[:, None] + 0.1 * np.random.default_rng(5).standard_normal((2000, 1))
    model = fit_black_box(inputs, outputs, following(2000), np.array([1e-3]))
    assert model.gain == 0.0
    assert model.lags == 1
    assert model.theta[0, 1] == pytest.approx(0.9, abs=0.01)
    regressors = np.column_stack([outputs[:-1], inputs[:-1], np.ones(1999)])
    assert np.linalg.lstsq(regressors, outputs[1:, 0], rcond=None)[0][0] < 0.85


def test_innovations_are_standard_normal_and_independent_beyond_the_training() -> None:
    model, inputs, outputs = trained()
    black_box = BlackBoxFilter(model)
    black_box.run(inputs, outputs, following(TRAINING))
    new_inputs = steps(4000, 6, -1.5, 1.5)
    z, judged = innovations(black_box, new_inputs, simulate(new_inputs, 7))
    z = z[np.isfinite(z).all(axis=1)]
    assert np.mean(judged) > 0.95
    np.testing.assert_allclose(z.std(axis=0), 1.0, atol=0.06)
    np.testing.assert_allclose(np.mean(z[1:] * z[:-1], axis=0), 0.0, atol=0.06)
    assert np.abs(z).max() < 5.0


def test_the_first_rows_of_an_unseen_point_are_not_judged_and_teach() -> None:
    model, inputs, outputs = trained()
    black_box = BlackBoxFilter(model)
    black_box.run(inputs, outputs, following(TRAINING))
    new_inputs = np.full((200, 1), 4.0)
    _, judged = innovations(black_box, new_inputs, simulate(new_inputs, 8))
    assert not any(judged[2:6])
    assert all(judged[-20:])


def test_a_plant_that_leaves_its_region_with_familiar_inputs_is_judged() -> None:
    model, inputs, outputs = trained()
    black_box = BlackBoxFilter(model)
    black_box.run(inputs, outputs, following(TRAINING))
    far = simulate(inputs[:200], 9) + np.linspace(0.0, 8.0, 200)[:, None]
    z, judged = innovations(black_box, inputs[:200], far)
    assert np.mean(judged) > 0.97
    assert np.abs(z[-20:]).max() > 6.0


def test_without_learning_the_parameters_stay_and_their_uncertainty_remains() -> None:
    model, inputs, outputs = trained()
    black_box = BlackBoxFilter(model)
    black_box.run(inputs, outputs, following(TRAINING))
    black_box.learning = False
    before = black_box.parameters
    new_inputs = np.full((200, 1), 4.0)
    _, judged = innovations(black_box, new_inputs, simulate(new_inputs, 8))
    for old, new in zip(before, black_box.parameters, strict=True):
        np.testing.assert_array_equal(old, new)
    assert not any(judged[-20:])


def test_the_covariance_is_bounded_without_excitation() -> None:
    model, inputs, outputs = trained()
    black_box = BlackBoxFilter(model)
    black_box.run(inputs, outputs, following(TRAINING))
    limit = np.trace(black_box.parameters[1] / np.diag(model.covariance))
    for _ in range(30_000):
        black_box.update([0.0], [0.0, 0.0], [inf, inf])
    assert np.sum(np.diag(black_box.parameters[1]) / np.diag(model.covariance)) <= 1.01 * limit
    assert np.linalg.eigvalsh(black_box.parameters[1]).min() > -1e-12


def test_a_filter_resumes_bit_for_bit_also_between_its_first_rows() -> None:
    model, inputs, outputs = trained()
    first = BlackBoxFilter(model)
    first.run(inputs, outputs, following(TRAINING))
    first.restart()
    for k in range(60):
        second = BlackBoxFilter(model, copy_of(first.memory))
        row = inputs[k].tolist(), outputs[k].tolist(), [6.0, 6.0]
        assert second.update(*row) == first.update(*row)
        assert second.memory.to_bytes() == first.memory.to_bytes()


def test_a_missing_value_corrects_nothing_and_a_missing_input_starts_again() -> None:
    model, inputs, outputs = trained()
    black_box = BlackBoxFilter(model)
    black_box.run(inputs, outputs, following(TRAINING))
    assert black_box.update([0.1], [nan, nan], [6.0, 6.0]) is not None
    assert black_box.update([nan], [0.0, 0.0], [6.0, 6.0]) is not None
    assert [black_box.update([0.1], [0.0, 0.0], [6.0, 6.0]) is None for _ in range(model.shape.past + 1)] == [
        *[True] * model.shape.past,
        False,
    ]


def test_rows_after_a_gap_start_again_when_the_state_is_known() -> None:
    shape = Shape(1, 1, 2, 1, delay=2)
    y, follows = np.zeros((12, 1)), following(12)
    follows[6], y[9] = False, nan
    kinds = row_kinds(shape, y, lagged_inputs(shape, np.zeros((12, 1))), follows)
    assert kinds.tolist() == [0, 0, START, NEXT, NEXT, NEXT, 0, 0, START, NEXT, NEXT, NEXT]


def test_a_training_at_rest_does_not_determine_the_dynamics_and_one_that_moves_does() -> None:
    at_rest = np.zeros((TRAINING, 1))
    rested = fit_black_box(at_rest, simulate(at_rest, 9), following(TRAINING), NOISE_SD / 100)
    assert rested.dynamics_sd > 0.2
    assert trained()[0].dynamics_sd < 0.1


@pytest.mark.parametrize(("outputs", "inputs"), [(1, 0), (1, 1), (2, 1), (3, 2), (8, 0)])
def test_any_few_signals_have_a_shape_within_the_bound(outputs: int, inputs: int) -> None:
    shapes = largest_shapes(outputs, inputs, 1000)
    assert shapes
    assert all(shape.parameters <= MOST_PARAMETERS for shape in shapes)


def test_too_many_signals_are_refused_in_one_line() -> None:
    with pytest.raises(InputError, match="a model of 52 outputs and 0 inputs needs at least"):
        fit_black_box(
            np.zeros((500, 0)), np.random.default_rng(1).standard_normal((500, 52)), following(500), np.ones(52)
        )


def test_a_filter_that_is_not_finite_fails_and_changes_nothing() -> None:
    model, _, _ = trained()
    constants = constants_of(model)
    black_box = BlackBoxFilter(model)
    black_box.belief[FLAGS + BINS + model.shape.past] = inf
    after, results = np.empty_like(black_box.belief), np.empty(11)
    assert filter_row(black_box.belief, np.zeros(9), constants, after, results) < 0.0


def test_a_coefficient_whose_variance_rounding_made_negative_is_not_determined() -> None:
    model = trained()[0]
    covariance = model.covariance.copy()
    covariance[1, 1] = -1e-12
    scaling, variances = (np.array(model.centres), np.array(model.spreads)), (np.array(model.r), np.array(model.q))
    damaged = BlackBoxModel.of(
        model.shape, model.rows, model.effective, model.gain, scaling, variances, model.theta, covariance
    )
    assert damaged.dynamics_sd == inf


def held_out_size(model: BlackBoxModel, inputs: Array, outputs: Array, smallest_sd: Array) -> Array:
    rows = inputs, outputs, following(len(inputs))
    return np.asarray(np.nanstd(held_out_residuals(model, rows, outputs, smallest_sd)[0], axis=0))


def test_held_out_blocks_separate_a_wrong_model_from_a_right_one() -> None:
    """A quadratic plant is described but for its noise; a plant with jumps of its slope is not, and has no noise."""
    right = held_out_size(*trained(), NOISE_SD / 100)
    assert np.all((right > 0.9) & (right < 1.1))
    inputs, x, rows = trained()[1], 0.0, []
    for (u,) in inputs:
        rows.append([x])
        x = 0.6 * x + 0.4 * abs(u + x)
    outputs, smallest_sd = np.array(rows), np.array([1e-9])
    wrong = fit_black_box(inputs, outputs, following(TRAINING), smallest_sd)
    assert held_out_size(wrong, inputs, outputs, smallest_sd) > 1.1


def test_larger_variances_leave_predictions_as_they_are() -> None:
    model, inputs, outputs = trained()
    runs = [BlackBoxFilter(item).run(inputs, outputs, following(TRAINING)) for item in (model, model.scale_sds(3.0))]
    np.testing.assert_allclose(runs[1][0], runs[0][0], atol=1e-9)
    np.testing.assert_allclose(runs[1][1], 3.0 * runs[0][1], rtol=1e-9)
