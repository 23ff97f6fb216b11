"""A timing shift and its rate: it grows no faster than time passes."""

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.augmented_model import effective_timing
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import MOST_STEPS, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Decay, FittedProfile, Ramp, Step
from reactorwatch.diagnosis.fitting.refinement import refine_onset
from reactorwatch.process.library.cstr import EFFECTS, cstr
from tests.unit.diagnosis.runs import make_run

TIMES: Array = np.cumsum(np.append(0.0, np.random.default_rng(3).choice([0.05, 0.1, 0.2], 100)))


@pytest.mark.parametrize("size", [0.02, 0.1, 0.45])
@pytest.mark.parametrize("after_row_min", [0.0, 0.01, 0.049])
def test_what_sets_in_at_once_grows_as_fast_as_the_clock_goes_until_it_is_all_there(
    size: float, after_row_min: float
) -> None:
    onset = TIMES[40] + after_row_min
    growth, ahead = effective_timing(Step(TIMES).signal(np.array([size, onset])), TIMES)[:2]
    np.testing.assert_allclose(ahead, np.clip(TIMES - onset, 0.0, size), rtol=0, atol=1e-12)
    np.testing.assert_allclose(growth[:-1] * np.diff(TIMES), np.diff(ahead), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("kind", "parameters"), [(Ramp, [0.4, 2.0]), (Decay, [0.4, 2.03, 1.0])])
def test_what_grows_slowly_is_as_large_as_it_is(kind: type[FittedProfile], parameters: list[float]) -> None:
    signal = kind(TIMES).signal(np.array(parameters))
    np.testing.assert_array_equal(effective_timing(signal, TIMES).sample_value, signal.sample_value)


@pytest.mark.parametrize("start_min", [37.5, 40.0, 44.2])
def test_an_onset_that_no_slope_leads_to_is_found_from_another_stretch_between_two_moves(start_min: float) -> None:
    """The input moves every minute, and the sensors tell each stretch from the next."""
    run = make_run("sample_timing:step:0.06@40.53min", rows=900)
    timing = next(effect for effect in EFFECTS if effect.name == "sample_timing")
    hypothesis = Hypothesis(FaultFilter(cstr(), (timing,), Noise((0.002, 0.3), (0.0, 0.0))), (Step(run.time_min),))
    truth = hypothesis.evaluate(run, (np.array([0.06, 40.53]),))
    best = refine_onset(run, hypothesis, hypothesis.fit(run, (np.array([0.05, start_min]),)), MOST_STEPS)
    assert best.loss < truth.loss + 0.1
    assert best.parameters[0][1] == pytest.approx(40.53, abs=1.0)
