"""Refine the onset of an input-timing fault; only rows where the input changes are informative.

Between two input changes all onsets are equivalent, and the loss has no slope towards the next interval. So once the
other parameters are fitted, nearby intervals are tried; the search moves to the best of them as long as that gains.
"""

import numpy as np

from reactorwatch.diagnosis.fitting.hypothesis import Fit, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Step
from reactorwatch.diagnosis.run import Run

NEAR = np.array([-8, -4, -2, -1, 1, 2, 4, 8])
"""Intervals to try, relative to the present one."""

MOST_ROUNDS = 8
LEAST_GAIN = 0.1
"""Threshold in log likelihood."""


def refine_onset(run: Run, hypothesis: Hypothesis, best: Fit, steps: int) -> Fit:
    """Refine the onsets of steps that shift the timing; other profiles stay.

    Args:
        run: the record.
        hypothesis: hypothesis with or without such a step.
        best: fit of the hypothesis.
        steps: maximum number of least-squares steps.
    """
    for index, profile in enumerate(hypothesis.profiles):
        if isinstance(profile, Step) and hypothesis.filter.shifts_time(index):
            best = _refine_onset(run, hypothesis, best, index, steps)
    return best


def _refine_onset(run: Run, hypothesis: Hypothesis, best: Fit, index: int, steps: int) -> Fit:
    moves_min = np.concatenate([run.time_min[:1], run.time_min[run.input_changes], run.time_min[-1:]])
    middles_min = 0.5 * (moves_min[1:] + moves_min[:-1])
    for _ in range(MOST_ROUNDS):
        size, onset_min = best.parameters[index]
        here = int(np.searchsorted(moves_min, onset_min + size, side="right")) - 1
        near = here + NEAR
        trials = [np.array([size, onset]) for onset in middles_min[near[(near >= 0) & (near < middles_min.size)]]]
        fits = hypothesis.evaluate_values(run, best, index, trials, best)
        likeliest = min(fits, key=lambda item: item.loss, default=best)
        if not likeliest.loss < best.loss - LEAST_GAIN:
            break
        best = hypothesis.fit(run, likeliest.parameters, steps)
    return best
