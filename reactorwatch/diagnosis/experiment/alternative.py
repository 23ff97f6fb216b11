"""A rival explanation as it would go on while another input is tried, and how well another could imitate it.

The causes stay in the plant. What set in stays as large as it was at the end of the record; what swings goes on
swinging. So an input that has not been tried yet has a predicted course of outputs under each rival.

Say rival i is true. What the record of the experiment would hold against rival j is not the difference of the two
predictions but the part of it that j cannot imitate by other numbers (Atkinson & Fedorov 1975, The design of
experiments for discriminating between two rival models, Biometrika 62; Hunter & Reiner 1965, Designs for discriminating
between two rival models, Technometrics 7). It is taken where the diagnosis will take it: the filter of j is run over
what i predicts, without noise. With w its whitened innovations, g their derivatives by the numbers of j and L what is
known of these numbers beforehand,

    lambda = w'w - w'g (g'g + L)^-1 g'w

is the noncentrality of the likelihood ratio test of j: with noise, twice the logarithm of the likelihood ratio is on
average lambda, up to the numbers fitted, and its standard deviation is 2 sqrt(lambda). As that filter has the noise of
the process in it, evidence that such noise would hide does not count. Of the numbers only their bounds are taken to be
known, not what the present record says of them: the record of the experiment shall decide by itself, also if the
cause has grown or shrunk meanwhile. Evaluated together with the present record it says no less.
"""

from math import sqrt

import numpy as np
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.grid_search import fitted
from reactorwatch.diagnosis.fitting.hypothesis import Fit, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant, Course, Sine
from reactorwatch.diagnosis.result import LISTED
from reactorwatch.diagnosis.run import Run
from reactorwatch.process.integrate import SimulationError
from reactorwatch.process.simulate import Simulator, Trajectory

REFINED_STEPS = 1
"""Of a fit: the first one leads where the linear equations say, to what the nonlinear ones make of it."""

LARGEST_SHARE = 0.5
"""Of the time that is looked at: what swings more slowly is taken to stay as it is."""


class Rival:
    """An explanation that has been fitted to a record, going on after its end.

    Attributes:
        causes: names of its effects.
        label: what people call them.
        freedom: how many numbers are fitted to a record of the experiment.
        begin_min: when the experiment begins.

    Args:
        hypothesis: with the noise that holds.
        fit: of it.
        run: the record.
        resting: the inputs at which the plant settles before the experiment, shape (n_u,).
        rest_rows: how many rows it has for that.
        pattern_min: what swings must swing faster than this to be taken for swinging.
    """

    def __init__(
        self, hypothesis: Hypothesis, fit: Fit, run: Run, resting: Array, rest_rows: int, pattern_min: float
    ) -> None:
        self.causes = hypothesis.causes
        self.label = " with ".join(
            effect.labels.get(course.name, effect.label)
            for effect, course in zip(hypothesis.sized.effects, hypothesis.courses, strict=True)
        )
        self._hypothesis, self._fit, self._pattern_min = hypothesis, fit, pattern_min
        self._simulator = Simulator(hypothesis.sized.whole.model)
        period_min = float(np.median(np.diff(run.time_min)))
        time_min: Array = float(run.time_min[-1]) + period_min * np.arange(rest_rows + 1, dtype=np.float64)
        self.begin_min = float(time_min[-1])
        self.freedom = self._going_on(time_min)[0].freedom
        known = np.flatnonzero(np.all(np.isfinite(fit.found.x), axis=1))
        start = fit.found.x[known[-1], : hypothesis.sized.own_states]
        rested = self._run(time_min, np.tile(resting, (time_min.size, 1)), start)
        self._start = None if rested is None else rested.states[-1]

    @property
    def name(self) -> str:
        """Its causes, in one word."""
        return "+".join(self.causes)

    def outputs(self, time_min: Array, inputs: Array) -> Array | None:
        """What is measured but for noise, from rest, shape (rows, n_y); None if the equations run away.

        Args:
            time_min: of the rows, after the record's end, shape (rows,).
            inputs: shape (rows, n_u).
        """
        found = None if self._start is None else self._run(time_min, inputs, self._start)
        return None if found is None else found.outputs

    def unexplained(self, truth: Run) -> float:
        """The lambda of the module: what it cannot imitate of a run."""
        hypothesis, theta = self._going_on(truth.time_min)
        return hypothesis.unexplained(truth, hypothesis.at(truth, theta))

    def own_loss(self, run: Run) -> float:
        """Minus the log likelihood of what it predicts itself."""
        hypothesis, theta = self._going_on(run.time_min)
        return hypothesis.at(run, theta).loss

    def loss(self, run: Run) -> float:
        """Minus the log likelihood of what another predicts, at its best."""
        hypothesis, theta = self._going_on(run.time_min)
        return fitted(run, hypothesis, theta, REFINED_STEPS).loss

    def _going_on(self, time_min: Array) -> tuple[Hypothesis, list[Array]]:
        courses, numbers = [], []
        for course, theta in zip(self._hypothesis.courses, self._fit.theta, strict=True):
            later, then = going_on(course, theta, time_min, self._pattern_min)
            courses.append(later)
            numbers.append(then)
        return Hypothesis(self._hypothesis.sized, courses), numbers

    def _run(self, time_min: Array, inputs: Array, start: Array) -> Trajectory | None:
        hypothesis, theta = self._going_on(time_min)
        signals = [course.signal(numbers) for course, numbers in zip(hypothesis.courses, theta, strict=True)]
        try:
            return self._simulator.run(time_min, hypothesis.sized.whole.inputs(time_min, inputs, signals), start)
        except SimulationError:
            return None


def going_on(course: Course, theta: Array, time_min: Array, pattern_min: float) -> tuple[Course, Array]:
    """A deviation after the record: its course and numbers.

    Args:
        course: in the record.
        theta: its numbers there.
        time_min: of the rows to come, shape (rows,).
        pattern_min: see `Rival`.
    """
    if isinstance(course, Sine) and theta[2] <= LARGEST_SHARE * pattern_min:
        angle = 2.0 * np.pi / theta[2] * (float(time_min[0]) - course.begin_min)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return Sine(time_min), np.append(turn @ theta[:2], theta[2])
    return Constant(time_min), course.signal(theta).at_row[-1:]


def probability(expected: float, evidence: float) -> float:
    """The probability that a difference in BIC with this expectation is larger than `LISTED`.

    Args:
        expected: the difference in BIC.
        evidence: the noncentrality in it.

    >>> round(probability(30.0, 30.0), 3)
    0.966
    """
    return float(special.ndtr((expected - LISTED) / max(2.0 * sqrt(evidence), 1e-9)))
