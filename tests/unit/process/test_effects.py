"""Claims for every effect of the catalogue, new ones included."""

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr import EFFECTS, LOCATIONS, OPERATING_STATE, cstr
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import CONSTANT, FREE, PROFILES, RAMP, STEP, Profile, free_profile
from reactorwatch.process.simulate import Simulator, reset_function
from tests.unit.process.effect_named import effect_of

SHAPE = {"onset": 1.2, "end": 3.4, "time_constant": 0.5, "period": 2.5, "phase": 0.4}  # on samples, where min
SHAPE |= {"time_1": 1.2, "value_1": 0.0, "time_2": 2.5, "value_2": 1.0, "time_3": 4.1, "value_3": -0.4}
SHAPES = (*(profile for profile in PROFILES if profile is not FREE), free_profile(3))
TIMES = np.round(np.arange(60, dtype=np.float64) * 0.1, 9)
FLOWS = np.repeat(np.random.default_rng(5).uniform(95, 108, 12), 5)
START = np.array(OPERATING_STATE)

of_every_effect = pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
with_every_profile = pytest.mark.parametrize("profile", SHAPES, ids=lambda profile: profile.name)


def with_shape(effect: Effect, profile: Profile) -> ProcessModel:
    return effect.extend(cstr(), profile).with_values(
        {f"{effect.name}.{item.name}": SHAPE[item.name] for item in profile.parameters}
    )


def assert_same(found: Array, expected: Array, model: ProcessModel) -> None:
    """To the last bit; with states that change at neutral too, to a tenth of what the integrator allows in a step."""
    off = 1e-7 * np.array([state.scale for state in cstr().states]) if model.at_rest else 0.0
    assert np.all(np.abs(found - expected) <= off)


@of_every_effect
@with_every_profile
def test_at_its_neutral_size_it_is_the_base_model(effect: Effect, profile: Profile) -> None:
    """To the last bit, in every state and at any time; in a run but for how steps are cut for new states."""
    base, extended = cstr(), with_shape(effect, profile)
    of_base, of_extended, begun = base.function(), extended.function(), reset_function(extended)
    rng = np.random.default_rng(6)
    for time_min in (-700.0, 0.0, 1.2, 2.0, 3.4, 5000.0):
        x = [rng.uniform(0, 1), rng.uniform(340, 560)]
        u = rng.uniform(0, 200)
        expected = of_base(x, u, base.values(), time_min, time_min)
        new = [rng.uniform(state.lower, state.upper) for state in extended.states[2:]]
        begun_x = begun([*x, *new], u, extended.values(), time_min)
        found = of_extended(begun_x, u, extended.values(), time_min, time_min)
        for one, other in zip(expected, found, strict=True):
            np.testing.assert_array_equal(np.array(one), np.array(other)[:2])
    expected_run, found_run = (Simulator(model).run(TIMES, FLOWS, START) for model in (base, extended))
    assert_same(found_run.states[:, :2], expected_run.states, extended)
    assert_same(found_run.outputs, expected_run.outputs, extended)


@of_every_effect
@with_every_profile
def test_before_its_onset_nothing_is_different_and_after_it_something_is(effect: Effect, profile: Profile) -> None:
    model = with_shape(effect, profile).with_values({f"{effect.name}.size": effect.typical})
    expected, found = (Simulator(item).run(TIMES, FLOWS, START).outputs for item in (cstr(), model))
    onset = 0 if profile is CONSTANT else int(np.searchsorted(TIMES, SHAPE["onset"]))
    assert_same(found[:onset], expected[:onset], model)
    assert np.any(np.abs(found - expected)[onset + 1 :] > [1e-5, 1e-3])


@of_every_effect
def test_its_facts_make_sense(effect: Effect) -> None:
    assert effect.lower <= effect.neutral <= effect.upper
    assert effect.label
    assert effect.location in LOCATIONS
    assert effect.lower <= effect.typical <= effect.upper
    assert effect.typical != effect.neutral
    assert all(effect.lower <= size <= effect.upper for size in effect.start_values)
    assert set(effect.labels) <= {profile.name for profile in PROFILES}


@of_every_effect
def test_twice_in_a_model_it_gets_a_number(effect: Effect) -> None:
    model = effect.extend(effect.extend(cstr(), STEP), RAMP)
    new = model.parameter_names[len(cstr().parameters) :]
    name = effect.name
    shape = [item for item in new if item.rpartition(".")[2] in ("size", "onset", "end")]
    assert shape == [f"{name}.size", f"{name}.onset", f"{name}_2.size", f"{name}_2.onset", f"{name}_2.end"]
    own = {item.removeprefix(f"{name}.") for item in new if item.startswith(f"{name}.")} - {"size", "onset"}
    assert {item for item in new if item not in shape} == {f"{name}{x}.{item}" for x in ("", "_2") for item in own}


def test_all_effects_together_at_neutral_are_the_base_model() -> None:
    model = cstr()
    for effect in EFFECTS:
        model = effect.extend(model)
    expected, found = (Simulator(item).run(TIMES, FLOWS, START).outputs for item in (cstr(), model))
    assert_same(found, expected, model)


def test_coolant_flow_is_the_command_times_one_plus_its_size() -> None:
    model = effect_of("coolant_flow").extend(cstr()).with_values({"coolant_flow.size": -0.05})
    found = Simulator(model).run(TIMES, FLOWS, START).states
    np.testing.assert_allclose(found, Simulator(cstr()).run(TIMES, 0.95 * FLOWS, START).states, rtol=1e-12)


def test_heat_transfer_is_k3() -> None:
    model = effect_of("heat_transfer").extend(cstr()).with_values({"heat_transfer.size": -0.3})
    found = Simulator(model).run(TIMES, FLOWS, START).states
    np.testing.assert_allclose(found, Simulator(cstr()).run(TIMES, FLOWS, START, {"K3": 490.0}).states, rtol=1e-12)


@pytest.mark.parametrize(
    ("cause", "changes"),
    [
        ("reaction_rate", {"k0": 7.2e10 * 1.02, "K1": 1.44e13 * 1.02}),
        ("activation_energy", {"E_R": 1e4 * 1.02}),
        ("reaction_heat", {"K1": 1.44e13 * 1.02}),
        ("feed_flow", {"q": 102.0}),
        ("feed_temperature", {"Tf": 350.02}),
        ("feed_concentration", {"Cf": 1.02}),
        ("coolant_temperature", {"Tcf": 350.02}),
    ],
)
def test_effects_on_a_constant_are_that_constant_changed(cause: str, changes: dict[str, float]) -> None:
    effect = effect_of(cause)
    found = Simulator(effect.extend(cstr())).run(TIMES, FLOWS, START, {f"{cause}.size": 0.02}).states
    np.testing.assert_allclose(found, Simulator(cstr()).run(TIMES, FLOWS, START, changes).states, rtol=1e-12)


def test_heat_loss_is_newton_s_cooling_to_the_surroundings() -> None:
    """With neither reaction nor coolant: dT/dt = q/V (Tf - T) - m (T - 298), whose solution is an exponential."""
    effect = effect_of("heat_loss")
    model = effect.extend(cstr()).with_values({"k0": 0.0, "K1": 0.0, "K2": 0.0, "heat_loss.size": 0.5})
    rest = (350.0 + 0.5 * 298.0) / 1.5
    found = Simulator(model).run(TIMES, FLOWS, START).outputs[:, 1]
    np.testing.assert_allclose(found, rest + (START[1] - rest) * np.exp(-1.5 * TIMES), rtol=0, atol=1e-5)


def test_effects_on_the_analyser_change_what_it_shows_and_nothing_else() -> None:
    nominal = Simulator(cstr()).run(TIMES, FLOWS, START)
    for cause, factor, shift in (("concentration_bias", 1.0, 0.01), ("concentration_gain", 1.01, 0.0)):
        effect = effect_of(cause)
        run = Simulator(effect.extend(cstr())).run(TIMES, FLOWS, START, {f"{cause}.size": 0.01})
        np.testing.assert_array_equal(run.states, nominal.states)
        np.testing.assert_array_equal(run.outputs[:, 1], nominal.outputs[:, 1])
        np.testing.assert_allclose(run.outputs[:, 0], factor * nominal.outputs[:, 0] + shift, rtol=1e-14)


def test_profiles_match_their_definitions_in_time() -> None:
    """Read off the bias of the thermometer, which is the profile itself."""
    bias = effect_of("temperature_bias")
    since = np.maximum(TIMES - 1.2, 0)
    on = TIMES >= 1.2
    expected = {
        "constant": np.full(60, 3.0),
        "step": 3.0 * on,
        "ramp": 3.0 * np.minimum(since / 2.2, 1),
        "decay": 3.0 * on * (1 - np.exp(-since / 0.5)),
        "free": 3.0 * np.interp(TIMES, [1.2, 2.5, 4.1], [0.0, 1.0, -0.4]),
        "sine": 3.0 * on * np.sin(2 * np.pi * since / 2.5 + 0.4),
    }
    nominal = Simulator(cstr()).run(TIMES, FLOWS, START).outputs
    assert {profile.name for profile in PROFILES} == set(expected)
    for profile in SHAPES:
        run = Simulator(with_shape(bias, profile)).run(TIMES, FLOWS, START, {"temperature_bias.size": 3.0})
        np.testing.assert_allclose(run.outputs[:, 1] - nominal[:, 1], expected[profile.name], atol=1e-9)
        np.testing.assert_array_equal(run.outputs[:, 0], nominal[:, 0])
