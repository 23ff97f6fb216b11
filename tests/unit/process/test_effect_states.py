"""Models with memory: where they rest, where a filter of them begins, and that it predicts what the simulator runs."""

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.kalman.batch import FilterRecord
from reactorwatch.kalman.ekf import Filter, FilterState
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr import EFFECTS, OPERATING_STATE, cstr
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import STEP
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import steady_states
from tests.unit.process.effect_named import effect_of

START = np.array(OPERATING_STATE)
MEMORY = tuple(effect for effect in EFFECTS if effect.extend(cstr()).at_rest)
SMALL = np.array([2e-6, 2e-3])
"""mol/l and K."""

of_every_effect = pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
with_memory = pytest.mark.parametrize("effect", MEMORY, ids=lambda effect: effect.name)


def record(rows: int = 300) -> tuple[Array, Array, Array]:
    """Times, flows and noisy measurements of the nominal plant."""
    rng = np.random.default_rng(12)
    time_min: Array = np.round(np.arange(float(rows)) * 0.1, 9)
    flows = np.repeat(rng.uniform(90, 111, rows // 10), 10)
    clean = Simulator(cstr()).run(time_min, flows, START).outputs
    return time_min, flows, clean + rng.normal(size=clean.shape) * [0.002, 0.3]


def noise_of(model: ProcessModel) -> NoiseLevels:
    return NoiseLevels((0.002, 0.3), (0.001, 0.1, *(0.0,) * (len(model.states) - 2)))


def with_size(effect: Effect) -> ProcessModel:
    return effect.extend(cstr()).with_values({f"{effect.name}.size": effect.typical})


def test_these_effects_bring_memory_along() -> None:
    assert {effect.name for effect in MEMORY} == {
        "jacket_lag",
        "wall_heat_capacity",
        "valve_lag",
        "valve_stiction",
        "temperature_lag",
        "concentration_delay",
    }


@of_every_effect
def test_at_its_neutral_size_its_filter_is_that_of_the_base_model(effect: Effect) -> None:
    model = effect.extend(cstr())
    expected, found = (Filter(item, noise_of(item)).run(FilterRecord(*record())) for item in (cstr(), model))
    np.testing.assert_allclose(found.residual, expected.residual, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.normalized, expected.normalized, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.P[:, :2, :2], expected.P, rtol=1e-6, atol=1e-12)


@of_every_effect
def test_without_noise_a_filter_of_it_predicts_what_the_simulator_runs(effect: Effect) -> None:
    model = with_size(effect)
    time_min, flows, _ = record(100)
    expected = Simulator(model).run(time_min, flows, START)
    x = tuple(expected.states[0].tolist())
    start = FilterState(0.0, (float(flows[0]),), x, (0.0,) * len(x) ** 2)
    found = Filter(model, noise_of(model)).run(
        FilterRecord(time_min[1:], flows[1:], np.full((99, 2), np.nan)), start=start
    )
    assert np.all(np.abs(found.prediction - expected.outputs[1:]) < SMALL)


@with_memory
def test_it_does_not_move_the_points_of_rest(effect: Effect) -> None:
    """What lags, sticks or stores is where the rest is."""
    flow = np.array([103.41])
    expected, found = (steady_states(model, flow) for model in (cstr(), with_size(effect)))
    assert len(found) == 3
    for one, other in zip(expected, found, strict=True):
        np.testing.assert_allclose(other.state[:2], one.state, rtol=1e-9)
        np.testing.assert_allclose(other.outputs, one.outputs, rtol=1e-9)


@with_memory
def test_at_rest_it_stays(effect: Effect) -> None:
    """A run of the whole model from its point of rest does not leave it."""
    point = steady_states(with_size(effect), np.array([100.0]))[-1]
    run = Simulator(with_size(effect)).run(np.arange(30.0) * 0.1, np.full(30, 100.0), point.state)
    scales = np.array([state.scale for state in with_size(effect).states])
    assert np.all(np.abs(run.states - point.state) < 1e-6 * scales)


@with_memory
def test_a_filter_begins_with_the_memory_at_rest_give_or_take_its_scale(effect: Effect) -> None:
    model = with_size(effect)
    kalman = Filter(model, noise_of(model))
    kalman.update(0.0, (100.0,), (0.09, 441.0))
    begun = Simulator(model).run(np.array([0.0, 0.1]), np.full(2, 100.0), np.array(kalman.state.x[:2])).states[0]
    np.testing.assert_allclose(kalman.state.x, begun, rtol=1e-9, atol=1e-12)
    P = np.array(kalman.state.P).reshape(len(begun), -1)
    scales = np.array([state.scale for state in model.states[2:]])
    assert np.all(np.diag(P)[2:] >= 0.99 * scales**2)


@with_memory
def test_a_short_start_is_one_with_the_memory_at_rest(effect: Effect) -> None:
    simulator, (time_min, flows, _) = Simulator(with_size(effect)), record(20)
    run = simulator.run(time_min, flows, START)
    np.testing.assert_array_equal(simulator.run(time_min, flows, run.states[0]).states, run.states)


def test_a_start_that_is_neither_whole_nor_without_memory_is_refused() -> None:
    model = effect_of("valve_lag").extend(cstr())
    with pytest.raises(ValueError, match=r"^start must be 3 finite numbers \(.*\), got \[1\.\]$"):
        Simulator(model).run(np.arange(2.0), np.full(2, 100.0), np.ones(1))


@with_memory
def test_with_the_true_cause_in_its_model_a_filter_leaves_less_than_the_nominal_one(effect: Effect) -> None:
    """From a step on: what is off is the noise again, in the mean square; of 2 x 900 values it is 1 to 4 sd of it."""
    model = effect.extend(cstr(), STEP).with_values({f"{effect.name}.size": 3 * effect.typical})
    model = model.with_values({f"{effect.name}.onset": 10.0})
    time_min, flows, measured = record(1000)
    clean = [Simulator(item).run(time_min, flows, START).outputs for item in (cstr(), model)]
    noise = NoiseLevels((0.002, 0.3), (0.0,) * len(model.states))
    found = Filter(model, noise).run(FilterRecord(time_min, flows, measured - clean[0] + clean[1])).normalized[100:]
    nominal = Filter(cstr(), NoiseLevels((0.002, 0.3), (0.0, 0.0))).run(
        FilterRecord(time_min, flows, measured - clean[0] + clean[1])
    )
    assert np.mean(found**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / found.size))
    assert np.mean(nominal.normalized[100:] ** 2) > 1.2
