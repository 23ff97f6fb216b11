"""Recursive least squares, against exact arithmetic, dense algebra and statistics."""

import numpy as np
import pytest

from reactorwatch.identification.linear_model import standard_deviations
from reactorwatch.identification.rls import RecursiveLeastSquares, RlsMemory
from tests.unit.identification.truth import Array, exact_least_squares

EPSILON = np.finfo(np.float64).eps


def learn(regressors: Array, outputs: Array, **settings: float) -> RecursiveLeastSquares:
    rls = RecursiveLeastSquares(regressors.shape[1], **settings)
    for row, output in zip(regressors, outputs, strict=True):
        rls.update(row, output)
    return rls


def collinear(rng: np.random.Generator, rows: int, n: int = 7, condition: float = 1e8) -> Array:
    """Random regressors of a given condition number, the weak directions across all columns."""
    left, _ = np.linalg.qr(rng.standard_normal((rows, n)))
    right, _ = np.linalg.qr(rng.standard_normal((n, n)))
    return np.asarray(left * np.geomspace(1.0, 1.0 / condition, n) @ right.T * np.sqrt(rows))


def relative(value: Array, truth: Array) -> float:
    return float(np.linalg.norm(value - truth) / np.linalg.norm(truth))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["condition 1e8", "unlike units", "ill-conditioned beginning"])
def test_without_forgetting_it_is_batch_least_squares(kind: str, seed: int) -> None:
    """The exact solution to 1e-9: collinear regressors, units that differ by 1e8, and powers of a slow ramp."""
    rng = np.random.default_rng(seed)
    units = np.geomspace(1e4, 1e-4, 7) if kind == "unlike units" else np.ones(7)
    regressors = {
        "condition 1e8": collinear(rng, 1000),
        "unlike units": rng.standard_normal((1000, 7)) * units,
        "ill-conditioned beginning": np.vander(np.linspace(0.05, 0.95, 1500), 7, increasing=True),
    }[kind]
    noise = 0.0 if kind == "condition 1e8" else 0.01
    outputs = regressors @ (rng.standard_normal(7) / units) + noise * rng.standard_normal(len(regressors))
    exact = exact_least_squares(regressors, outputs)
    assert relative(learn(regressors, outputs).parameters * units, exact * units) < 1e-9


@pytest.mark.parametrize("seed", range(3))
def test_noise_on_collinear_data_costs_no_more_than_the_problem_itself(seed: int) -> None:
    """With residuals the solution moves by eps (k + k^2 |r| / (|X| |p|)), Golub and Van Loan section 5.3.7."""
    rng = np.random.default_rng(seed)
    regressors = collinear(rng, 1000)
    outputs = regressors @ rng.standard_normal(7) + 0.01 * rng.standard_normal(1000)
    truth = exact_least_squares(regressors, outputs)
    rest = np.linalg.norm(outputs - regressors @ truth)
    sensitivity = 1e8 + 1e16 * rest / (np.linalg.norm(regressors, 2) * np.linalg.norm(truth))
    assert relative(learn(regressors, outputs).parameters, truth) < EPSILON * sensitivity


def test_as_many_rows_as_parameters_are_met_exactly() -> None:
    rng = np.random.default_rng(5)
    regressors, outputs = rng.standard_normal((4, 4)), rng.standard_normal(4)
    rls = learn(regressors, outputs)
    np.testing.assert_allclose(regressors @ rls.parameters, outputs, atol=1e-12)
    assert np.all(np.isinf(standard_deviations(rls.parameter_covariance))), "no row is left to tell the noise"


def test_a_column_without_information_gets_the_parameter_zero_and_no_certainty() -> None:
    """Two equal columns and an empty one, no prior: what they share is found, what would split them is inf."""
    rng = np.random.default_rng(6)
    x = rng.standard_normal(200)
    regressors = np.column_stack([x, x, np.zeros(200), np.ones(200)])
    rls = learn(regressors, 2.0 * x + 1.0 + 0.1 * rng.standard_normal(200))
    np.testing.assert_allclose(rls.parameters, [2.0, 0.0, 0.0, 1.0], atol=0.05)
    np.testing.assert_array_equal(np.isinf(standard_deviations(rls.parameter_covariance)), [True, True, True, False])
    assert np.isinf(rls.condition)


def test_forgetting_weighs_rows_by_their_age() -> None:
    """Batch least squares with the weights 0.98^age, solved by LAPACK, at a negligible floor."""
    rng = np.random.default_rng(7)
    regressors = rng.standard_normal((400, 5))
    outputs = regressors @ rng.standard_normal(5) + rng.standard_normal(400)
    root = 0.98 ** (0.5 * np.arange(399, -1, -1))
    batch, rest, _, values = np.linalg.lstsq(regressors * root[:, None], outputs * root)
    rls = learn(regressors, outputs, forgetting=0.98, covariance_limit=1e20)
    np.testing.assert_allclose(rls.parameters, batch, rtol=1e-9)
    assert rls.condition == pytest.approx(values[0] / values[-1], rel=1e-9)
    weights = root**2
    free = weights.sum() - 5 * (weights**2).sum() / weights.sum()
    assert rls.noise_variance == pytest.approx(float(rest[0]) / free, rel=1e-9)


def test_the_covariance_follows_the_published_recursion() -> None:
    """A <- f A + phi phi' + one coordinate's floor in turn, with dense matrices; it never exceeds the limit."""
    rng = np.random.default_rng(8)
    n, forgetting, limit = 4, 0.9, 50.0
    floor = 1.0 / limit
    information = floor / forgetting ** (n - 1) * np.eye(n)
    rls = RecursiveLeastSquares(n, forgetting, limit)
    for k in range(300):
        regressor = rng.standard_normal(n) * [1.0, 1.0, 1e-3, 0.0] * (k % 100 < 50)
        rls.update(regressor, rng.standard_normal())
        information = forgetting * information + np.outer(regressor, regressor)
        information[k % n, k % n] += floor * (1.0 - forgetting**n) / forgetting ** (n - 1)
        np.testing.assert_allclose(rls.covariance, np.linalg.inv(information), rtol=1e-10, atol=1e-12)
        assert np.linalg.eigvalsh(rls.covariance)[-1] <= limit * (1.0 + 1e-12)


@pytest.mark.parametrize("forgetting", [1.0, 0.99])
@pytest.mark.parametrize("level", [0.0, 1.0])
def test_a_million_rows_without_excitation_leave_it_sound(forgetting: float, level: float) -> None:
    """Identified, then 1e6 equal rows, then excited again by a changed plant: bounded, unmoved, and awake."""
    rng = np.random.default_rng(9)
    n, limit = 7, 1e4
    rls = RecursiveLeastSquares(n, forgetting, limit)
    first, second = rng.standard_normal(n), rng.standard_normal(n)
    lively = rng.standard_normal((500, n))
    for row in lively:
        rls.update(row, row @ first)
    np.testing.assert_allclose(rls.parameters, first, atol=1e-4)
    before = rls.parameters
    silence = np.full(n, level)
    output = float(silence @ before)
    for _ in range(1_000_000):
        rls.update(silence, output)
    np.testing.assert_allclose(rls.parameters, before, atol=1e-7)
    eigenvalues = np.linalg.eigvalsh(rls.covariance)
    assert eigenvalues[-1] <= limit * (1.0 + 1e-9)
    rows_in_memory = 1_000_500 if forgetting == 1.0 else 1.0 / (1.0 - forgetting)
    largest = max(n * level**2, *np.sum(lively**2, axis=1))
    assert 1.0 / eigenvalues[0] <= rows_in_memory * largest + 1.0 / (limit * forgetting ** (n - 1))
    assert np.all(np.isfinite(standard_deviations(rls.parameter_covariance)))
    assert rls.rows == 1_000_500
    for row in rng.standard_normal((3000, n)):
        rls.update(row, row @ second)
    assert np.all(np.isfinite(rls.parameters))
    # Without forgetting the old plant's rows, and the constant level, keep their weight for ever: that is its meaning.
    if forgetting < 1.0:
        np.testing.assert_allclose(rls.parameters, second, atol=1e-6)


def test_noise_on_a_resting_plant_does_not_move_the_unexcited_directions() -> None:
    """Constant regressors, noise of 0.1 for 1e5 rows: the level is learned, differences move by less than 0.01."""
    rng = np.random.default_rng(10)
    rls = RecursiveLeastSquares(3, 0.99)
    rls.set_parameters([1.0, -2.0, 0.5])
    for noise in rng.standard_normal(100_000):
        rls.update([1.0, 1.0, 1.0], 7.0 + 0.1 * noise)
    parameters = rls.parameters
    assert parameters.sum() == pytest.approx(7.0, abs=0.1)
    np.testing.assert_allclose(np.diff(parameters), [-3.0, 2.5], atol=0.01)


@pytest.mark.parametrize("forgetting", [1.0, 0.98])
def test_standard_deviations_are_the_scatter_of_many_plants(forgetting: float) -> None:
    """4,000 plants, each with its own regressors and noise: reported and observed scatter agree to 5 %."""
    rng = np.random.default_rng(11)
    plants, n, rows = 4000, 4, 300
    truth = np.array([1.0, -0.5, 2.0, 0.3])
    found = [RecursiveLeastSquares(n, forgetting) for _ in range(plants)]
    for _ in range(rows):
        regressors = rng.standard_normal((plants, n)) * [1.0, 0.3, 2.0, 1.0]
        outputs = regressors @ truth + 0.2 * rng.standard_normal(plants)
        last = [rls.update(*row) for rls, *row in zip(found, regressors, outputs.tolist(), strict=True)]
    parameters = np.array([rls.parameters for rls in found])
    observed = np.std(parameters, axis=0)
    reported = np.sqrt(np.mean([standard_deviations(rls.parameter_covariance) ** 2 for rls in found[::20]], axis=0))
    np.testing.assert_allclose(reported, observed, rtol=0.05)
    np.testing.assert_allclose(np.mean(parameters, axis=0), truth, atol=4 * observed.max() / np.sqrt(plants))
    residuals, deviations = np.transpose([(update.residual, update.residual_sd) for update in last])
    assert np.std(residuals) == pytest.approx(np.sqrt(np.mean(deviations**2)), rel=0.05)


@pytest.mark.parametrize("forgetting", [1.0, 0.99])
def test_the_leverage_of_a_row_is_the_variance_of_its_prediction(forgetting: float) -> None:
    rng = np.random.default_rng(5)
    rls = learn(rng.standard_normal((200, 6)), rng.standard_normal(200), forgetting=forgetting)
    row, before = rng.standard_normal(6), rls.memory.to_bytes()
    assert rls.leverage(row) == pytest.approx(row @ rls.covariance @ row, rel=1e-9)
    assert rls.memory.to_bytes() == before


def test_the_prediction_is_made_before_the_row_is_used() -> None:
    rng = np.random.default_rng(12)
    rls = learn(rng.standard_normal((20, 3)), rng.standard_normal(20))
    row = rng.standard_normal(3)
    expected = rls.predict(row)
    said = rls.update(row, 5.0)
    assert said.prediction == pytest.approx(expected, rel=1e-13)
    assert said.residual == 5.0 - said.prediction
    assert 5.0 - rls.predict(row) == pytest.approx(said.residual * (1.0 - said.leverage), rel=1e-9)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
def test_a_value_that_is_no_measurement_is_refused_and_harms_nothing(bad: float) -> None:
    rng = np.random.default_rng(13)
    rls = learn(rng.standard_normal((20, 3)), rng.standard_normal(20), forgetting=0.9)
    before = rls.memory.to_bytes()
    with pytest.raises(ValueError, match=r"regressor\[1\] must be a finite number"):
        rls.update([1.0, bad, 1.0], 1.0)
    with pytest.raises(ValueError, match="output must be a finite number"):
        rls.update([1.0, 1.0, 1.0], bad)
    with pytest.raises(ValueError, match="regressor must have shape"):
        rls.update([1.0, 1.0], 1.0)
    assert rls.memory.to_bytes() == before


@pytest.mark.parametrize("forgetting", [0.95, 1.0])
def test_moving_the_parameters_keeps_their_covariance(forgetting: float) -> None:
    rng = np.random.default_rng(14)
    rls = learn(rng.standard_normal((50, 3)), 1e9 * rng.standard_normal(50), forgetting=forgetting)
    covariance = rls.covariance
    rls.set_parameters([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(rls.covariance, covariance)
    rls.update([0.0, 0.0, 0.0], 0.0)
    np.testing.assert_allclose(rls.parameters, [1.0, 2.0, 3.0], rtol=1e-13)
    with pytest.raises(ValueError, match=r"forgetting can only rise, from .*, got 0.5"):
        rls.raise_forgetting(0.5)


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ((3, 1.2), r"forgetting must be in \(0, 1\], got 1.2"),
        ((0,), "parameters must be at least 1, got 0"),
        ((3, 0.99, np.inf), "covariance_limit must be below"),
        ((3, 1.0, 0.0), "covariance_limit must be above"),
    ],
)
def test_settings_out_of_range_are_named(settings: tuple[float, ...], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        RecursiveLeastSquares(*settings)  # type: ignore[arg-type] # the first one is whole


def test_values_out_of_range_are_named() -> None:
    with pytest.raises(ValueError, match="parameters must be 3 finite numbers"):
        RecursiveLeastSquares(3).set_parameters([1.0, np.nan, 0.0])
    damaged = RlsMemory(3, 1.0, np.inf, np.zeros(1))
    with pytest.raises(ValueError, match="3 parameters must have"):
        RecursiveLeastSquares.resume(damaged)
