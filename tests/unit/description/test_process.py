"""A process is described once, and an error in a description is reported in one line."""

from collections.abc import Callable
from typing import Any

import casadi as ca
import pytest

from reactorwatch.description.process import KnownParameter, Process, Signal, describe_model
from reactorwatch.description.read import find_process
from reactorwatch.errors import InputError
from reactorwatch.process import EFFECTS_OF
from reactorwatch.process.effect import Effect, ParameterShift
from reactorwatch.process.library.cascaded_tanks import tanks
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.model import ProcessModel

Q = Signal("q", "l/s", "input")
TH = Signal("th", "degC", "output")


def test_signals_are_found_by_their_role_in_the_order_given() -> None:
    process = Process("exchanger", (TH, Q, Signal("sp", role="setpoint"), Signal("m", role="mode")))
    assert (process.inputs, process.outputs, process.names("setpoint"), process.names("mode")) == (
        ("q",),
        ("th",),
        ("sp",),
        ("m",),
    )
    assert process.units == {"th": "degC", "q": "l/s"}
    assert process.model is None


@pytest.mark.parametrize(
    ("signals", "text"),
    [
        ((), "at least one signal must be an output, got no signals"),
        ((Q,), r"at least one signal must be an output, got q \(input\)"),
        ((Q, TH, TH), r"a name of its own, got 'th' for th \(output\) and th \(output\)"),
        ((Q, Signal("y", role="output", column="q")), r"a column of its own, got 'q' for q \(input\) and y \(output\)"),
        ((Signal("a", column=3), Signal("b", column=3)), "a column of its own, got 3"),
    ],
)
def test_signals_that_do_not_make_a_process_are_refused_by_name(signals: tuple[Signal, ...], text: str) -> None:
    with pytest.raises(InputError, match=text):
        Process("exchanger", signals)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"name": ""}, "name of a signal"),
        ({"name": "a/b"}, "name of a signal"),
        ({"name": " a"}, "name of a signal"),
        ({"role": "inptu"}, "role must be one of input, output, setpoint, mode, label, got 'inptu'"),
        ({"resolution": 0.0}, "resolution must be a positive number"),
        ({"resolution": float("nan")}, "resolution must be a positive number"),
        ({"bounds": (1.0, 1.0)}, "bounds must be a lower and a higher number"),
        ({"bounds": (float("nan"), 1.0)}, "bounds must be"),
    ],
)
def test_a_signal_that_breaks_a_rule_is_refused(values: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=text):
        Signal(**{"name": "th", **values})


def test_equations_take_the_given_values_of_their_parameters_in_any_unit_of_the_same_quantity() -> None:
    tanks = find_process("three_tanks")
    process = Process(
        "rig",
        tanks.signals,
        three_tanks(),
        parameters={"A": (0.0160, 0.0002, "m^2"), "a1": KnownParameter(0.5, 0.01)},
    )
    assert process.model is not None
    assert process.model.parameter("A").value == pytest.approx(160.0)
    assert process.model.parameter("a1").value == 0.5
    assert process.uncertain == {"A": pytest.approx(2.0), "a1": 0.01}


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"B": (1.0, 0.0, "")}, "no parameter 'B'"),
        ({"a1": (5.0, 0.0, "1")}, "a1"),
        ({"A": (154.0, 0.0, "cm")}, "unit must convert to 'cm2', got 'cm'"),
        ({"A": (154.0, -1.0, "cm2")}, "sd must be at least 0, got -1"),
    ],
)
def test_a_parameter_that_does_not_fit_the_equations_is_refused(parameters: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=text):
        Process("rig", find_process("three_tanks").signals, three_tanks(), parameters=parameters)


def test_equations_need_their_signals_in_units_that_convert() -> None:
    signals = find_process("three_tanks").signals
    with pytest.raises(InputError, match=r"its equations need the input 'Q2', got the inputs Q1"):
        Process("rig", tuple(item for item in signals if item.name != "Q2"), three_tanks())
    wrong = tuple(Signal(item.name, "K", item.role) if item.name == "h3" else item for item in signals)
    with pytest.raises(InputError, match=r"signal 'h3': unit must convert to 'cm', got 'K'"):
        Process("rig", wrong, three_tanks())


@pytest.mark.parametrize("name", ["cstr", "tanks", "cascaded_tanks", "three_tanks"])
def test_a_shipped_process_has_the_signals_of_its_equations_and_effects(name: str) -> None:
    process = find_process(name)
    assert process.model is not None
    assert process.inputs == process.model.input_names
    assert process.outputs == process.model.output_names
    assert process.units == process.model.units
    assert process.effects


def test_a_process_is_diagnosed_with_its_own_effects_or_the_generic_ones() -> None:
    equations, own = tanks(), EFFECTS_OF["tanks"]
    signals = describe_model(equations).signals
    named = [effect.name for effect in own]
    assert [effect.name for effect in Process("rig", signals, equations, own).causes] == named
    bare = [effect.name for effect in Process("rig", signals, equations).causes]
    assert "x1.source" in bare
    assert not set(named) & set(bare)
    both = [effect.name for effect in Process("rig", signals, equations, own, generic=True).causes]
    assert both[: len(named)] == named
    assert {"x1.source", "x2.gain"} <= set(both)
    assert not {"x2.bias", "u.gain"} & set(both)


def test_a_cause_is_left_out_without_its_generic_twin_and_an_unknown_one_is_refused() -> None:
    equations = tanks()
    process = Process("rig", describe_model(equations).signals, equations, EFFECTS_OF["tanks"], generic=True)
    left = {effect.name for effect in process.select_causes(("level_bias",))}
    assert left == {effect.name for effect in process.causes} - {"level_bias"}
    assert "x2.bias" not in left
    with pytest.raises(InputError, match=r"process 'rig': unknown cause 'level_bais'; did you mean 'level_bias'"):
        process.select_causes(("level_bais",))


def strayed() -> ProcessModel:
    return three_tanks().add_rate("h1", ca.SX.sym("zz"))


class Misfit(ParameterShift):
    """An effect on a parameter that the tanks do not have."""

    name = "misfit"
    label = "misfit"
    location = "h1"
    unit = "1"
    lower, upper, typical = -1.0, 1.0, 0.1
    parameter = "K7"


@pytest.mark.parametrize(
    ("make", "effects", "text"),
    [
        (strayed, (Misfit(),), r"process 'rig': the equations have unknown symbols: zz; write them with its states"),
        (
            three_tanks,
            (Misfit(),),
            r"process 'rig', effect 'misfit': must extend the equations, got ValueError: .*'K7'",
        ),
    ],
)
def test_code_of_the_user_that_makes_no_process_is_refused_before_it_is_used(
    make: Callable[[], ProcessModel], effects: tuple[Effect, ...], text: str
) -> None:
    with pytest.raises(InputError, match=text):
        Process("rig", find_process("three_tanks").signals, make(), effects)
