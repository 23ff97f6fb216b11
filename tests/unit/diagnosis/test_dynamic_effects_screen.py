"""The screen finds an effect with internal states with its profile: size, onset and time constant."""

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.profiles import Decay, FittedProfile, Ramp, Step
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.dynamic_effects_screen import DynamicEffectsScreen
from reactorwatch.diagnosis.search.screen import DECAYS
from reactorwatch.process.library.cstr import EFFECTS

TIME_MIN: Array = np.arange(0.0, 100.0, 0.1)
LAG = next(effect for effect in EFFECTS if effect.name == "jacket_lag")


@pytest.mark.parametrize(
    ("kind", "parameters"),
    [(Step, [1.5, 40.0]), (Ramp, [1.5, 25.0]), (Decay, [1.5, 30.0, DECAYS[1] * TIME_MIN[-1]])],
    ids=["step", "ramp", "decay"],
)
def test_of_all_courses_the_one_that_is_there_promises_most(kind: type[FittedProfile], parameters: list[float]) -> None:
    random = np.random.default_rng(1)
    g = random.standard_normal((TIME_MIN.size, 2))
    profile = kind(TIME_MIN)
    left = 0.1 * random.standard_normal(g.shape)
    w = g * profile.signal(np.array(parameters)).sample_value[:, None] + left
    run = Run(TIME_MIN, np.zeros((TIME_MIN.size, 1)), np.zeros_like(w))
    found = DynamicEffectsScreen([LAG], run).scale_signature(LAG, w, g)
    best = max(found, key=lambda candidate: candidate.score(run.values))
    assert best.profile.name == profile.name
    assert best.parameters == pytest.approx(parameters, rel=0.03)
    # Twice the gain in log likelihood of a deviation that explains all but what is left.
    assert best.gain == pytest.approx(np.sum(w**2) - np.sum(left**2), rel=0.01)
