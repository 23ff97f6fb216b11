"""The file of an extended model: it is read as it was written, and an error is reported in one line."""

import json

import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.process.extended_model import ExtendedModel, extended_model_of, parse_extended_model
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.simulate import Simulator

FAULTS = (
    "coolant_flow:step:-0.049876543210123456@312.33333333333331min",
    "heat_transfer:ramp:-0.3@30min,end=90min",
    "reaction_rate:decay:-0.02@30.1min,time_constant=61.7min",
    "feed_temperature:sine:2.5@0min,period=39.97min,phase=-0.014016033593196994",
    "activation_energy:constant:0.002",
    "temperature_bias:free:1.5,0min=0.1,50min=-0.33333333333333331,100min=1",
    "coolant_flow:constant:0.01",
)


def written(**changes: object) -> str:
    plain: dict[str, object] = {"format": "reactorwatch.model.v1", "model": "cstr", "effects": [FAULTS[0]]}
    return json.dumps(plain | changes)


def test_what_is_written_is_what_is_read() -> None:
    model = ExtendedModel("cstr", tuple(parse_fault(text) for text in FAULTS), {"q": 99.5}, 123_456)
    text = json.dumps(model.to_object())
    assert parse_extended_model(text).to_object() == model.to_object()
    assert [str(item) for item in parse_extended_model(text).effects] == [str(parse_fault(item)) for item in FAULTS]


def test_the_model_that_is_read_runs_as_the_faults_do() -> None:
    model = cstr().with_values({"q": 99.5})
    for text in FAULTS:
        model = parse_fault(text).extend(model)
    time_min = np.arange(0.0, 120.0, 0.5)
    inputs = np.full((time_min.size, 1), 100.0)
    start = np.array([0.09, 441.0])
    read = parse_extended_model(written(effects=FAULTS, parameters={"q": 99.5})).build()
    expected = Simulator(model).run(time_min, inputs, start).outputs
    assert np.array_equal(Simulator(read).run(time_min, inputs, start).outputs, expected)


def test_the_effects_of_a_model_follow_from_its_parameters() -> None:
    read = parse_extended_model(written(effects=FAULTS, parameters={"q": 99.5}))
    assert extended_model_of(read.build()).to_object() == read.to_object()
    assert extended_model_of(cstr()).to_object()["effects"] == []


def test_minutes_counted_from_another_moment_name_the_same_moments() -> None:
    hour_ns = 3_600_000_000_000
    model = ExtendedModel("cstr", tuple(parse_fault(text) for text in FAULTS), zero_ns=1000 * hour_ns)
    later = model.rebase(999 * hour_ns)
    for before, after in zip(model.effects, later.effects, strict=True):
        for item in before.profile.parameters:
            shift = 60.0 if item.breakpoint else 0.0
            assert after.values[item.name] == pytest.approx(before.values[item.name] + shift, abs=1e-9)
        assert after.values["size"] == before.values["size"]


def test_minutes_of_an_unknown_moment_stay_as_they_are() -> None:
    model = ExtendedModel("cstr", (parse_fault(FAULTS[0]),))
    assert model.rebase(10**18) is model


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{", "is not JSON"),
        ("[]", "is no model"),
        ('{"verdict": "named"}', "is no model"),
        (
            written(format="reactorwatch.model.v9"),
            "format must be 'reactorwatch.model.v1', got 'reactorwatch.model.v9'",
        ),
        (written(model="boiler"), "unknown model 'boiler' (valid: cstr, tanks, three_tanks)"),
        (written(effects=["coolant:step:1@1min"]), "unknown cause 'coolant'"),
        (written(effects=["coolant_flow:ramp:-0.1@1min"]), "end"),
        (written(effects=[1]), "is no model"),
        (written(parameters={"z": 1.0}), "has no parameter 'z'"),
        (written(parameters={"q": -1.0}), "q must be in [1, 1000], got -1"),
        (written(paramters={}), "paramters"),
    ],
)
def test_a_file_that_is_no_model_is_reported_in_one_line(text: str, expected: str) -> None:
    with pytest.raises(InputError) as told:
        parse_extended_model(text)
    assert expected in str(told.value)
    assert "\n" not in str(told.value)
