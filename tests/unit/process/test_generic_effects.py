"""Effects made from any model, and which of them a process's own effects replace."""

from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reactorwatch.process import EFFECTS_OF, MODELS, effects_of, named_effects
from reactorwatch.process.effect import Effect
from reactorwatch.process.generic import (
    EffectChanges,
    add_generic,
    are_twins,
    generic_effects,
    hidden_sources,
    reference_point,
)
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.model import Output, ProcessModel, new_clock, parameter, variable
from reactorwatch.process.signal_effects import OutputBias
from reactorwatch.process.simulate import reset_function
from reactorwatch.units import conversion
from tests.unit.diagnosis.linear_tank import tank
from tests.unit.process.effect_named import effect_of

of_every_model = pytest.mark.parametrize("make", [*MODELS, tank], ids=lambda make: str(make.__name__))


@of_every_model
def test_every_signal_parameter_and_state_has_its_effects(make: Callable[[], ProcessModel]) -> None:
    model = make()
    expected = {
        f"{name}.{kind}" for name in model.output_names for kind in ("bias", "gain", "lag", "delay", "stuck", "noise")
    }
    kinds = ("gain", "offset", "lag", "delay", "stiction")
    expected |= {f"{name}.{kind}" for name in model.input_names for kind in kinds}
    expected |= {f"{name}.deviation" for name in model.parameter_names}
    expected |= {f"{name}.source" for name in model.state_names}
    names = [effect.name for effect in generic_effects(model)]
    assert sorted(names) == sorted(expected)


@of_every_model
def test_at_the_neutral_size_each_is_the_base_model(make: Callable[[], ProcessModel]) -> None:
    model = make()
    x, u = reference_point(model)
    expected = [np.array(item).ravel() for item in model.function()(x, u, model.values(), 0.0, 0.0)]
    for effect in generic_effects(model):
        extended = effect.extend(model)
        states = np.append(x, np.full(len(extended.states) - x.size, 0.7))
        p = extended.values({f"{effect.name}.size": effect.neutral})
        started = reset_function(extended)(states, u, p, 0.0)
        rates, shown = (np.array(item).ravel() for item in extended.function()(started, u, p, 0.0, 0.0))
        np.testing.assert_allclose(rates[: x.size], expected[0], rtol=1e-12, err_msg=effect.name)
        np.testing.assert_allclose(shown, expected[1], rtol=1e-12, err_msg=effect.name)


@of_every_model
def test_each_is_scaled_within_its_bounds_and_has_a_location_of_the_process(make: Callable[[], ProcessModel]) -> None:
    model = make()
    locations = {*model.output_names, *model.input_names, *(item.balance or item.name for item in model.states)}
    for effect in generic_effects(model):
        assert effect.lower <= effect.neutral != effect.typical <= effect.upper, effect.name
        assert all(effect.lower <= size <= effect.upper for size in effect.start_values), effect.name
        assert effect.location in locations, effect.name
        assert effect.larger.count("{}") == 1, effect.name


REPLACED = {
    "cstr": {
        *("C.bias", "C.gain", "C.delay", "T.bias", "T.lag", "qc.gain", "qc.lag", "qc.stiction", "q.deviation"),
        *("Cf.deviation", "Tf.deviation", "Tcf.deviation", "E_R.deviation", "K1.deviation", "K3.deviation"),
        *("C.source", "T.source"),  # what a feed of another concentration or temperature adds
    },
    "tanks": {"x2.bias", "u.gain", "k1.deviation", "k4.deviation"},
    "three_tanks": {
        *("h1.bias", "h2.bias", "h3.bias", "Q1.offset", "Q2.offset", "a1.deviation", "a2.deviation", "a3.deviation"),
        *("h1.source", "h2.source"),  # what a pump adds
    },
}


@pytest.mark.parametrize("make", MODELS, ids=lambda make: str(make.__name__))
def test_a_generic_effect_is_replaced_by_one_of_the_process_that_does_the_same(
    make: Callable[[], ProcessModel],
) -> None:
    model = make()
    own = EFFECTS_OF[model.name]
    causes = add_generic(model, own)
    assert causes[: len(own)] == own
    left = {effect.name for effect in causes[len(own) :]}
    assert {effect.name for effect in generic_effects(model)} - left == REPLACED[model.name]


def test_a_twin_is_known_by_what_it_does_not_by_its_name_or_unit() -> None:
    class Warm(OutputBias):
        name, location, output = "warm", "temperature_sensor", "T"
        label, unit, lower, upper, typical = "other", "hK", -1.0, 1.0, 0.02

        def sense(self, model: ProcessModel, value: ca.SX, size: ca.SX) -> tuple[ProcessModel, ca.SX]:
            return model, value + 100.0 * size

    model = MODELS[0]()
    one, other = (EffectChanges(model, effect) for effect in (Warm(), effect_of("temperature_bias")))
    assert are_twins(one, other)
    assert not any(
        are_twins(one, EffectChanges(model, effect))
        for effect in EFFECTS_OF["cstr"]
        if effect.name != other.effect.name
    )


def test_a_model_without_a_catalogue_has_the_generic_ones_and_a_text_may_name_them_in_any() -> None:
    own = replace(three_tanks(), name="mine")
    assert effects_of(own) == generic_effects(own)
    names = [effect.name for effect in named_effects(three_tanks())]
    assert len(names) == len(set(names))
    assert {"leak1", "h1.bias", "h2.lag", "h3.source"} <= set(names)
    first: Effect = next(effect for effect in named_effects(three_tanks()) if effect.name == "h1.bias")
    assert first in EFFECTS_OF["three_tanks"]


def test_a_source_is_hidden_unless_an_effect_adds_its_rate_already() -> None:
    own = EFFECTS_OF["three_tanks"]
    assert [item.name for item in hidden_sources(three_tanks(), own)] == [
        "h3.source",
        "h1.h3.exchange",
        "h2.h3.exchange",
    ]
    fewer = tuple(effect for effect in own if effect.name != "pump1")
    assert "h1.source" in [item.name for item in hidden_sources(three_tanks(), fewer)]
    assert hidden_sources(MODELS[0](), EFFECTS_OF["cstr"]) == ()


def test_what_an_exchange_takes_from_one_tank_the_other_gets() -> None:
    model = three_tanks()
    exchange = next(item for item in hidden_sources(model, ()) if item.name == "h1.h3.exchange")
    extended = exchange.extend(model).with_values({"h1.h3.exchange.size": 0.7})
    x, u = reference_point(model)
    before, after = (np.array(item.function()(x, u, item.values(), 0.0, 0.0)[0]).ravel() for item in (model, extended))
    np.testing.assert_allclose(after - before, [0.7, 0.0, -0.7], atol=1e-9)


def heated(unit: str, value: float, bounds: tuple[float, float]) -> ProcessModel:
    """A body in a room whose temperature is a parameter in this unit; the heat loss is in K."""
    scale, offset = conversion(unit, "K", "Ta")
    T, P = variable("T", "K", (200.0, 500.0), 10.0, "body"), variable("P", "W", (0.0, 100.0), 20.0, "heater")
    Ta = parameter("Ta", value, unit, bounds, "room")
    rate = 0.1 * P.symbol - 0.2 * (T.symbol - (scale * Ta.symbol + offset))
    return ProcessModel("body", (T,), (P,), (Ta,), (rate,), (Output("T", "K", T.symbol),), new_clock())


@pytest.mark.parametrize(("unit", "per_K"), [("degC", 1.0), ("°C", 1.0), ("C", 1.0), ("degF", 1.8), ("°F", 1.8)])
@given(room_K=st.floats(250.0, 330.0), share=st.floats(0.01, 0.99))
def test_a_parameter_whose_unit_has_a_zero_of_its_own_deviates_by_a_difference(
    unit: str, per_K: float, room_K: float, share: float
) -> None:
    scale, offset = conversion(unit, "K", "Ta")
    lower, value, upper = ((of - offset) / scale for of in (room_K - 40.0, room_K, room_K + 60.0))
    model, in_K = heated(unit, value, (lower, upper)), heated("K", room_K, (room_K - 40.0, room_K + 60.0))
    (effect,) = (item for item in generic_effects(model) if item.name == "Ta.deviation")
    (of_K,) = (item for item in generic_effects(in_K) if item.name == "Ta.deviation")
    assert effect.unit == unit
    assert (effect.lower, effect.upper) == pytest.approx((-40.0 * per_K, 60.0 * per_K))
    assert effect.typical == pytest.approx(per_K * of_K.typical * room_K)
    assert effect.describe(2.0) == f"Ta higher by 2 {unit}"
    size = effect.lower + share * (effect.upper - effect.lower)
    x, u = reference_point(model)
    rates = []
    for item, made, of in ((effect, model, size), (of_K, in_K, size / per_K / room_K)):
        extended = item.extend(made)
        p = extended.values({"Ta.deviation.size": of})
        rates.append(float(extended.function()(x, u, p, 0.0, 0.0)[0]))
    assert rates[0] == pytest.approx(rates[1], rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("unit", ["K", "degC/min", "1/degC", "W", "1", "deg", "coulomb"])
def test_a_parameter_of_another_unit_deviates_by_a_share(unit: str) -> None:
    kelvin = heated("K", 300.0, (250.0, 400.0))
    room = replace(kelvin.parameters[0], unit=unit)
    (effect,) = (item for item in generic_effects(replace(kelvin, parameters=(room,))) if item.name == "Ta.deviation")
    assert effect.unit == "1"
    assert effect.describe(0.01) == "Ta higher by 1 %"


def test_a_size_in_per_cent_of_a_signal_is_described_as_it_is_and_a_share_in_per_cent() -> None:
    valve = variable("v", "%", (0.0, 100.0), 30.0, "valve")
    level = variable("h", "%", (0.0, 100.0), 10.0, "level")
    bias, leak = (parameter(name, value, "%", (-50.0, 50.0), name) for name, value in (("zero", 0.0), ("leak", 2.0)))
    rate = 0.1 * (valve.symbol + bias.symbol) - 0.2 * (level.symbol + leak.symbol)
    model = ProcessModel(
        "tank", (level,), (valve,), (bias, leak), (rate,), (Output("h", "%", level.symbol),), new_clock()
    )
    described = {item.name: item.describe(1.5) for item in generic_effects(model)}
    for name in ("v.offset", "v.stiction", "h.bias", "h.noise", "zero.deviation", "h.source"):
        assert " 1.5 %" in f" {described[name]}", described[name]
    for name in ("v.gain", "h.gain", "h.stuck", "leak.deviation"):
        assert " 150 %" in f" {described[name]}", described[name]
