"""ARX by least squares, and what its model predicts."""

import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.identification.batch import fit_arx, least_squares
from reactorwatch.identification.linear_model import LinearModel, fit_percent
from reactorwatch.identification.structure import REPORT_ROWS, Structure
from tests.unit.identification.truth import Array, Daisy, oscillating_plant


def recursion(parameters: Array, inputs: Array, structure: Structure, start: Array) -> Array:
    """The recursion of one input and output, written out."""
    y = list(start)
    n, m, d = structure.output_lags, structure.input_lags, structure.delay
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
    model = fit_arx(Structure.of_order(3), u, y, daisy.time[:3750])
    np.testing.assert_allclose(model.parameters, truth, rtol=1e-7)
    np.testing.assert_allclose(model.standard_deviations, np.sqrt(variances), rtol=1e-4)
    assert model.rows == 3747


def test_the_report_row_choice_of_the_daisy_record_is_that_of_lapack(daisy: Daisy) -> None:
    u, y = daisy.qc[:3750], daisy.T[:3750]
    k = np.arange(99, 3750, 6)
    regressors = np.column_stack([y[k - 1], y[k - 2], u[k - 1], u[k - 2], np.ones(k.size)])
    model = fit_arx(Structure.of_order(2), u, y, choice=REPORT_ROWS)
    np.testing.assert_allclose(model.parameters, np.linalg.lstsq(regressors, y[k])[0], rtol=1e-7)


def test_the_report_row_choice_cannot_distinguish_order_3_from_steps_of_ten_samples(daisy: Daisy) -> None:
    """The record's input moves every 10 rows, so in every 6th row from the 100th on u[k-2] = u[k-3]."""
    k = np.arange(99, 3750, 6)
    np.testing.assert_array_equal(daisy.qc[k - 2], daisy.qc[k - 3])
    with pytest.raises(InputError, match="don't determine 7 parameters"):
        fit_arx(Structure.of_order(3), daisy.qc[:3750], daisy.T[:3750], choice=REPORT_ROWS)


def test_a_plant_without_noise_is_found_exactly() -> None:
    plant = oscillating_plant(500, noise_sd=0.0)
    model = fit_arx(Structure.of_order(2), plant.inputs, plant.clean)
    np.testing.assert_allclose(model.parameters, plant.parameters, atol=1e-11)
    np.testing.assert_allclose(model.predict(plant.inputs, plant.clean)[2:, 0], plant.clean[2:], atol=1e-9)


def test_several_inputs_are_found_together() -> None:
    rng = np.random.default_rng(3)
    structure = Structure(1, 2, delay=2, inputs=2)
    truth = np.array([0.7, 1.0, -0.5, 0.2, 0.0, 0.3])
    u, y = rng.standard_normal((400, 2)), np.zeros(400)
    for k in range(3, 400):
        y[k] = truth @ np.concatenate([[y[k - 1]], u[k - 2], u[k - 3], [1.0]])
    model = fit_arx(structure, u, y)
    np.testing.assert_allclose(model.parameters, truth, atol=1e-11)
    np.testing.assert_allclose(model.simulate(u, y)[3:, 0], y[3:], atol=1e-9)


def test_a_model_without_offset_has_none() -> None:
    rng = np.random.default_rng(4)
    u, y = rng.standard_normal(300) + 5.0, np.zeros(300)
    for k in range(1, 300):
        y[k] = 0.8 * y[k - 1] + 2.0 * u[k - 1]
    model = fit_arx(Structure(1, 1, offset=False), u, y)
    np.testing.assert_allclose(model.parameters, [0.8, 2.0], rtol=1e-10)


def test_standard_deviations_are_the_scatter_over_many_records() -> None:
    """500 records of an ARX plant, white equation noise: observed scatter of each parameter within 10 %."""
    rng = np.random.default_rng(5)
    found, told = [], []
    for _ in range(500):
        u, y = rng.standard_normal(400), np.zeros(400)
        for k in range(1, 400):
            y[k] = 0.9 * y[k - 1] + 0.5 * u[k - 1] + 3.0 + 0.2 * rng.standard_normal()
        model = fit_arx(Structure.of_order(1), u, y)
        found.append(model.parameters)
        told.append(model.standard_deviations)
    np.testing.assert_allclose(np.mean(told, axis=0), np.std(found, axis=0), rtol=0.1)
    assert np.sqrt(np.mean(np.square([model.noise_sd]))) == pytest.approx(0.2, rel=0.15)


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


def test_records_that_determine_nothing_are_refused_with_the_cause() -> None:
    rng = np.random.default_rng(9)
    u, y = rng.standard_normal(50), rng.standard_normal(50)
    with pytest.raises(InputError, match=r"output 1 is constant, 3 in all rows: there is nothing to identify"):
        fit_arx(Structure.of_order(1), u, np.full(50, 3.0))
    with pytest.raises(InputError, match=r"7 parameters need at least 7 rows .*, got 3 of 6"):
        fit_arx(Structure.of_order(3), u[:6], y[:6])
    with pytest.raises(InputError, match="don't determine 3 parameters: condition number"):
        fit_arx(Structure.of_order(1), np.ones(50), y)
    with pytest.raises(InputError, match=r"regressors must be finite, got \[nan\] in row 2"):
        least_squares([[1.0], [np.nan], [2.0]], [1.0, 2.0, 3.0])
    with pytest.raises(InputError, match="2 parameters need at least 2 complete rows, got 1"):
        least_squares([[1.0, 2.0]], [1.0])
    with pytest.raises(InputError, match="equally many rows, got 2 and 3"):
        least_squares([[1.0], [2.0]], [1.0, 2.0, 3.0])


def test_as_many_rows_as_parameters_leave_no_doubt_to_estimate() -> None:
    rng = np.random.default_rng(10)
    model = fit_arx(Structure.of_order(1), rng.standard_normal(4), rng.standard_normal(4))
    assert model.rows == 3
    assert np.all(np.isinf(model.standard_deviations))
