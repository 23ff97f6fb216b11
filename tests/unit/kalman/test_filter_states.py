"""A filter starts at the measurements; further states are constants that a move teaches, wander, and coloured noise."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.kalman.batch import FilterRecord
from reactorwatch.kalman.ekf import Filter
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.kalman.filter_states import learned_parameters, select_effects, widen_model
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr import EFFECTS, cstr
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import steady_states
from tests.unit.kalman.plant import SENSORS, record_of

CONSTANTS = ("constant temperature_bias", "constant reaction_order", "constant volume", "constant valve_lag")
START, USUAL = np.array([0.1, 438.5]), 103.4


def test_it_waits_while_nothing_is_measured_and_gives_no_output_in_its_first_row() -> None:
    kalman = Filter(cstr(), SENSORS)
    for t in (0.0, 0.1):
        assert np.all(np.isnan(kalman.update(t, (100.0,), (np.nan, np.nan))))
        assert kalman.state.time_min is None
    assert np.all(np.isnan(kalman.update(0.2, (100.0,), (0.09, 441.0))))
    assert kalman.state.x == pytest.approx((0.09, 441.0), rel=1e-3)


@pytest.mark.parametrize("branch", [0, 2])
def test_what_is_not_measured_begins_at_the_nearest_steady_state(branch: int) -> None:
    point = steady_states(cstr(), np.array([100.0]))[branch]
    kalman = Filter(cstr(), SENSORS)
    kalman.update(0.0, (100.0,), (np.nan, float(point.state[1])))
    np.testing.assert_allclose(kalman.state.x, point.state, rtol=1e-3)


def test_from_the_temperature_alone_it_finds_the_concentration() -> None:
    """Within 4 of the standard deviations that it claims, from an hour on."""
    truth = Simulator(cstr())
    time_min, inputs, both = record_of(1500, seed=10)
    clean = truth.run(time_min, inputs, np.array([0.11, 436.0])).states[:, 0]
    measured = both * [np.nan, 1.0]
    found = Filter(cstr(), SENSORS).run(FilterRecord(time_min, inputs, measured))
    error = found.x[600:, 0] - clean[600:]
    assert np.all(np.abs(error) < 4 * np.sqrt(found.P[600:, 0, 0]) + 1e-5)
    assert np.max(np.abs(error)) < 0.002


def test_it_begins_right_with_a_sensor_that_the_model_knows_to_be_off() -> None:
    model = parse_fault("concentration_gain:constant:0.5").extend(cstr())
    kalman = Filter(model, SENSORS)
    kalman.update(0.0, (100.0,), (0.15, 441.0))
    assert kalman.state.x == pytest.approx((0.1, 441.0), rel=1e-3)


def test_it_begins_where_outputs_grow_without_bound_with_a_state_all_the_same() -> None:
    # Half a minute later than a state amid its bounds, the reaction has run away by more than a number can hold.
    model = EFFECTS[-1].extend(cstr()).with_values({"sample_timing.size": 0.45})
    run = Filter(model, SENSORS).run(
        FilterRecord(np.array([0.0, 0.1]), np.full((2, 1), 90.0), np.array([[0.1, 438.0]] * 2))
    )
    assert np.all(np.isfinite(run.x))


def test_it_restarts_after_a_row_with_an_unknown_input() -> None:
    time_min, inputs, measured = record_of(60, seed=3)
    inputs[30] = np.nan
    found = Filter(cstr(), SENSORS).run(FilterRecord(time_min, inputs, measured))
    assert np.flatnonzero(np.all(np.isnan(found.prediction), axis=1)).tolist() == [0, 31]
    kalman = Filter(cstr(), SENSORS)
    told = [
        kalman.update(*row) for row in zip(time_min.tolist(), inputs[:, None].tolist(), measured.tolist(), strict=True)
    ]
    np.testing.assert_array_equal([item.prediction for item in told], found.prediction)


def test_it_begins_where_outputs_far_from_there_are_no_numbers() -> None:
    """In the middle of the range of C this analyser shows the root of something negative."""
    model = cstr()
    C, T = model.outputs
    shown = C.expression + 1e-9 * ca.sqrt(0.5 - C.expression)
    kalman = Filter(replace(model, outputs=(replace(C, expression=shown), T)), SENSORS)
    kalman.update(0.0, (100.0,), (0.09, 441.0))
    assert kalman.state.x == pytest.approx((0.09, 441.0), rel=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_a_valve_that_sticks_is_taken_to_begin_near_what_is_asked_of_it(seed: int) -> None:
    """Noise moves it by less than half of its stiction in the first minute, so that it opens in time."""
    fault = parse_fault("valve_stiction:constant:6.0")
    time_min, flow, measured = record_of(10, seed=seed, faults=("valve_stiction:constant:6.0",))
    sensors = NoiseLevels(SENSORS.measurement_sd, (0.0, 0.0, 0.0))
    found = Filter(fault.extend(cstr()), sensors).run(FilterRecord(time_min, flow, measured))
    assert np.all(np.abs(found.x[:, 2] - flow[0]) < 3.0)


def kalman(model: ProcessModel) -> Filter:
    return Filter(model, NoiseLevels(SENSORS.measurement_sd, (0.0,) * len(model.states)))


def record(*faults: str) -> tuple[Array, Array, Array]:
    """A plant at rest for half an hour, then after a move of the input of 8 l/min, without noise."""
    model = cstr()
    for text in faults:
        model = parse_fault(text).extend(model)
    time_min: Array = 0.1 * np.arange(600, dtype=np.float64)
    qc: Array = np.where(time_min < 30.0, 102.0, 94.0)
    return time_min, qc[:, None], Simulator(model).run(time_min, qc, START).outputs


def test_a_move_to_where_the_plant_has_not_been_is_predicted_with_a_larger_variance_which_rows_narrow() -> None:
    time_min, inputs, measured = record()
    sd = kalman(widen_model(cstr(), CONSTANTS)).run(FilterRecord(time_min, inputs, measured)).sd[:, 1]
    plain = kalman(cstr()).run(FilterRecord(time_min, inputs, measured)).sd[:, 1]
    assert sd[299] < 1.05 * plain[299]
    assert np.max(sd[300:310]) > 1.5 * plain[299]
    assert sd[-1] < 1.05 * plain[-1]


def test_the_first_move_teaches_the_lag_of_the_valve() -> None:
    time_min, inputs, measured = record("valve_lag:constant:0.12")
    model = widen_model(cstr(), CONSTANTS)
    result = kalman(model).run(FilterRecord(time_min, inputs, measured))
    lag = model.state_names.index("valve_lag.constant")
    assert result.x[-1, lag] == pytest.approx(0.12, abs=0.03)
    assert result.P[-1, lag, lag] < 0.2 * result.P[299, lag, lag]
    assert np.max(np.abs(result.residual / result.sd)[300:]) < 3.0


def test_a_filter_that_is_interrupted_keeps_what_it_knows_about_the_constants() -> None:
    time_min, inputs, measured = record("temperature_bias:constant:1.5")
    model = widen_model(cstr(), CONSTANTS)
    one = kalman(model)
    before = one.run(FilterRecord(time_min, inputs, measured))
    one.interrupt()
    one.update(100.0, inputs[-1].tolist(), measured[-1].tolist())
    assert np.array(one.state.x)[list(model.constant_states)] == pytest.approx(
        before.x[-1][list(model.constant_states)]
    )


def test_an_effect_that_the_model_has_is_uncertain_about_its_size() -> None:
    model = parse_fault("valve_lag:constant:0.12").with_defaults().extend(cstr())
    widened = widen_model(model, ("constant valve_lag",))
    assert widened.state_names == (*model.state_names, "valve_lag.size.constant")


def test_the_same_states_are_added_to_a_model_once() -> None:
    model = cstr()
    assert widen_model(model, CONSTANTS) is widen_model(model, CONSTANTS)
    assert widen_model(model, ()) is model


def test_coloured_noise_has_a_time_constant_that_is_learned() -> None:
    added = ("wander T", "noise T")
    assert learned_parameters(cstr(), added) == ("T.memory_min",)
    assert widen_model(cstr(), added, (2.5,)).parameter("T.memory_min").value == 2.5


@pytest.mark.parametrize(
    ("model", "x", "u"),
    [(cstr(), START, np.array([USUAL])), (three_tanks(), np.array([41.0, 32.0, 36.6]), np.array([21.4, 53.8]))],
)
def test_a_few_effects_are_selected(model: ProcessModel, x: Array, u: Array) -> None:
    selected = select_effects(model, x, u)
    assert 2 <= len(selected) <= 6 + len(model.inputs)
    assert len(set(selected)) == len(selected)
    assert widen_model(model, tuple(f"constant {name}" for name in selected)).name == model.name
