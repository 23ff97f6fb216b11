"""In a noisy process, the errors of sizes agree with their intervals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.process.library.cstr import EFFECTS, cstr
from tests.hidden_effect.catalogue import HiddenEffect, named
from tests.hidden_effect.draw import draw
from tests.hidden_effect.excitation import NAMED_CIRCUMSTANCES

SPAN_MIN = 150.0
SEED = 6000
SMALLEST_SD = (1e-4, 0.01)
UNLUCKY = 1e-3
"""So seldom would right intervals fail on either side."""


def off_in_sd(hidden_effect: HiddenEffect, seed: int) -> float:
    """Error of a constant cause's size, in standard deviations of its fit."""
    circumstances = replace(NAMED_CIRCUMSTANCES["more process noise"], span_min=SPAN_MIN)
    hidden = draw(seed, (hidden_effect,), circumstances, ("constant",))
    run = make_run(hidden.record, cstr())
    effect = next(item for item in EFFECTS if item.name == hidden_effect.name)
    ekf = FaultFilter(cstr(), (effect,), Noise(circumstances.noise_sd, (0.0, 0.0)))
    hypothesis = Hypothesis(ekf, (Constant(run.time_min),))
    truth = hidden.courses[0].size
    fit = hypothesis.evaluate(run, (np.array([truth]),))
    for _ in range(2):
        ekf.noise = ekf.estimate_noise(run, hypothesis.signals(fit), SMALLEST_SD)
        fit = hypothesis.fit(run, fit.parameters)
    return float((fit.parameters[0][0] - truth) / np.sqrt(hypothesis.covariance(run, fit)[0, 0]))


@pytest.mark.slow
def test_sizes_scatter_about_the_truth_with_their_standard_deviations() -> None:
    """Also where the concentration is disturbed and noise levels say, as here mostly, that it is not."""
    smooth = [item for item in named() if not next(one for one in EFFECTS if one.name == item.name).is_discontinuous]
    squares = [off_in_sd(item, SEED + place) ** 2 for place, item in enumerate(smooth)]
    assert chi2.ppf(UNLUCKY, len(squares)) < sum(squares) < chi2.isf(UNLUCKY, len(squares))
