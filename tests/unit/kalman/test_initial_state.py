"""A filter starts at the measurements, and unmeasured states at the steady state that fits them."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.kalman.batch import FilterRecord
from reactorwatch.kalman.ekf import Filter
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr import EFFECTS, cstr
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import steady_states

SENSORS = NoiseLevels((0.002, 0.3), (0.0, 0.0))


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
    record = simulate_record(PlantConfig(seed=10), 1500)
    time_min, inputs = record.time_min, record.columns["qc"]
    clean = truth.run(time_min, inputs, np.array([0.11, 436.0])).states[:, 0]
    measured = np.column_stack([np.full(1500, np.nan), record.columns["T"]])
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
    record = simulate_record(PlantConfig(seed=3), 60)
    time_min, inputs = record.time_min, record.columns["qc"].copy()
    measured = np.column_stack([record.columns["C"], record.columns["T"]])
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
    """What noise moves it by in the first minute is less than half of what it sticks by, so that it opens in time."""
    fault = parse_fault("valve_stiction:constant:6.0")
    record = simulate_record(PlantConfig(seed=seed, faults=("valve_stiction:constant:6.0",)), 10)
    measured = np.column_stack([record.columns["C"], record.columns["T"]])
    sensors = NoiseLevels(SENSORS.measurement_sd, (0.0, 0.0, 0.0))
    found = Filter(fault.extend(cstr()), sensors).run(FilterRecord(record.time_min, record.columns["qc"], measured))
    assert np.all(np.abs(found.x[:, 2] - record.columns["qc"][0]) < 3.0)
