"""The extended model contains the diagnosed causes."""

import json

import numpy as np
import pytest

from reactorwatch.diagnosis.estimates import extended_model
from reactorwatch.diagnosis.fitting.profiles import Decay, FittedProfile, PiecewiseLinear, Ramp, Sine, Step
from reactorwatch.diagnosis.result import Cause, Estimate
from reactorwatch.process.extended_model import parse_extended_model
from reactorwatch.process.library.cstr import EFFECTS, cstr
from reactorwatch.process.model import ProcessModel

TIMES_MIN = np.arange(0.0, 100.05, 0.1)


def cause_of(name: str, profile: FittedProfile, fitted: list[float]) -> Cause:
    parameters = {key: Estimate(value, 0.0, "1") for key, value in profile.profile_values(np.array(fitted)).items()}
    return Cause(cause=name, profile=profile.name, label=name, location="coolant", parameters=parameters)


def deviation(model: ProcessModel, times_min: list[float]) -> list[float]:
    """m(t) of a bias of the thermometer, from what it shows of 440 K."""
    found = []
    shown = model.function("model")
    for time in times_min:
        _, y = shown([0.1, 440.0], [100.0], model.values(), time, time)
        found.append(float(y[1]) - 440.0)
    return found


@pytest.mark.parametrize(
    ("profile", "fitted"),
    [
        (Step(TIMES_MIN), [1.5, 33.33]),
        (Ramp(TIMES_MIN), [-2.0, 20.0]),
        (Decay(TIMES_MIN), [3.0, 10.0, 25.0]),
        (Sine(TIMES_MIN), [0.6, -0.8, 17.0]),
        (PiecewiseLinear(TIMES_MIN, 5), [0.0, 1.0, -3.0, 0.5, 2.0]),
        (PiecewiseLinear(TIMES_MIN, 4), [0.0, 0.0, 0.0, 0.0]),
    ],
)
def test_the_written_profile_is_the_fitted_course(profile: FittedProfile, fitted: list[float]) -> None:
    written = extended_model(cstr(), EFFECTS, [cause_of("temperature_bias", profile, fitted)])
    model = parse_extended_model(json.dumps(written)).build()
    expected = profile.signal(np.array(fitted)).sample_value
    places = [0, 150, 333, 334, 600, 1000]
    np.testing.assert_allclose(deviation(model, TIMES_MIN[places].tolist()), expected[places], atol=1e-9)


def test_a_curve_at_the_bounds_of_its_effect_can_be_read_again() -> None:
    written = extended_model(
        cstr(), EFFECTS, [cause_of("coolant_flow", PiecewiseLinear(TIMES_MIN, 3), [-0.99, 0.3, 4.0])]
    )
    values = parse_extended_model(json.dumps(written)).effects[0].values
    assert [values["size"] * values[f"value_{number}"] for number in (1, 2, 3)] == pytest.approx([-0.99, 0.3, 4.0])


def test_effects_that_are_in_the_model_already_stay() -> None:
    first = extended_model(cstr(), EFFECTS, [cause_of("heat_loss", Step(TIMES_MIN), [0.1, 5.0])], 17)
    model = parse_extended_model(json.dumps(first)).build()
    both = extended_model(model, EFFECTS, [cause_of("heat_loss", Step(TIMES_MIN), [0.2, 50.0])], 17)
    assert both["effects"] == ["heat_loss:step:0.1@5min", "heat_loss:step:0.2@50min"]
    assert both["zero_ns"] == 17
