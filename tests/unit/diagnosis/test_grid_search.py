"""Sizes that act in jumps, and when they set in."""

import numpy as np
import pytest

from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant, Step
from reactorwatch.diagnosis.fitting.refinement import fit_hypothesis, search_coarse, search_fine
from reactorwatch.process.library.cstr import EFFECTS, cstr

from .runs import make_run

STICKS = next(effect for effect in EFFECTS if effect.name == "valve_stiction")
NOISE = Noise((0.002, 0.3), (0.0, 0.0))


@pytest.mark.parametrize(("size", "onset_min"), [(6.0, 150.23), (5.3, 212.07), (3.65, 211.78), (7.33, 175.97)])
def test_an_onset_that_no_slope_leads_to_is_found(size: float, onset_min: float) -> None:
    run = make_run(f"valve_stiction:step:{size}@{onset_min}min", rows=3000)
    hypothesis = Hypothesis(FaultFilter(cstr(), (STICKS,), NOISE), (Step(run.time_min),))
    truth = hypothesis.evaluate(run, (np.array([size, onset_min]),))
    coarse = search_coarse(run, hypothesis, hypothesis.evaluate(run, (np.array([6.3, 40.0]),)))
    found = search_fine(run, hypothesis, coarse)
    assert found.loss <= truth.loss + 1e-6
    # When it began to stick shows only in where it stands from the next move on that it does not follow.
    after = slice(int(10.0 * onset_min) + 100, None)
    np.testing.assert_allclose(found.innovations.x[after, 2], truth.innovations.x[after, 2], atol=0.01)


def test_a_size_is_found_between_the_two_moves_that_it_lies_between() -> None:
    run = make_run("valve_stiction:constant:4.0", rows=1500)
    hypothesis = Hypothesis(FaultFilter(cstr(), (STICKS,), NOISE), (Constant(run.time_min),))
    truth = hypothesis.evaluate(run, (np.array([4.0]),))
    found = fit_hypothesis(run, hypothesis, (np.array([1.5]),))
    assert found.loss <= truth.loss + 1e-6
    assert found.parameters[0][0] == pytest.approx(4.0, abs=0.5)


@pytest.mark.parametrize("onset_min", [0.0, 12.34, 99.95, 149.9])
def test_a_filter_that_resumes_where_a_later_onset_makes_no_difference_gives_the_same_output(onset_min: float) -> None:
    run = make_run("valve_stiction:step:6.0@50.23min", rows=1500)
    hypothesis = Hypothesis(FaultFilter(cstr(), (STICKS,), NOISE), (Step(run.time_min),))
    later = hypothesis.evaluate(run, (np.array([6.0, 149.9]),))
    numbers = (np.array([6.0, onset_min]),)
    whole, rest = hypothesis.evaluate(run, numbers), hypothesis.evaluate(run, numbers, later)
    assert rest.loss == whole.loss
    for one, other in zip((rest.w, *rest.innovations), (whole.w, *whole.innovations), strict=True):
        np.testing.assert_array_equal(one, other)
