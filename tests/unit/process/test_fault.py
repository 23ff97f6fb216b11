"""Fault specifications: their meaning, and the errors of wrong ones."""

import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr import EFFECTS, OPERATING_STATE, cstr
from reactorwatch.process.profiles import STEP
from reactorwatch.process.simulate import Simulator
from tests.unit.process.effect_named import effect_of


@pytest.mark.parametrize(
    ("text", "values", "canonical"),
    [
        ("coolant_flow:step:-0.05@30min", {"size": -0.05, "onset": 30.0}, None),
        (
            "heat_transfer:ramp:-0.3@0.5h,end=5400s",
            {"size": -0.3, "onset": 30.0, "end": 90.0},
            "heat_transfer:ramp:-0.3@30min,end=90min",
        ),
        (
            " reaction_rate : decay : -2e-1 @ 1800 s , time_constant = 60 min ",
            {"size": -0.2, "onset": 30.0, "time_constant": 60.0},
            "reaction_rate:decay:-0.2@30min,time_constant=60min",
        ),
        (
            "coolant_flow:sine:+.05@10min,phase=1.5,period=20min",
            {"size": 0.05, "onset": 10.0, "period": 20.0, "phase": 1.5},
            "coolant_flow:sine:0.05@10min,period=20min,phase=1.5",
        ),
        ("activation_energy:constant:0.002", {"size": 0.002}, None),
        ("temperature_bias:step:2K", {"size": 2.0}, "temperature_bias:step:2"),
        (
            "coolant_flow:free:-0.05,0min=0,0.5h=.2,90min=1",
            {
                "size": -0.05,
                "time_1": 0.0,
                "time_2": 30.0,
                "time_3": 90.0,
                "value_1": 0.0,
                "value_2": 0.2,
                "value_3": 1.0,
            },
            "coolant_flow:free:-0.05,0min=0,30min=0.2,90min=1",
        ),
        (
            "side_reaction:step:0.1@30min,heat=-20,E2=9000K",
            {"size": 0.1, "onset": 30.0, "E2": 9000.0, "heat": -20.0},
            "side_reaction:step:0.1@30min,E2=9000,heat=-20",
        ),
        (
            "wall_heat_capacity:free:0.1,exchange=4,0min=0,30min=1",
            {"size": 0.1, "exchange": 4.0, "time_1": 0.0, "time_2": 30.0, "value_1": 0.0, "value_2": 1.0},
            "wall_heat_capacity:free:0.1,exchange=4,0min=0,30min=1",
        ),
        ("coolant_flow:ramp:0.1,onset=5min", {"size": 0.1, "onset": 5.0}, "coolant_flow:ramp:0.1@5min"),
    ],
)
def test_a_specification_gives_the_stated_fault(text: str, values: dict[str, float], canonical: str | None) -> None:
    found = parse_fault(text)
    assert found.values == values
    assert str(found) == (canonical or text)
    assert parse_fault(str(found)) == found


CAUSES = ", ".join(effect.name for effect in EFFECTS)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "must be cause:profile:size[@onset][,name=value]..., like coolant_flow:step:-0.05@30min"),
        ("coolant_flow:step", "must be cause:profile:size[@onset][,name=value]..., like coolant_flow:step:-0.05@30min"),
        ("colant_flow:step:1", f"unknown cause 'colant_flow'; did you mean 'coolant_flow'? (valid: {CAUSES})"),
        (
            "coolant_flow:stop:1",
            "unknown profile 'stop'; did you mean 'step'? (valid: constant, step, ramp, decay, sine, free)",
        ),
        ("coolant_flow:step:", "size must be a number, got ''"),
        ("coolant_flow:step:five", "size must be a number, got 'five'"),
        ("coolant_flow:step:nan", "size must be a number, got 'nan'"),
        ("temperature_bias:step:2C", "size must be a number in K, got '2C'"),
        ("coolant_flow:step:-1.5", "size must be in [-0.99, 4], got -1.5"),
        ("temperature_bias:step:1e9", "size must be in [-100, 100] K, got 1e+09"),
        ("coolant_flow:step:0.1@30", "onset must be a time with its unit (s, min, h), like 30min, got '30'"),
        ("coolant_flow:step:0.1@", "onset must be a time with its unit (s, min, h), like 30min, got ''"),
        ("coolant_flow:step:0.1@3days", "onset must be a time with its unit (s, min, h), like 30min, got '3days'"),
        ("coolant_flow:step:0.1@1e999h", "onset must be in [-inf, inf] min, got inf"),
        ("coolant_flow:constant:0.1@3min", "the profile constant has no onset, got '@3min'; leave it out"),
        (
            "coolant_flow:sine:0.1,peroid=3min",
            "unknown parameter of the profile sine 'peroid'; did you mean 'period'? (valid: onset, period, phase)",
        ),
        ("coolant_flow:constant:0.1,end=3min", "unknown parameter of the profile constant 'end' (valid: none)"),
        ("coolant_flow:step:0.1@3min,onset=4min", "onset must be given once, got it again as '4min'"),
        ("coolant_flow:step:0.1,3min", "after the size must come name=value, got '3min'"),
        ("coolant_flow:sine:0.1,period=0min", "period must be in [0.001, inf] min, got 0"),
        (
            "coolant_flow:free:0.1@3min",
            "the profile free has no onset, got '@3min'; leave it out",
        ),
        (
            "coolant_flow:free:0.1,0min=1",
            "a curve must have 2 to 100 times with their shares, like ,0min=0,90min=1, got 1",
        ),
        (
            "coolant_flow:free:0.1," + ",".join(f"{minute}min=1" for minute in range(101)),
            "a curve must have 2 to 100 times with their shares, like ,0min=0,90min=1, got 101",
        ),
        ("coolant_flow:free:0.1,0=1,9min=1", "time must be a time with its unit (s, min, h), like 30min, got '0'"),
        ("coolant_flow:free:0.1,0min,9min=1", "share must be a number, got ''"),
        ("coolant_flow:free:0.1,9min=1,9min=0", "times must rise, got 9 min after 9 min"),
        ("coolant_flow:free:-0.5,0min=1,9min=2", "size times share must be in [-0.99, 4], got -1 at 9 min"),
        ("coolant_flow:ramp:0.1@9min,end=9min", "end must come after the onset, got end 9 min and onset 9 min"),
    ],
)
def test_wrong_part_is_named_in_one_line(text: str, why: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_fault(text)
    assert str(caught.value) == f"fault {text!r}: {why}"


def test_unstated_values_come_from_the_run() -> None:
    assert parse_fault("coolant_flow:ramp:0.1").with_defaults(5.0, 90.0).values == {
        "size": 0.1,
        "onset": 5.0,
        "end": 90.0,
    }
    assert parse_fault("coolant_flow:ramp:0.1@7min,end=8min").with_defaults(5.0, 90.0).values == {
        "size": 0.1,
        "onset": 7.0,
        "end": 8.0,
    }
    assert parse_fault("coolant_flow:constant:0.1").with_defaults(5.0).values == {"size": 0.1}
    assert (
        str(parse_fault("coolant_flow:decay:0.1").with_defaults(5.0))
        == "coolant_flow:decay:0.1@5min,time_constant=60min"
    )


def test_a_ramp_needs_an_end_in_a_run_that_has_none() -> None:
    with pytest.raises(
        InputError, match=r"^fault 'coolant_flow:ramp:0.1': end \(when it reaches its size\) must be given"
    ):
        parse_fault("coolant_flow:ramp:0.1").with_defaults(5.0)
    with pytest.raises(InputError, match="end must come after the onset, got end 30 min and onset 50 min"):
        parse_fault("coolant_flow:ramp:0.1@50min").with_defaults(0.0, 30.0)


def test_extended_model_holds_the_values_and_runs_like_the_effect() -> None:
    times, flows, start = np.arange(40, dtype=np.float64) * 0.1, np.full(40, 100.0), np.array(OPERATING_STATE)
    model = parse_fault("coolant_flow:step:-0.05@2min").extend(cstr())
    assert {item.name: item.value for item in model.parameters[-2:]} == {
        "coolant_flow.size": -0.05,
        "coolant_flow.onset": 2.0,
    }
    by_hand = Simulator(effect_of("coolant_flow").extend(cstr(), STEP))
    expected = by_hand.run(times, flows, start, {"coolant_flow.size": -0.05, "coolant_flow.onset": 2.0})
    np.testing.assert_array_equal(Simulator(model).run(times, flows, start).states, expected.states)


def test_two_faults_of_one_cause_keep_their_own_values() -> None:
    model = parse_fault("coolant_flow:step:-0.05@2min").extend(cstr())
    model = parse_fault("coolant_flow:ramp:0.1").extend(model, end_min=9.0)
    assert {item.name: item.value for item in model.parameters[-5:]} == {
        "coolant_flow.size": -0.05,
        "coolant_flow.onset": 2.0,
        "coolant_flow_2.size": 0.1,
        "coolant_flow_2.onset": 0.0,
        "coolant_flow_2.end": 9.0,
    }
