"""Three tanks with two inputs: causes named with their place, and unknown where the cause is left out.

The records come from the equations of the process with a deviation of any course in one place.
"""

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.fitting.augmented_model import augment_model
from reactorwatch.diagnosis.fitting.profiles import LateSine, Signal, Sine
from reactorwatch.diagnosis.result import NAMED, UNKNOWN, Diagnosis
from reactorwatch.process import EFFECTS_OF
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import Record

ROWS, ONSET_ROW, NOISE_CM = 1201, 200, 0.15
TIME_MIN: Array = np.arange(ROWS) / 60.0
RAMP = np.maximum(np.arange(ROWS) - ONSET_ROW, 0) / (ROWS - ONSET_ROW)
SINE = (RAMP > 0) * np.sin(2 * np.pi * (TIME_MIN - TIME_MIN[ONSET_ROW]) / 2.0)


def tanks_record(courses: dict[str, Array]) -> Record:
    """Record with deviations in some places; the pumps move as a controller moves them, a little all the time."""
    effects = tuple(effect for effect in EFFECTS_OF["three_tanks"] if effect.name in courses)
    rng = np.random.default_rng(3)
    inputs = np.array([21.4, 53.8]) + 0.1 * np.cumsum(rng.standard_normal((ROWS, 2)), axis=0)
    augmented = augment_model(three_tanks(), effects)
    signals = [Signal(courses[effect.name], courses[effect.name]) for effect in effects]
    values = augmented.inputs(TIME_MIN, inputs, signals)
    levels = Simulator(augmented.model).run(TIME_MIN, values, np.array([41.0, 32.0, 36.6])).outputs
    levels = levels + NOISE_CM * rng.standard_normal(levels.shape)
    columns = dict(zip(("Q1", "Q2", "h1", "h2", "h3"), np.column_stack([inputs, levels]).T, strict=True))
    return Record(TIME_MIN, columns, "tanks")


def found(courses: dict[str, Array], *without: str) -> Diagnosis:
    effects = tuple(effect for effect in EFFECTS_OF["three_tanks"] if effect.name not in without)
    return diagnose(tanks_record(courses), three_tanks(), effects)


@pytest.mark.parametrize(
    ("cause", "size", "without", "places"),
    [
        pytest.param("leak1", 0.1, ("leak1", "pump1"), {"tank1"}, marks=pytest.mark.slow),
        ("clog13", 0.3, ("clog13", "h1.bias"), {"tank1", "tank3"}),
    ],
)
def test_a_growing_fault_is_named_and_without_its_name_unknown_at_its_tank(
    cause: str, size: float, without: tuple[str, ...], places: set[str]
) -> None:
    courses = {cause: size * RAMP}
    known = found(courses)
    assert known.verdict == NAMED
    assert (known.causes[0].cause, known.causes[0].profile) == (cause, "ramp")
    unknown = found(courses, *without)
    assert (unknown.verdict, unknown.causes) == (UNKNOWN, ())
    assert unknown.location in places


def test_sines_that_set_in_later_on_both_pumps_are_one_explanation() -> None:
    said = found({"pump1": 5.0 * SINE, "pump2": 3.0 * SINE})
    assert {(item.cause, item.profile) for item in said.causes} == {("pump1", "sine"), ("pump2", "sine")}
    for item, size in zip(sorted(said.causes, key=lambda each: each.cause), (5.0, 3.0), strict=True):
        assert item.parameters["size"].value == pytest.approx(size, rel=0.1)
        assert item.parameters["onset"].value == pytest.approx(TIME_MIN[ONSET_ROW], abs=0.15)
        assert item.parameters["period"].value == pytest.approx(2.0, rel=0.01)


def test_a_late_sine_continues_the_sine_from_which_it_starts() -> None:
    sine, late = Sine(TIME_MIN), LateSine(TIME_MIN)
    parameters = np.array([0.6, -0.8, 2.3])
    after = TIME_MIN >= 5.0
    expected = np.where(after, sine.signal(parameters).sample_value, 0.0)
    np.testing.assert_allclose(late.signal(late.from_sine(parameters, 5.0)).sample_value, expected, atol=1e-12)
