"""The onset of late stamps: it is felt only where an input moves.

Between two moves one onset is as good as another, and no slope leads from there to the next stretch. So once the other
numbers are fitted, the onset is tried in the stretches near by, and goes on to the best of them while that gains.
"""

import numpy as np

from reactorwatch.diagnosis.fitting.hypothesis import Fit, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Step
from reactorwatch.diagnosis.run import Run

NEAR = np.array([-8, -4, -2, -1, 1, 2, 4, 8])
"""Stretches that are tried, from where it is."""

MOST_ROUNDS = 8
LEAST_GAIN = 0.1
"""In log likelihood."""


def walked(run: Run, hypothesis: Hypothesis, best: Fit, steps: int) -> Fit:
    """With the onset of a step that moves the clock in the best stretch near by; without such a step, as it is.

    Args:
        run: the record.
        hypothesis: any.
        best: a fit of it.
        steps: of least squares, at most.
    """
    for place, course in enumerate(hypothesis.courses):
        if isinstance(course, Step) and hypothesis.sized.moves_clock(place):
            best = _walked(run, hypothesis, best, place, steps)
    return best


def _walked(run: Run, hypothesis: Hypothesis, best: Fit, place: int, steps: int) -> Fit:
    moves_min = np.concatenate([run.time_min[:1], run.time_min[run.moves], run.time_min[-1:]])
    middles_min = 0.5 * (moves_min[1:] + moves_min[:-1])
    for _ in range(MOST_ROUNDS):
        size, onset_min = best.theta[place]
        here = int(np.searchsorted(moves_min, onset_min + size, side="right")) - 1
        near = here + NEAR
        trials = [
            [np.array([size, onset]) if other == place else item for other, item in enumerate(best.theta)]
            for onset in middles_min[near[(near >= 0) & (near < middles_min.size)]]
        ]
        likeliest = min(hypothesis.at_all(run, trials, best), key=lambda item: item.loss, default=best)
        if not likeliest.loss < best.loss - LEAST_GAIN:
            break
        best = hypothesis.fit(run, likeliest.theta, steps)
    return best
