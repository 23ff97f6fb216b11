"""A controller that answers to a measurement does not make a sensor's error of what another cause explains."""

import numpy as np
import pytest

from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.law.shapes import find_answers, make_shape
from reactorwatch.diagnosis.law.unknown import start_places
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.process.law import find_place
from reactorwatch.process.library.cstr import cstr
from tests.hidden_effect.catalogue import named
from tests.hidden_effect.draw import Hidden, draw
from tests.hidden_effect.excitation import MEDIUM_NOISE, Circumstances

NOISE = Noise(MEDIUM_NOISE, (0.002, 0.2))


def drifting(cause: str, loop: str, seed: int, span_min: float = 150.0) -> Hidden:
    """A record in which a cause drifts."""
    (effect,) = (item for item in named() if item.name == cause)
    return draw(seed, (effect,), Circumstances(input=loop, span_min=span_min), kinds=("free",))


@pytest.mark.parametrize("cause", ["heat_transfer", "concentration_bias", "temperature_lag"])
@pytest.mark.parametrize("loop", ["rich", "narrow", "few", "closed"])
def test_the_coolant_answers_to_the_thermometer_in_closed_loop_alone(cause: str, loop: str) -> None:
    model = cstr()
    run = make_run(drifting(cause, loop, seed=3).record, model)
    answers = find_answers(model, run)
    assert answers == ({("T", "qc")} if loop == "closed" else set())


def test_the_error_of_a_sensor_does_not_depend_on_an_input_that_answers_to_it() -> None:
    model = cstr()
    run = make_run(drifting("heat_transfer", "closed", seed=3).record, model)
    nominal = Hypothesis(FaultFilter(model, (), NOISE), ()).evaluate(run, ())
    scales, place = start_places(model, run, nominal, NOISE).scales, find_place(model, "thermometer")
    x, moved = np.full((2, 2), [0.1, 438.5]), np.array([[100.0], [109.0]])
    for known, is_constant in ((frozenset[tuple[str, str]](), False), (frozenset({("T", "qc")}), True)):
        shape = make_shape(model, place, scales, known)
        first, second = shape.basis(x, moved)
        assert np.array_equal(first, second) is is_constant


@pytest.mark.slow
@pytest.mark.parametrize(("cause", "seed"), [("heat_transfer", 10300020), ("heat_transfer", 10300022)])
def test_a_drift_in_closed_loop_is_named_and_no_unknown_error_of_the_thermometer(cause: str, seed: int) -> None:
    """An error that follows the coolant was better by thousands in BIC than the cause."""
    result = diagnose(drifting(cause, "closed", seed, span_min=300.0).record, cstr())
    assert (result.verdict, [item.cause for item in result.causes]) == ("named", [cause])
