"""The report's scheme equals its M-files, and its output-error iteration returns the model that made it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from benchmarks.study_figures.report_scheme import chart_output, fit_least_squares, fit_output_error, re_estimate
from reactorwatch.errors import InputError
from reactorwatch.identification.structure import Structure

Array = NDArray[np.float64]


def m_file(u: Array, y: Array, order: int) -> Array:
    """`paramest<order>` of the report's appendix B, on scaled signals."""
    n = len(y)
    target = y[99:n:6]
    lags = [y[99 - lag : n - lag : 6] for lag in range(1, order + 1)]
    lags += [u[99 - lag : n - lag : 6] for lag in range(1, order + 1)]
    return np.asarray(np.linalg.pinv(np.stack(lags, axis=1)) @ target)


def record(seed: int, order: int, rows: int = 900, noise: float = 0.1) -> tuple[Array, Array]:
    """Input and output of a stable linear plant with noise at the output."""
    rng = np.random.default_rng(seed)
    u = rng.normal(100.0, 5.0, rows)
    x = np.full(rows, 440.0)
    for k in range(order, rows):
        x[k] = 440.0 + 0.7 * (x[k - 1] - 440.0) - 0.1 * (x[k - order] - 440.0) * (order > 1) - 0.4 * (u[k - 1] - 100.0)
    return u, x + rng.normal(0.0, noise, rows)


@given(st.integers(0, 50), st.sampled_from([1, 2, 3]))
def test_parameters_are_those_of_the_m_file(seed: int, order: int) -> None:
    u, y = record(seed, order)
    model = fit_least_squares(Structure.of_order(order), u, y)
    scaled = m_file((u - u.mean()) / u.std(), (y - y.mean()) / y.std(), order)
    expected = scaled * np.repeat([1.0, y.std() / u.std()], order)
    np.testing.assert_allclose(model.parameters[:-1], expected, rtol=1e-7, atol=1e-9)


@given(st.integers(0, 50), st.sampled_from([1, 2, 3]))
def test_output_error_by_regression_on_itself_is_the_arx_model_simulated(seed: int, order: int) -> None:
    u, y = record(seed, order)
    structure = Structure.of_order(order)
    arx, oe = fit_least_squares(structure, u, y), fit_output_error(structure, u, y)
    np.testing.assert_allclose(oe.parameters, arx.parameters, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(re_estimate(oe, u, y).parameters, oe.parameters, rtol=1e-5, atol=1e-6)
    assert (oe.kind, arx.kind) == ("oe", "arx")


def test_rows_that_do_not_determine_the_parameters_give_the_solution_of_least_norm() -> None:
    """An input that moves every 6 rows has two equal lags in every row taken: their coefficients share equally."""
    rng = np.random.default_rng(4)
    u = np.repeat(rng.normal(100.0, 5.0, 200), 6)
    y = np.zeros(u.size)
    for k in range(1, u.size):
        y[k] = 0.6 * y[k - 1] + 0.4 * u[k - 1]
    model = fit_least_squares(Structure.of_order(3), u, y)
    assert model.condition > 1e13
    assert np.isinf(model.standard_deviations).all()
    b = model.parameters[3:6]
    equal = [i for i in range(2) if b[i] == pytest.approx(b[i + 1], rel=1e-6)]
    assert equal, b


def test_limits_are_mean_and_three_standard_deviations_of_the_training_residuals() -> None:
    u, y = record(1, 2, rows=3000)
    y[2500:] += 2.0
    chart = chart_output(u, y, np.arange(3000.0), 1000)
    learned = chart.residuals[:1000][np.isfinite(chart.residuals[:1000])]
    assert chart.limits == pytest.approx(
        (learned.mean() - 3 * learned.std(ddof=1), learned.mean() + 3 * learned.std(ddof=1))
    )
    assert chart.out[1000:2500].mean() < 0.03
    assert chart.out[2500:].mean() > 0.9


@pytest.mark.parametrize("rows", [4, 90, 99])
def test_a_record_too_short_for_the_report_s_rows_is_refused_in_one_line(rows: int) -> None:
    u, y = record(1, 2, rows=rows)
    with pytest.raises(InputError, match=f"from row 100 on, and none of these is complete .* {rows} rows are too few"):
        fit_least_squares(Structure.of_order(3), u, y)
