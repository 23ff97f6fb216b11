"""Polynomial models, held to systems with known terms: by the one-step error, and by the simulation error."""

import math

import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.identification.data import Dataset, plan_run
from reactorwatch.identification.identify import Identification, ModelForm, identify
from reactorwatch.identification.polynomial import factors_of, products_of, run_polynomial
from reactorwatch.identification.structure import Structure

NARX = ModelForm("narx", order=1)
TRUTH = {"T1": 0.5, "q1": 0.8, "w1": -0.4, "T1*q1": -0.1, "q1*w1": 0.3}
OFFSET = 2.0


def record(rows: int, seed: int, noise_sd: float = 0.1) -> Dataset:
    """T[k] = 0.5 T[k-1] + 0.8 q - 0.4 w - 0.1 T[k-1] q + 0.3 q w + 2, the inputs far from zero."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform([1.0, 4.0], [2.0, 6.0], (rows // 2 + 1, 2)), 2, axis=0)[:rows]
    y = np.full(rows, 4.0)
    for k in range(1, rows):
        q, w = u[k - 1]
        y[k] = 0.5 * y[k - 1] + 0.8 * q - 0.4 * w - 0.1 * y[k - 1] * q + 0.3 * q * w + OFFSET
        y[k] += noise_sd * rng.standard_normal()
    return Dataset.of(np.arange(float(rows)), u, y, ("q", "w"), "T")


def evaluate(found: Identification, T: float, q: float, w: float) -> float:
    """Value of the terms as text, with the signals of the row before."""
    values = {"T1": T, "q1": q, "w1": w}
    assert found.terms is not None
    products = (item.value * math.prod(values[name] for name in item.term.split("*")) for item in found.terms)
    return found.offset + sum(products)


def test_known_terms_lie_within_their_standard_deviations() -> None:
    errors = []
    for seed in range(8):
        found = identify(record(1200, seed), NARX)
        assert found.terms is not None
        assert set(TRUTH) <= {item.term for item in found.terms}
        errors += [(item.value - TRUTH.get(item.term, 0.0)) / item.sd for item in found.terms]
        errors.append((found.offset - OFFSET) / found.sd.offset)
        assert found.checks["whiteness"] == "ok"
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) < 1.5
    assert np.max(np.abs(errors)) < 4.5


def test_the_terms_in_the_files_units_are_the_model() -> None:
    """Its predictions and its free run, written out from the terms of the JSON."""
    fitted, other = record(800, 1, noise_sd=0.03), record(200, 2, noise_sd=0.03)
    found = identify(fitted, NARX, other)
    y, u = other.output[:, 0], other.inputs
    predicted = [evaluate(found, y[k - 1], *u[k - 1]) for k in range(1, 200)]
    run = [y[0]]
    for k in range(1, 200):
        run.append(evaluate(found, run[-1], *u[k - 1]))
    assert found.rmse is not None
    assert found.rmse.one_step == pytest.approx(np.sqrt(np.mean((y[1:] - predicted) ** 2)), rel=1e-8)
    assert found.rmse.free_run == pytest.approx(np.sqrt(np.mean((y[1:] - run[1:]) ** 2)), rel=1e-8)
    linear = identify(fitted, ModelForm("arx", order=1), other)
    assert linear.rmse is not None
    assert found.rmse.free_run < 0.6 * linear.rmse.free_run


def test_a_linear_plant_gets_linear_terms_alone_with_the_values_of_arx() -> None:
    rng = np.random.default_rng(1)
    u, y = rng.standard_normal(1000), np.zeros(1000)
    for k in range(1, 1000):
        y[k] = 0.8 * y[k - 1] + u[k - 1] + 0.1 * rng.standard_normal()
    data = Dataset.of(np.arange(1000.0), u, y)
    found, arx = identify(data, NARX), identify(data, ModelForm("arx", order=1))
    assert found.terms is not None
    assert not isinstance(arx.b, dict)
    values = {item.term: item.value for item in found.terms}
    assert values["y1"] == pytest.approx(arx.a[0], abs=0.01)
    assert values["u1"] == pytest.approx(arx.b[0], abs=0.01)
    assert all(abs(value) < 0.01 for name, value in values.items() if "*" in name)


def test_settled_rows_start_the_run_late_and_lags_are_counted_in_rows() -> None:
    fitted, other = record(800, 1), record(200, 2)
    found = identify(fitted, ModelForm("narx", order=1, delay=2), other, settle=50)
    assert found.terms is not None
    assert {"T1", "q2", "w2"} <= {item.term for item in found.terms}
    assert found.fit.free_run > 0.0
    assert (found.a, found.b) == ((), {"q": (), "w": ()})


def test_fewer_rows_than_candidates_are_refused_in_one_line() -> None:
    with pytest.raises(InputError, match="55 candidates for terms need as many complete rows, got 37; lower the order"):
        identify(record(80, 1), ModelForm("narx", order=3))


NOISE_SD = 0.05
CUBIC = {"y1": 0.8, "u1": 0.5, "y1*y1*y1": -0.1}


def noisy_record(rows: int, seed: int) -> Dataset:
    """w[k] = 0.8 w[k-1] + 0.5 u[k-1] - 0.1 w[k-1]^3, y = w + noise."""
    rng = np.random.default_rng(seed)
    u, w = np.repeat(rng.uniform(-1.0, 1.0, rows // 4 + 1), 4)[:rows], np.zeros(rows)
    for k in range(1, rows):
        w[k] = 0.8 * w[k - 1] + 0.5 * u[k - 1] - 0.1 * w[k - 1] ** 3
    return Dataset.of(np.arange(float(rows)), u, w + NOISE_SD * rng.standard_normal(rows))


def test_terms_of_the_truth_lie_within_their_standard_deviations_where_the_output_is_noisy() -> None:
    """A model fitted by its one-step error is biased there: it misses y1 by many of its standard deviations."""
    errors = []
    for seed in range(4):
        found = identify(noisy_record(900, seed), ModelForm("noe", order=1))
        assert found.terms is not None
        assert set(CUBIC) <= {item.term for item in found.terms}
        errors += [(item.value - CUBIC[item.term]) / item.sd for item in found.terms if item.term in CUBIC]
        assert found.checks["whiteness"] == "ok"
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.7
    one_step = identify(noisy_record(900, 0), ModelForm("narx", order=1))
    assert one_step.terms is not None
    assert next(abs(item.value - 0.8) / item.sd for item in one_step.terms if item.term == "y1") > 4.0


def test_the_gradient_is_the_derivative_of_the_simulation() -> None:
    """Against central differences, over two runs."""
    data = noisy_record(60, 1)
    u, y = data.inputs.copy(), data.output
    u[30] = np.nan
    structure = Structure.of_order(2)
    plan, products = plan_run(structure, u, y), products_of(4, 3)
    theta = np.random.default_rng(2).uniform(-0.1, 0.1, len(products))

    def run(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return run_polynomial(values, factors_of(products), structure.orders, u, y[:, 0], plan.arrays, True)

    _, gradient = run(theta)
    for i in range(theta.size):
        step = 1e-6 * np.eye(theta.size)[i]
        difference = (run(theta + step)[0] - run(theta - step)[0]) / 2e-6
        np.testing.assert_allclose(np.nan_to_num(difference), gradient[:, i], atol=1e-7)


def test_too_few_rows_for_the_candidates_are_refused_in_one_line() -> None:
    with pytest.raises(
        InputError, match="28 candidates for terms need twice as many rows of a simulation, got 22; lower"
    ):
        identify(noisy_record(50, 1), ModelForm("noe", order=3))
