"""ARMAX and Box-Jenkins models, held to systems with known parameters."""

import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.identification.linear_model import LinearModel
from reactorwatch.identification.linear_predictor import predict_with_gradient
from reactorwatch.identification.prediction_error import (
    fit_armax,
    fit_box_jenkins,
)
from reactorwatch.identification.simulation import plan_run
from reactorwatch.identification.structure import Structure
from tests.unit.identification.systems import ARMA, ARMAX, BOX_JENKINS, OUTPUT_ERROR, System

SEEDS = 6
ROWS = 600


def fit(system: System, seed: int, order: int = 2, kind: str = "armax") -> tuple[LinearModel, np.ndarray]:
    fitting = fit_armax if kind == "armax" else fit_box_jenkins
    u, y = system.simulate(ROWS, seed)
    b = np.ravel(system.b)
    noise = system.c if kind == "armax" else (*system.d, *system.c)
    return fitting(Structure.of_order(order, inputs=system.inputs), u, y), np.array(
        [*system.f, *b, system.offset, *noise]
    )


@pytest.mark.parametrize(("system", "kind"), [(ARMAX, "armax"), (ARMA, "armax"), (BOX_JENKINS, "bj")])
def test_known_parameters_lie_within_their_standard_deviations(system: System, kind: str) -> None:
    """Over seeds the errors divided by their standard deviations have a mean square of 1."""
    errors = []
    for seed in range(SEEDS):
        model, truth = fit(system, seed, kind=kind)
        errors.append((model.parameters - truth) / model.standard_deviations)
        assert model.noise_sd == pytest.approx(system.noise_sd, rel=0.1)
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.4
    assert np.max(np.abs(errors)) < 4.5


def test_the_gradient_is_the_derivative_of_the_prediction() -> None:
    """Against central differences, over a missing output and two runs."""
    u, y = BOX_JENKINS.simulate(60, 1)
    y[20], u[40] = np.nan, np.nan
    structure = Structure.of_order(2, inputs=2)
    plan = plan_run(structure, u, y[:, None])
    theta = np.array([1.4, -0.6, 0.9, -0.5, 0.4, 0.2, 0.1, -0.3, -0.2, 0.5, 0.1])

    def predict(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return predict_with_gradient(parameters, (2, 2, 1, 2), u, y, plan.arrays)

    predicted, gradient = predict(theta)
    assert np.isfinite(predicted[20])
    assert np.isnan(predicted[41])
    for i in range(theta.size):
        step = 1e-6 * np.eye(theta.size)[i]
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


def test_a_box_jenkins_model_without_inputs_is_refused_with_the_cure() -> None:
    _, y = ARMA.simulate(100, 1)
    with pytest.raises(InputError, match=r"needs an input, got none; .* use armax"):
        fit_box_jenkins(Structure.of_order(2, inputs=0), np.empty((100, 0)), y)


def test_too_few_rows_are_refused() -> None:
    u, y = ARMAX.simulate(10, 1)
    with pytest.raises(InputError, match="9 parameters need at least 9 rows of a prediction, got 8 of 10"):
        fit_armax(Structure.of_order(2, inputs=2), u, y)
