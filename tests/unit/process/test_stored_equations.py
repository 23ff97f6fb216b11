"""Equations as data: what is read computes the same numbers as what was stored, bit for bit."""

import json
from typing import Any

import casadi as ca
import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.process import MODELS, named_effects
from reactorwatch.process.effect import Effect
from reactorwatch.process.extended_model import (
    BINARY,
    UNARY,
    ExtendedModel,
    build_equations,
    parse_extended_model,
    store_equations,
)
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.model import ProcessModel, fingerprint
from tests.unit.diagnosis.linear_tank import tank

SHIPPED = [make() for make in MODELS]


def store_and_read(model: ProcessModel) -> ProcessModel:
    return build_equations(model.name, json.loads(json.dumps(store_equations(model))))


def values_at(model: ProcessModel) -> list[np.ndarray]:
    states, inputs = (
        np.array([item.lower + 0.4 * (item.upper - item.lower) for item in items])
        for items in (model.states, model.inputs)
    )
    memory = [model.time_offset, *model.terms.values(), *model.at_rest.values(), *model.resets.values()]
    x, u, p = model.arguments()
    other = ca.Function("other", [x, u, p, model.clock.now, model.clock.middle], [ca.vertcat(*memory)])
    return [
        np.array(item)
        for function in (model.function(), other)
        for item in function.call([ca.DM(states), ca.DM(inputs), ca.DM(model.values()), ca.DM(3.0), ca.DM(3.0)])
    ]


@pytest.mark.parametrize("model", [*SHIPPED, tank()], ids=lambda model: model.name)
def test_a_model_and_each_effect_on_it_are_read_as_they_were_stored(model: ProcessModel) -> None:
    assert fingerprint(store_and_read(model)) == fingerprint(model)
    for effect in named_effects(model):
        extended = effect.extend(model)
        read = store_and_read(extended)
        for before, after in zip(values_at(extended), values_at(read), strict=True):
            np.testing.assert_array_equal(after, before, err_msg=effect.name)
        assert read.constant_states == extended.constant_states
        assert [(item.name, item.value, item.lower, item.upper) for item in read.parameters] == [
            (item.name, item.value, item.lower, item.upper) for item in extended.parameters
        ]


@pytest.mark.parametrize("operation", sorted(UNARY | BINARY))
def test_every_operation_is_read_as_it_was_stored(operation: str) -> None:
    model = tank()
    of = [ca.SX(0.3) + model.states[0].symbol, ca.SX(0.7) * model.inputs[0].symbol][: 1 + (operation in BINARY)]
    code = getattr(ca, f"OP_{operation.upper()}")
    rate = ca.SX.binary(code, *of) if operation in BINARY else ca.SX.unary(code, *of)
    changed = model.add_rate(model.state_names[0], rate)
    for before, after in zip(values_at(changed), values_at(store_and_read(changed)), strict=True):
        np.testing.assert_array_equal(after, before)


class OwnEffect(Effect):
    """An effect that no catalogue has: m times the level leaves."""

    name = "drain"
    label = "open drain"
    location = "tank"
    unit = "1/min"
    lower = 0.0
    upper = 10.0
    typical = 0.1

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        return model.add_rate(model.state_names[0], -size * model.states[0].symbol)


def test_an_extended_model_with_an_effect_of_the_users_code_is_read_without_it() -> None:
    model = tank()
    fault = parse_fault("drain:step:0.2@30min", (OwnEffect(),))
    written = ExtendedModel(model.name, (fault,), zero_ns=3_600_000_000_000, equations=fault.extend(model))
    read = parse_extended_model(json.dumps(written.to_object()))
    assert written.to_object()["effects"] == ["drain:step:0.2@30min"]
    for before, after in zip(values_at(fault.extend(model)), values_at(read.build()), strict=True):
        np.testing.assert_array_equal(after, before)
    assert read.rebase(0).build().parameter("drain.onset").value == 90.0
    assert read.rebase(0).build().parameter("drain.size").value == 0.2


def damaged(**changes: Any) -> str:
    stored = store_equations(tank()) | changes
    return json.dumps({"format": "reactorwatch.model.v1", "model": "tank", "equations": stored})


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"steps": []}, "equations: "),
        ({"steps": [["const", 1.0], ["system", 0]]}, "unknown operation 'system'"),
        ({"steps": [["add", 0]]}, "step 0 must have indices of what it acts on, got ['add', 0]"),
        ({"steps": [["neg", -1]]}, "step 0 must have indices"),
        ({"results": [0]}, "results must be"),
        ({"states": []}, "equations must have at least one state, got none"),
        ({"colour": 1}, "unknown field `colour`"),
    ],
)
def test_damaged_equations_are_refused_in_one_line(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError) as refused:
        parse_extended_model(damaged(**changes))
    assert text in str(refused.value)
    assert "\n" not in str(refused.value)


def test_equations_with_an_unknown_symbol_are_refused() -> None:
    model = tank()
    with pytest.raises(ValueError, match="unknown symbols: stray"):
        store_equations(model.add_rate(model.state_names[0], ca.SX.sym("stray")))
