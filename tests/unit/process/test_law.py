"""Laws of what was unknown: the library of forms, places, and their part in an extended model."""

import json
from typing import Any

import casadi as ca
import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.process import MODELS
from reactorwatch.process.extended_model import extended_model_of, parse_extended_model
from reactorwatch.process.law import (
    APART,
    FORMS,
    LAG,
    ExtendedLaw,
    Form,
    correct,
    places_of,
    unit_of,
    variable_expression,
)
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.model import Place, ProcessModel
from reactorwatch.process.simulate import Simulator

LOSS = ExtendedLaw("energy balance", "power", ("T",), (440.0,), {"a": -0.9, "n": 4.0}, {"T": (425.0, 452.0)})


def extended(law: dict[str, Any]) -> str:
    return json.dumps({"format": "reactorwatch.model.v1", "model": "cstr", "laws": [law]})


def rates_and_outputs(model: ProcessModel) -> Array:
    x = [440.0 if state.unit == "K" else state.scale * (2.0 + i) for i, state in enumerate(model.states)]
    both = model.function()(x, [10.0] * len(model.inputs), model.values(), 0.0, 0.0)
    return np.concatenate([np.array(item).ravel() for item in both])


def as_object(law: ExtendedLaw) -> dict[str, Any]:
    (written,) = extended_model_of(law.extend(cstr())).to_object()["laws"]
    return dict(written)


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.key)
def test_a_form_has_the_same_value_as_numbers_and_as_an_expression(form: Form) -> None:
    v, p = [ca.SX.sym("v"), ca.SX.sym("w")], [ca.SX.sym(item.name) for item in form.parameters]
    function = ca.Function("law", [ca.vertcat(*v), ca.vertcat(*p)], [form.expression(v, p, (440.0, 0.1))])
    numbers = np.linspace(0.3, 1.1, len(p))
    expected = form.expression([np.array([445.0]), np.array([0.09])], list(numbers), (440.0, 0.1))
    assert float(function([445.0, 0.09], numbers)) == pytest.approx(float(expected[0]))


@pytest.mark.parametrize(
    ("model", "place"), [(make(), place) for make in MODELS for place in places_of(make())], ids=lambda item: item.name
)
def test_a_correction_in_a_place_changes_the_equations_unless_it_is_zero(model: ProcessModel, place: Place) -> None:
    for name in place.variables:
        assert variable_expression(model, name).numel() == 1
    before = rates_and_outputs(model)
    assert np.array_equal(before, rates_and_outputs(correct(model, place, ca.SX(0.0))))
    assert not np.array_equal(before, rates_and_outputs(correct(model, place, ca.SX(0.1))))
    assert unit_of(model, place)


@pytest.mark.parametrize("place", places_of(cstr()), ids=lambda place: place.name)
def test_a_law_in_any_place_survives_the_file(place: Place) -> None:
    extra = ({APART: -0.4} if place.apart else {}) | ({LAG: 1.5} if place.lag_min else {})
    law = ExtendedLaw(
        place.name, "linear", place.variables[:1], (1.0,), {"a": 0.01, "b": 0.02} | extra, {"T": (1.0, 2.0)}
    )
    model = law.extend(cstr())
    written = json.dumps(extended_model_of(model).to_object())
    again = parse_extended_model(written).build()
    assert again.laws == (law,)
    assert json.dumps(extended_model_of(again).to_object()) == written


def test_the_plant_with_a_law_loses_the_heat_of_the_formula() -> None:
    time_min = 0.1 * np.arange(50, dtype=np.float64)
    inputs, start = np.full((50, 1), 103.41), np.array([0.1, 438.54])
    free = Simulator(LOSS.extend(cstr())).run(time_min, inputs, start)
    by_hand = cstr()
    T = by_hand.states[1].symbol
    expected = Simulator(by_hand.add_rate("T", -0.9 * (T / 440.0) ** 4)).run(time_min, inputs, start)
    np.testing.assert_allclose(free.states, expected.states, rtol=1e-9)


def test_a_law_states_the_region_without_data() -> None:
    assert LOSS.outside({"T": np.array([430.0, 450.0])}) == []
    (sentence,) = LOSS.outside({"T": np.array([430.0, 460.0])})
    assert "460" in sentence
    assert "425 to 452" in sentence


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"place": "attic"}, "attic"),
        ({"form": "astrology"}, "astrology"),
        ({"parameters": {"a": 1.0}}, "power"),
        ({"variables": ["qx"]}, "qx"),
        ({"variables": ["T", "C"]}, "variables"),
    ],
)
def test_a_wrong_law_in_a_file_is_named(change: dict[str, Any], named: str) -> None:
    with pytest.raises(InputError, match=named):
        parse_extended_model(extended(as_object(LOSS) | change))


def test_two_laws_in_a_model_keep_apart() -> None:
    model = LOSS.extend(LOSS.extend(cstr()))
    assert [name for name in model.parameter_names if name.startswith("law")] == [
        "law.a",
        "law.n",
        "law_2.a",
        "law_2.n",
    ]
