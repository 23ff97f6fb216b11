"""Additional states of a filter: constants that a move teaches, disturbances that wander, coloured noise."""

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.kalman.batch import FilterRecord
from reactorwatch.kalman.ekf import Filter
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.kalman.filter_states import learned_parameters, select_effects, widen_model
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator

CONSTANTS = ("constant temperature_bias", "constant reaction_order", "constant volume", "constant valve_lag")
SENSORS = (0.002, 0.3)
START, USUAL = np.array([0.1, 438.5]), 103.4


def kalman(model: ProcessModel) -> Filter:
    return Filter(model, NoiseLevels(SENSORS, (0.0,) * len(model.states)))


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
    assert learned_parameters(added) == ("T.memory_min",)
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
