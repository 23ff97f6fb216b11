"""The filter is the textbook's on linear models, white on the plant, and never poisoned."""

import re
from dataclasses import replace

import casadi as ca
import msgspec
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import chi2, multivariate_normal

from reactorwatch.arrays import Array
from reactorwatch.kalman.batch import FilterRecord, Innovation
from reactorwatch.kalman.ekf import Filter, FilterState
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr import OPERATING_COOLANT_FLOW, OPERATING_STATE, cstr
from reactorwatch.process.model import Output, ProcessModel, new_clock, variable
from reactorwatch.process.simulate import Simulator
from tests.unit.kalman.plant import SENSORS, record_of

A = np.array([[-0.7, 0.4], [-0.9, -0.3]])
B = np.array([0.5, 1.0])
C = np.array([[1.0, 0.0], [0.5, -1.0]])
NOISE = NoiseLevels((0.1, 0.2), (0.05, 0.3))
BURN_IN = 50


def linear_model(bound: float = 1e6) -> ProcessModel:
    x = [variable(name, "1", (-bound, bound), 1.0, "a state") for name in ("x1", "x2")]
    u = variable("u", "1", (-10.0, 10.0), 1.0, "an input")
    states = ca.vertcat(x[0].symbol, x[1].symbol)
    rhs, outputs = ca.DM(A) @ states + ca.DM(B) * u.symbol, ca.DM(C) @ states
    return ProcessModel(
        name="linear",
        states=(x[0], x[1]),
        inputs=(u,),
        parameters=(),
        rhs=(rhs[0], rhs[1]),
        outputs=(Output("y1", "1", outputs[0]), Output("y2", "1", outputs[1])),
        clock=new_clock(),
    )


def linear_record(rows: int = 120, period_min: float = 0.07, seed: int = 0) -> tuple[Array, Array, Array]:
    """Times, inputs and measurements of the linear model with its noise; some times are uneven, some values missing."""
    rng = np.random.default_rng(seed)
    time_min: Array = period_min * (np.arange(rows) + 0.3 * rng.random(rows))
    inputs = rng.normal(size=rows)
    x, measured = np.array([1.0, -2.0]), np.empty((rows, 2))
    for row in range(rows):
        if row:
            h = time_min[row] - time_min[row - 1]
            F, G = discretize(h)
            x = F @ x + G * inputs[row - 1] + rng.normal(size=2) * NOISE.process_sd * np.sqrt(h)
        measured[row] = C @ x + rng.normal(size=2) * NOISE.measurement_sd
    measured[rng.random((rows, 2)) < 0.1] = np.nan
    measured[0] = 1.0, 2.0
    return time_min, inputs, measured


def discretize(h: float) -> tuple[Array, Array]:
    """exp(A h), and what a constant input of 1 adds."""
    block = np.zeros((3, 3))
    block[:2, :2], block[:2, 2] = A, B
    exponential = expm(block * h)
    return exponential[:2, :2], exponential[:2, 2]


def textbook(state: FilterState, time_min: Array, inputs: Array, measured: Array) -> list[tuple[Array, ...]]:
    """The Kalman filter of the linear model, exactly sampled: x, P, innovation and its covariance of every row."""
    assert state.time_min is not None
    before, u, x, P = state.time_min, state.inputs[0], np.array(state.x), np.array(state.P).reshape(2, 2)
    found: list[tuple[Array, ...]] = []
    for row, t in enumerate(time_min.tolist()):
        F, G = discretize(t - before)
        x, P = F @ x + G * u, F @ P @ F.T + np.diag(np.square(NOISE.process_sd)) * (t - before)
        known = np.isfinite(measured[row])
        off: Array = measured[row] - C @ x
        S = C @ P @ C.T + np.diag(np.square(NOISE.measurement_sd))
        H = C[known]
        K = P @ H.T @ np.linalg.inv(S[np.ix_(known, known)])
        x, P = np.asarray(x + K @ off[known]), np.asarray(P - K @ H @ P)
        found.append((x, P, off, S))
        before, u = t, float(inputs[row])
    return found


def first_state(model: ProcessModel, noise: NoiseLevels = NOISE) -> FilterState:
    """State of a filter after a first row at 0 min."""
    kalman = Filter(model, noise)
    kalman.update(0.0, (0.0,), (1.0, 2.0))
    return kalman.state


def test_on_a_linear_model_it_is_the_kalman_filter_exactly_sampled() -> None:
    """Its likelihood is that of the innovations, and normalising takes their correlation out."""
    time_min, inputs, measured = linear_record()
    start, expected = first_state(linear_model()), 0.0
    found = Filter(linear_model(), NOISE).run(FilterRecord(time_min[1:], inputs[1:], measured[1:]), start=start)
    for row, (x, P, off, S) in enumerate(textbook(start, time_min[1:], inputs[1:], measured[1:])):
        np.testing.assert_allclose(found.x[row], x, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(found.P[row], P, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(found.residual[row], off, atol=1e-6)
        np.testing.assert_allclose(found.sd[row], np.sqrt(np.diag(S)), rtol=1e-7)
        known = np.isfinite(off)
        np.testing.assert_array_equal(np.isfinite(found.normalized[row]), known)
        if known.any():
            part = S[np.ix_(known, known)]
            expected += float(multivariate_normal.logpdf(off[known], cov=part))
            distance = off[known] @ np.linalg.solve(part, off[known])
            assert np.nansum(found.normalized[row] ** 2) == pytest.approx(distance, rel=1e-6, abs=1e-9)
    assert np.sum(found.log_likelihood) == pytest.approx(expected, rel=1e-8)


def assert_white(normalized: Array) -> None:
    """Sums of squares are within the 1e-4 quantiles of chi-square; nothing correlates over time or across (4 sd)."""
    rows = len(normalized)
    assert np.all(np.abs(np.mean(normalized, axis=0)) < 4 / np.sqrt(rows))
    for column in normalized.T:
        assert chi2.ppf(1e-4, rows) < np.sum(column**2) < chi2.isf(1e-4, rows)
    for lag in range(1, 6):
        product = normalized[lag:].T @ normalized[:-lag] / rows
        assert np.all(np.abs(product) < 4 / np.sqrt(rows))
    assert abs(np.mean(normalized[:, 0] * normalized[:, 1])) < 4 / np.sqrt(rows)


@pytest.mark.parametrize("process_sd", [{}, {"C": 0.002, "T": 0.5}])
def test_on_the_plant_its_innovations_are_white(process_sd: dict[str, float]) -> None:
    noise = NoiseLevels((0.002, 0.3), (process_sd.get("C", 0.0), process_sd.get("T", 0.0)))
    record = record_of(3000, seed=5, process_noise_sd=process_sd)
    assert_white(Filter(cstr(), noise).run(FilterRecord(*record)).normalized[BURN_IN:])


@pytest.mark.parametrize(
    "fault",
    [
        "coolant_flow:step:-0.05@60.037min",
        "temperature_bias:step:3@60min",
        "heat_transfer:ramp:-0.5@60.04min,end=120min",
        "coolant_flow:free:-0.05,60.03min=0,90min=1,150.06min=0.3",
    ],
)
def test_with_the_true_fault_in_the_model_the_innovations_of_a_faulty_plant_are_white(fault: str) -> None:
    record = record_of(2000, seed=6, scenario={"kind": "random-steps", "low": 85.0, "high": 105.0}, faults=(fault,))
    assert_white(Filter(parse_fault(fault).extend(cstr()), SENSORS).run(FilterRecord(*record)).normalized[BURN_IN:])
    nominal = Filter(cstr(), SENSORS).run(FilterRecord(*record)).normalized[BURN_IN:]
    assert np.sum(nominal**2) > chi2.isf(1e-4, nominal.size)


@pytest.mark.parametrize("onset", ["2min", "2.013min", "2.05min", "2.099min"])
def test_without_noise_it_predicts_what_the_simulator_runs(onset: str) -> None:
    """With measurements and without; the onset of a fault lies on a row, or anywhere between two."""
    model = parse_fault(f"coolant_flow:step:-0.05@{onset}").extend(cstr())
    time_min = np.append(np.arange(40) * 0.1, [4.3, 9.0])
    inputs = np.where(np.arange(42) % 20 < 10, 95.0, 103.0)
    expected = Simulator(model).run(time_min, inputs, np.array(OPERATING_STATE))
    start = FilterState(0.0, (95.0,), OPERATING_STATE, (0.0,) * 4)
    for measured in (expected.outputs[1:], np.full((41, 2), np.nan)):
        found = Filter(model, SENSORS).run(FilterRecord(time_min[1:], inputs[1:], measured), start=start)
        assert np.all(np.abs(found.prediction - expected.outputs[1:]) < [1e-6, 2e-4])
    assert np.all(np.isnan(found.residual))
    assert np.all(found.log_likelihood == 0.0)


def test_a_sensor_s_step_at_the_time_of_a_row_shows_in_it() -> None:
    """In every row, however its time is rounded."""
    model = parse_fault("temperature_bias:step:3@0min").extend(cstr())
    kalman = Filter(model, SENSORS)
    for row in range(1, 400):
        kalman.state = FilterState(0.1 * (row - 1), (OPERATING_COOLANT_FLOW,), OPERATING_STATE, (0.0,) * 4)
        kalman.set_parameters({"temperature_bias.onset": 0.1 * row})
        shown = kalman.update(0.1 * row, (OPERATING_COOLANT_FLOW,), (np.nan, np.nan)).prediction[1]
        assert shown == pytest.approx(OPERATING_STATE[1] + 3.0, abs=0.05)


def test_a_record_at_once_and_row_by_row_are_the_same_to_the_last_bit() -> None:
    model = cstr()
    for fault in (
        "reaction_rate:step:-0.05@12.34min",
        "coolant_flow:step:-0.2@12.37min",
        "feed_flow:step:0.01@15.06min",
    ):
        model = parse_fault(fault).extend(model)
    time_min, inputs, measured = record_of(300, seed=7)
    time_min = time_min + np.where(np.arange(300) > 200, 2.0, 0.0) + np.where(np.arange(300) > 250, 40.0, 0.0)
    measured[50, 0] = np.nan
    measured[60] = np.nan
    measured[70, 1] += 20.0
    accept = np.zeros((300, 2), dtype=bool)
    accept[80:90, 1] = True
    measured[80:90, 1] += 20.0
    one, other = Filter(model, SENSORS), Filter(model, SENSORS)
    whole = one.run(FilterRecord(time_min, inputs, measured, gate=6.0, accept=accept))
    rows = [
        other.update(t, (u,), y, gate=6.0, accept=follow)
        for t, u, y, follow in zip(time_min.tolist(), inputs.tolist(), measured.tolist(), accept.tolist(), strict=True)
    ]
    for field in Innovation._fields:
        np.testing.assert_array_equal([getattr(row, field) for row in rows], getattr(whole, field))
    assert one.state == other.state


@pytest.mark.parametrize("since", [1, 100, 129, 299])
def test_from_a_stored_state_it_resumes_bit_for_bit(since: int) -> None:
    time_min, inputs, measured = record_of(300, seed=7)
    time_min = time_min + np.where(np.arange(300) > 200, 2.0, 0.0)
    model = parse_fault("coolant_flow:step:-0.2@12.37min").extend(cstr())
    record = FilterRecord(time_min, inputs, measured, 6.0)
    whole, kalman = Filter(model, SENSORS).run(record), Filter(model, SENSORS)
    kalman.run(FilterRecord(time_min[:since], inputs[:since], measured[:since], gate=6.0))
    stored = msgspec.msgpack.decode(msgspec.msgpack.encode(kalman.state), type=FilterState)
    rest = Filter(model, SENSORS).run(FilterRecord(time_min[since:], inputs[since:], measured[since:], 6.0), stored)
    for field in Innovation._fields:
        np.testing.assert_array_equal(getattr(rest, field), getattr(whole, field)[since:])


def test_a_value_beyond_the_gate_is_treated_as_missing_until_it_is_accepted() -> None:
    time_min, inputs, measured = record_of(60, seed=9)
    outlier, missing = measured.copy(), measured.copy()
    outlier[50, 1], missing[50, 1] = outlier[50, 1] + 10.0, np.nan
    accept = np.zeros((60, 2), dtype=bool)
    gated, without, plain = (
        Filter(cstr(), SENSORS).run(FilterRecord(time_min, inputs, item, gate=6.0))
        for item in (outlier, missing, measured)
    )
    np.testing.assert_array_equal(gated.x, without.x)
    assert gated.residual[50, 1] == pytest.approx(plain.residual[50, 1] + 10.0)
    accept[50, 1] = True
    followed = Filter(cstr(), SENSORS).run(FilterRecord(time_min, inputs, outlier, gate=6.0, accept=accept))
    ungated = Filter(cstr(), SENSORS).run(FilterRecord(time_min, inputs, outlier))
    np.testing.assert_array_equal(followed.x, ungated.x)
    assert np.any(followed.x != without.x)


@pytest.mark.parametrize(("far", "used"), [(5.99, True), (6.01, False)])
def test_the_gate_is_in_standard_deviations_of_the_innovation(far: float, used: bool) -> None:
    kalman = Filter(cstr(), SENSORS)
    start = FilterState(0.0, (OPERATING_COOLANT_FLOW,), OPERATING_STATE, (1e-5, 0.0, 0.0, 0.4))
    kalman.state = start
    expected = kalman.update(0.1, (100.0,), (np.nan, np.nan))
    without = kalman.state
    kalman.state = start
    kalman.update(0.1, (100.0,), (np.nan, expected.prediction[1] - far * expected.sd[1]), gate=6.0)
    assert (kalman.state != without) is used


def test_an_output_may_depend_on_the_input_of_its_own_row() -> None:
    model = linear_model()
    fed_through = replace(model.outputs[1], expression=model.states[0].symbol + 2.0 * model.inputs[0].symbol)
    kalman = Filter(replace(model, outputs=(model.outputs[0], fed_through)), NOISE)
    kalman.state = FilterState(0.0, (1.0,), (3.0, 1.0), (0.1, 0.0, 0.0, 0.1))
    prediction = kalman.update(0.1, (5.0,), (np.nan, np.nan)).prediction
    assert prediction[1] == pytest.approx(prediction[0] + 10.0)
    assert prediction[0] == pytest.approx((discretize(0.1)[0] @ [3.0, 1.0] + discretize(0.1)[1])[0], abs=1e-9)


def test_a_sensor_that_is_all_but_exact_leaves_the_covariance_positive() -> None:
    """K H is 1 but for rounding then, and (1 - K H) P is nothing or less."""
    kalman = Filter(linear_model(), NoiseLevels((1e-9, 1e-9), (0.0, 0.0)))
    kalman.state = FilterState(0.0, (0.0,), (1.0, 1.0), (1e6, 3e5, 3e5, 1e6))
    kalman.update(0.1, (0.0,), (1.0, 0.5))
    P = np.array(kalman.state.P).reshape(2, 2)
    assert np.all(np.diag(P) > 0.0)
    assert np.all(np.diag(P) < 1e-17)


def test_a_gap_is_bridged_and_one_that_is_too_long_restarts_the_filter() -> None:
    quiet = NoiseLevels(NOISE.measurement_sd, (0.0, 0.0))
    kalman = Filter(linear_model(), quiet)
    kalman.state = FilterState(0.0, (2.0,), (1.0, -2.0), (0.5, 0.1, 0.1, 0.4))
    row = kalman.update(7.77, (0.0,), (np.nan, np.nan))
    F, G = discretize(7.77)
    np.testing.assert_allclose(row.prediction, C @ (F @ [1.0, -2.0] + G * 2.0), atol=1e-6)
    S = C @ F @ np.array([[0.5, 0.1], [0.1, 0.4]]) @ F.T @ C.T + np.diag(np.square(NOISE.measurement_sd))
    np.testing.assert_allclose(row.sd, np.sqrt(np.diag(S)), rtol=1e-6)
    for later in (38.0, 20.0):  # the second is earlier than the row before
        assert np.all(np.isnan(kalman.update(later, (0.0,), (1.0, 2.0)).prediction))
        assert np.linalg.solve(C, [1.0, 2.0]) == pytest.approx(kalman.state.x, rel=1e-3)
        assert np.all(np.isfinite(kalman.update(later + 0.1, (0.0,), (1.0, 2.0)).prediction))


def test_where_the_equations_leave_all_bounds_or_explode_it_restarts_at_once() -> None:
    model = linear_model(bound=50.0)
    x = model.states[0].symbol
    for rhs in (x * x * x * 1e6, ca.SX(2e3), ca.sqrt(1.5 - x)):
        kalman = Filter(replace(model, rhs=(rhs, ca.SX(0))), NOISE)
        kalman.update(0.0, (0.0,), (2.0, 1.0))
        assert np.all(np.isnan(kalman.update(0.1, (0.0,), (1.0, 1.0)).prediction))
        assert kalman.state.time_min == 0.1
        assert kalman.state.x == pytest.approx((1.0, -0.5), abs=1e-2)


def test_a_run_may_end_at_the_first_divergence_or_after_several_instead_of_restarting() -> None:
    """The rows before are those of a filter that restarts."""
    model = linear_model(bound=50.0)
    time_min, inputs, measured = linear_record(rows=60)
    inputs[30:] = 1e6  # leads out of the bounds
    record = FilterRecord(time_min, inputs, measured)
    stopping, several = Filter(model, NOISE), Filter(model, NOISE)
    stopping.stops_at_restart, several.most_divergences = True, 3
    restarted = Filter(model, NOISE).run(record)
    first = int(np.argmax(np.isnan(restarted.prediction[1:, 0]))) + 1
    assert 30 <= first < 60
    assert np.all(np.isfinite(restarted.x[first]))
    started = np.isnan(restarted.prediction[:, 0]) & np.isfinite(restarted.x[:, 0])
    fourth = int(np.flatnonzero(started)[4])  # after the first row and three divergences
    for end, kalman in ((first, stopping), (fourth, several.clone())):
        for one, other in zip(restarted, kalman.run(record), strict=True):
            np.testing.assert_array_equal(one[:end], other[:end])
            assert np.all(np.isnan(other[end:]))


def test_a_correction_is_cut_off_at_the_bounds() -> None:
    kalman = Filter(cstr(), SENSORS)
    kalman.state = FilterState(0.0, (OPERATING_COOLANT_FLOW,), OPERATING_STATE, (0.1, 0.0, 0.0, 1e-9))
    kalman.update(0.001, (OPERATING_COOLANT_FLOW,), (-0.2, np.nan))
    assert kalman.state.x[0] == 0.0
    assert kalman.state.time_min == 0.001


def test_without_process_noise_the_covariance_stays_positive_for_a_week() -> None:
    rows = 100_000
    time_min = 2e7 + np.arange(rows, dtype=np.float64) * 0.1
    inputs = 98.0 + 6.0 * np.sin(np.arange(rows) / 20)
    kalman = Filter(cstr(), SENSORS)
    P = kalman.run(FilterRecord(time_min, inputs, np.full((rows, 2), OPERATING_STATE), gate=1e9)).P[1:]
    assert np.array_equal(P[:, 0, 1], P[:, 1, 0])
    correlation = P[:, 0, 1] / np.sqrt(P[:, 0, 0] * P[:, 1, 1])
    assert np.all(np.isfinite(correlation))
    assert np.max(np.abs(correlation)) < 1.0


def test_parameters_may_change_under_way() -> None:
    model = parse_fault("temperature_bias:step:2@1000min").extend(cstr())
    kalman = Filter(model, SENSORS)
    start = FilterState(0.0, (OPERATING_COOLANT_FLOW,), OPERATING_STATE, (0.0,) * 4)
    predictions = []
    for changes in ({}, {"temperature_bias.size": 5.0}, {"temperature_bias.size": 5.0, "temperature_bias.onset": 0.05}):
        kalman.state = start
        kalman.set_parameters(changes)
        predictions.append(kalman.update(0.1, (100.0,), (np.nan, np.nan)).prediction[1])
    assert predictions[0] == predictions[1]
    assert predictions[2] == pytest.approx(predictions[0] + 5.0, abs=1e-9)


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        (NoiseLevels((0.1,), (0.0, 0.0)), "measurement_sd must be 2 positive numbers, got (0.1,)"),
        (NoiseLevels((0.1, 0.0), (0.0, 0.0)), "measurement_sd must be 2 positive numbers, got (0.1, 0.0)"),
        (NoiseLevels((0.1, 0.1), (0.0, -1.0)), "process_sd must be 2 numbers of at least 0, got (0.0, -1.0)"),
    ],
)
def test_noise_that_cannot_be_is_refused(noise: NoiseLevels, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        Filter(cstr(), noise)


@pytest.mark.parametrize(("inputs", "measured"), [([], [0.0, 0.0]), ([1.0], [0.0]), ([1.0, 1.0], [0.0, 0.0])])
def test_a_row_with_another_number_of_values_is_refused(inputs: list[float], measured: list[float]) -> None:
    ekf = Filter(linear_model(), NOISE)
    ekf.update(0.0, [1.0], [0.0, 0.0])
    with pytest.raises(ValueError, match="expected 1 inputs and 2 measurements"):
        ekf.update(0.07, inputs, measured)


def test_a_parameter_that_there_is_not_is_refused() -> None:
    with pytest.raises(ValueError, match="cstr has no parameter 'qx'"):
        Filter(cstr(), SENSORS, {"qx": 1.0})
