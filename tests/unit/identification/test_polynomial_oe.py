"""Polynomials fitted by simulation, held to a system whose output alone is noisy."""

import msgspec
import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.identification.dataset import Dataset
from reactorwatch.identification.identify import ModelForm, identify
from reactorwatch.identification.polynomial_narx import candidate_products, factors_of
from reactorwatch.identification.polynomial_oe import run_with_gradient
from reactorwatch.identification.simulation import plan_run
from reactorwatch.identification.structure import Structure

NOISE_SD = 0.05
TRUTH = {"y1": 0.8, "u1": 0.5, "y1*y1*y1": -0.1}


def record(rows: int, seed: int) -> Dataset:
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
        found = identify(record(900, seed), ModelForm("noe", order=1))
        assert found.terms is not msgspec.UNSET
        assert set(TRUTH) <= {item.term for item in found.terms}
        errors += [(item.value - TRUTH[item.term]) / item.sd for item in found.terms if item.term in TRUTH]
        assert found.checks["whiteness"] == "ok"
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.7
    one_step = identify(record(900, 0), ModelForm("narx", order=1))
    assert one_step.terms is not msgspec.UNSET
    assert next(abs(item.value - 0.8) / item.sd for item in one_step.terms if item.term == "y1") > 4.0


def test_the_gradient_is_the_derivative_of_the_simulation() -> None:
    """Against central differences, over two runs."""
    data = record(60, 1)
    u, y = data.inputs.copy(), data.output
    u[30] = np.nan
    structure = Structure.of_order(2)
    plan, products = plan_run(structure, u, y), candidate_products(structure, 3)
    theta = np.random.default_rng(2).uniform(-0.1, 0.1, len(products))

    def run(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return run_with_gradient(values, factors_of(products), (2, 2, 1), u, y[:, 0], plan.arrays)

    _, gradient = run(theta)
    for i in range(theta.size):
        step = 1e-6 * np.eye(theta.size)[i]
        difference = (run(theta + step)[0] - run(theta - step)[0]) / 2e-6
        np.testing.assert_allclose(np.nan_to_num(difference), gradient[:, i], atol=1e-7)


def test_too_few_rows_for_the_candidates_are_refused_in_one_line() -> None:
    with pytest.raises(
        InputError, match="28 candidates for terms need twice as many rows of a simulation, got 22; lower"
    ):
        identify(record(50, 1), ModelForm("noe", order=3))
