"""Claims for every effect of every process of the catalogue, new ones included."""

from inspect import getdoc
from typing import NamedTuple

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.kalman.batch import FilterRecord
from reactorwatch.kalman.ekf import Filter, FilterState
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process import EFFECTS_OF, LOCATION_PHRASES, MODELS, OPERATIONS
from reactorwatch.process.effect import TIMING, Effect
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import CONSTANT, FREE, PROFILES, RAMP, STEP, Profile, free_profile
from reactorwatch.process.signal_effects import InputTiming, OutputDelay
from reactorwatch.process.simulate import Simulator, reset_function
from reactorwatch.process.steady_state import steady_states
from tests.unit.process.effect_named import effect_of

SHAPE = {"onset": 1.2, "end": 3.4, "time_constant": 0.5, "period": 2.5, "phase": 0.4}  # on samples, where min
SHAPE |= {"time_1": 1.2, "value_1": 0.0, "time_2": 2.5, "value_2": 1.0, "time_3": 4.1, "value_3": -0.4}
SHAPES = (*(profile for profile in PROFILES if profile is not FREE), free_profile(3))
TIMES = np.round(np.arange(60, dtype=np.float64) * 0.1, 9)


class Plant(NamedTuple):
    """A model of the catalogue, a state and inputs of a run in which each of its effects shows."""

    model: ProcessModel
    start: Array
    inputs: Array

    @property
    def noise(self) -> NoiseLevels:
        of_sensors = OPERATIONS[self.model.name].noise_sd
        return NoiseLevels(
            tuple(of_sensors[name] for name in self.model.output_names),
            tuple(0.01 * state.scale for state in self.model.states),
        )


RNG = np.random.default_rng(5)
RUNS: dict[str, tuple[list[float], tuple[float, float]]] = {
    "cstr": ([0.1, 438.54], (95.0, 108.0)),
    "tanks": ([9.5, 6.0], (2.0, 5.0)),  # both come over their brims
    "three_tanks": ([41.0, 32.0, 36.6], (20.0, 60.0)),
}
"""Start, and range of the inputs, by model."""


def _plant(model: ProcessModel) -> Plant:
    start, (low, high) = RUNS[model.name]
    held = [np.repeat(RNG.uniform(low, high, 12), 5) for _ in model.inputs]
    return Plant(model, np.array(start), np.column_stack(held))


PLANTS = {make().name: _plant(make()) for make in MODELS}
ALL = [(PLANTS[name], effect) for name, effects in EFFECTS_OF.items() for effect in effects]
NAMES = [f"{plant.model.name}-{effect.name}" for plant, effect in ALL]
WITH_STATES = [(plant, effect) for plant, effect in ALL if effect.extend(plant.model).at_rest]

of_every_effect = pytest.mark.parametrize(("plant", "effect"), ALL, ids=NAMES)
of_every_effect_with_states = pytest.mark.parametrize(
    ("plant", "effect"), WITH_STATES, ids=[effect.name for _, effect in WITH_STATES]
)


def with_shape(plant: Plant, effect: Effect, profile: Profile, size: float | None = None) -> ProcessModel:
    values = {f"{effect.name}.{item.name}": SHAPE[item.name] for item in profile.parameters}
    values |= {} if size is None else {f"{effect.name}.size": size}
    return effect.extend(plant.model, profile).with_values(values)


def outputs(plant: Plant, model: ProcessModel) -> Array:
    return Simulator(model).run(TIMES, plant.inputs, plant.start).outputs


def assert_same(found: Array, expected: Array, model: ProcessModel, plant: Plant) -> None:
    """To rounding; with states that change at neutral too, to a tenth of what the integrator allows in a step."""
    scale = max(state.scale for state in plant.model.states)
    assert np.all(np.abs(found - expected) <= (1e-7 if model.at_rest else 1e-12) * scale)


@of_every_effect
@pytest.mark.parametrize("profile", [STEP, SHAPES[-1]], ids=lambda profile: profile.name)
def test_at_its_neutral_size_it_is_the_base_model(plant: Plant, effect: Effect, profile: Profile) -> None:
    """To rounding, in every state and at any time; in a run but for how steps are cut for new states."""
    base, extended = plant.model, with_shape(plant, effect, profile)
    of_base, of_extended, reset = base.function(), extended.function(), reset_function(extended)
    rng, n = np.random.default_rng(6), len(base.states)
    for time_min in (-700.0, 0.0, 1.2, 2.0, 3.4, 5000.0):
        x, u = rng.uniform(0.9, 1.1, n) * plant.start, rng.uniform(0.9, 1.1) * plant.inputs[0]
        expected = of_base(x, u, base.values(), time_min, time_min)
        new = [rng.uniform(state.lower, state.upper) for state in extended.states[n:]]
        started = reset([*x, *new], u, extended.values(), time_min)
        found = of_extended(started, u, extended.values(), time_min, time_min)
        for one, other in zip(expected, found, strict=True):
            np.testing.assert_allclose(np.array(other)[: one.numel()], np.array(one), rtol=1e-13)
    assert_same(outputs(plant, extended), outputs(plant, base), extended, plant)


@of_every_effect
@pytest.mark.parametrize("profile", [CONSTANT, STEP, RAMP], ids=lambda profile: profile.name)
def test_before_its_onset_nothing_is_different_and_after_it_something_is(
    plant: Plant, effect: Effect, profile: Profile
) -> None:
    model = with_shape(plant, effect, profile, effect.typical)
    expected, found = outputs(plant, plant.model), outputs(plant, model)
    onset = 0 if profile is CONSTANT else int(np.searchsorted(TIMES, SHAPE["onset"]))
    assert_same(found[:onset], expected[:onset], model, plant)
    least = 0.005 * np.array([OPERATIONS[plant.model.name].noise_sd[name] for name in plant.model.output_names])
    assert np.any(np.abs(found - expected)[onset + 1 :] > least)


@of_every_effect
def test_its_facts_make_sense(plant: Plant, effect: Effect) -> None:
    locations = {place.location for place in plant.model.places} | {TIMING}
    assert effect.lower <= effect.neutral <= effect.upper
    assert effect.label
    assert effect.location in locations
    assert plant.model.name != "cstr" or effect.location in LOCATION_PHRASES
    assert effect.lower <= effect.typical <= effect.upper
    assert effect.typical != effect.neutral
    assert all(effect.lower <= size <= effect.upper for size in effect.start_values)
    assert set(effect.labels) <= {profile.name for profile in PROFILES}
    assert not effect.is_generic


@pytest.mark.parametrize("name", PLANTS)
def test_each_effect_of_a_process_has_a_meaning_of_its_own_which_reports_show(name: str) -> None:
    assert len({getdoc(effect) for effect in EFFECTS_OF[name]}) == len(EFFECTS_OF[name])


@of_every_effect
def test_twice_in_a_model_it_gets_a_number(plant: Plant, effect: Effect) -> None:
    model = effect.extend(effect.extend(plant.model, STEP), RAMP)
    new = model.parameter_names[len(plant.model.parameters) :]
    name = effect.name
    shape = [item for item in new if item.rpartition(".")[2] in ("size", "onset", "end")]
    assert shape == [f"{name}.size", f"{name}.onset", f"{name}_2.size", f"{name}_2.onset", f"{name}_2.end"]
    own = {item.removeprefix(f"{name}.") for item in new if item.startswith(f"{name}.")} - {"size", "onset"}
    assert {item for item in new if item not in shape} == {f"{name}{x}.{item}" for x in ("", "_2") for item in own}


@pytest.mark.parametrize("name", PLANTS)
def test_all_effects_together_at_neutral_are_the_base_model(name: str) -> None:
    plant = PLANTS[name]
    model = plant.model
    for effect in EFFECTS_OF[name]:
        model = effect.extend(model)
    assert_same(outputs(plant, model), outputs(plant, plant.model), model, plant)


def test_a_fact_that_is_no_attribute_of_the_effect_is_refused() -> None:
    with pytest.raises(TypeError, match="OutputDelay has no attribute typcial"):
        OutputDelay(name="late", output="T", typcial=1.0)


def test_profiles_match_their_definitions_in_time() -> None:
    """Read off the bias of the thermometer, which is the profile itself."""
    plant, bias = PLANTS["cstr"], effect_of("temperature_bias")
    since, on = np.maximum(TIMES - 1.2, 0), TIMES >= 1.2
    expected = {
        "constant": np.full(60, 3.0),
        "step": 3.0 * on,
        "ramp": 3.0 * np.minimum(since / 2.2, 1),
        "decay": 3.0 * on * (1 - np.exp(-since / 0.5)),
        "free": 3.0 * np.interp(TIMES, [1.2, 2.5, 4.1], [0.0, 1.0, -0.4]),
        "sine": 3.0 * on * np.sin(2 * np.pi * since / 2.5 + 0.4),
    }
    nominal = outputs(plant, plant.model)
    assert {profile.name for profile in PROFILES} == set(expected)
    for profile in SHAPES:
        found = outputs(plant, with_shape(plant, bias, profile, 3.0))
        np.testing.assert_allclose(found[:, 1] - nominal[:, 1], expected[profile.name], atol=1e-9)
        np.testing.assert_array_equal(found[:, 0], nominal[:, 0])


@pytest.fixture(scope="module")
def measured() -> dict[str, Array]:
    """Noisy measurements of the nominal plants."""
    rng = np.random.default_rng(12)
    clean = {name: outputs(plant, plant.model) for name, plant in PLANTS.items()}
    return {name: y + rng.normal(size=y.shape) * PLANTS[name].noise.measurement_sd for name, y in clean.items()}


@of_every_effect
def test_at_its_neutral_size_its_filter_is_that_of_the_base_model(
    plant: Plant, effect: Effect, measured: dict[str, Array]
) -> None:
    model, noise, n = effect.extend(plant.model), plant.noise, len(plant.model.states)
    of_model = NoiseLevels(noise.measurement_sd, (*noise.process_sd, *(0.0,) * (len(model.states) - n)))
    record = FilterRecord(TIMES, plant.inputs, measured[plant.model.name])
    expected, found = Filter(plant.model, noise).run(record), Filter(model, of_model).run(record)
    np.testing.assert_allclose(found.residual, expected.residual, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.normalized, expected.normalized, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.P[:, :n, :n], expected.P, rtol=1e-6, atol=1e-12)


@of_every_effect
def test_without_noise_a_filter_of_it_predicts_what_the_simulator_runs(plant: Plant, effect: Effect) -> None:
    model = effect.extend(plant.model).with_values({f"{effect.name}.size": effect.typical})
    expected = Simulator(model).run(TIMES, plant.inputs, plant.start)
    x = tuple(expected.states[0].tolist())
    start = FilterState(0.0, tuple(plant.inputs[0].tolist()), x, (0.0,) * len(x) ** 2)
    noise = NoiseLevels(plant.noise.measurement_sd, (0.0,) * len(x))
    unmeasured = FilterRecord(TIMES[1:], plant.inputs[1:], np.full((59, len(model.outputs)), np.nan))
    found = Filter(model, noise).run(unmeasured, start=start)
    assert np.all(np.abs(found.prediction - expected.outputs[1:]) < 0.01 * np.array(noise.measurement_sd))


def test_these_effects_add_states() -> None:
    assert {effect.name for _, effect in WITH_STATES} == {
        "jacket_lag",
        "wall_heat_capacity",
        "valve_lag",
        "valve_stiction",
        "temperature_lag",
        "concentration_delay",
    }
    assert not InputTiming(name="late", label="late").extend(PLANTS["cstr"].model).at_rest


@of_every_effect_with_states
def test_an_effect_with_states_moves_no_steady_state_and_a_run_from_there_stays(plant: Plant, effect: Effect) -> None:
    model = effect.extend(plant.model).with_values({f"{effect.name}.size": effect.typical})
    flow = np.array([100.0])
    expected, found = (steady_states(item, flow) for item in (plant.model, model))
    assert len(found) == 3
    for one, other in zip(expected, found, strict=True):
        np.testing.assert_allclose(other.state[:2], one.state, rtol=1e-9)
        np.testing.assert_allclose(other.outputs, one.outputs, rtol=1e-9)
    run = Simulator(model).run(np.arange(30.0) * 0.1, np.full(30, 100.0), found[-1].state)
    scales = np.array([state.scale for state in model.states])
    assert np.all(np.abs(run.states - found[-1].state) < 1e-6 * scales)


@of_every_effect_with_states
def test_a_short_start_and_a_filter_start_with_its_states_in_equilibrium(plant: Plant, effect: Effect) -> None:
    model = effect.extend(plant.model).with_values({f"{effect.name}.size": effect.typical})
    run = Simulator(model).run(TIMES, plant.inputs, plant.start)
    np.testing.assert_array_equal(Simulator(model).run(TIMES, plant.inputs, run.states[0]).states, run.states)
    kalman = Filter(model, NoiseLevels((0.002, 0.3), (0.001, 0.1, *(0.0,) * (len(model.states) - 2))))
    kalman.update(0.0, (100.0,), (0.09, 441.0))
    started = Simulator(model).run(np.array([0.0, 0.1]), np.full(2, 100.0), np.array(kalman.state.x[:2])).states[0]
    np.testing.assert_allclose(kalman.state.x, started, rtol=1e-9, atol=1e-12)
    P = np.array(kalman.state.P).reshape(len(started), -1)
    assert np.all(np.diag(P)[2:] >= 0.99 * np.array([state.scale for state in model.states[2:]]) ** 2)


def test_a_start_that_is_neither_full_nor_without_states_of_effects_is_refused() -> None:
    model = effect_of("valve_lag").extend(PLANTS["cstr"].model)
    with pytest.raises(ValueError, match=r"^start must be 3 finite numbers \(.*\), got \[1\.\]$"):
        Simulator(model).run(np.arange(2.0), np.full(2, 100.0), np.ones(1))


@of_every_effect_with_states
def test_a_filter_with_the_true_cause_leaves_less_than_the_nominal_one(plant: Plant, effect: Effect) -> None:
    """From a step on: the residual is the noise again, in the mean square; of 2 x 900 values it is 1 to 4 sd of it."""
    rng, time_min = np.random.default_rng(12), np.round(np.arange(1000.0) * 0.1, 9)
    flows = np.repeat(rng.uniform(90, 111, 100), 10)
    step = {f"{effect.name}.size": 3 * effect.typical, f"{effect.name}.onset": 10.0}
    model = effect.extend(plant.model, STEP).with_values(step)
    clean = Simulator(model).run(time_min, flows, plant.start).outputs
    record = FilterRecord(time_min, flows, clean + rng.normal(size=clean.shape) * [0.002, 0.3])
    found, nominal = (
        Filter(item, NoiseLevels((0.002, 0.3), (0.0,) * len(item.states))).run(record).normalized[100:]
        for item in (model, plant.model)
    )
    assert np.mean(found**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / found.size))
    assert np.mean(nominal**2) > 1.2
