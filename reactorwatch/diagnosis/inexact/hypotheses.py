"""Hypotheses: a cause with its course in time, or none, beside nuisance; and how the courses depend on time.

The cause is an effect with a size that sets in as a step or a ramp, or follows any curve, or a nuisance that is larger
than its prior allows: that is a constant deviation, a delay or a lag.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.profiles import FittedProfile, PiecewiseLinear, Ramp, Signal, Step
from reactorwatch.diagnosis.inexact.nuisance import Prior

ONSETS, KNOTS = 24, 25
"""Onsets at which a step or a ramp is tried, and knots of a curve, over the record."""

_ROWS = np.array([0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 18.0, 25.0])
NEAR_ROWS = np.concatenate([-_ROWS[::-1], [0.0], _ROWS])
"""Onsets in rows about the expected one: a step a row late costs more than the right cause gains over others, and the
derivative by the onset of a sensor's step sees no further than a row."""

WIDTH = 10.0
"""Standard deviation of a size's prior, in typical sizes."""

CURVE_COST = 10.0
"""Cost of a curve in log likelihood: what follows any curve is less likely from the start."""

NONE, STEP, RAMP, CURVE, CONSTANT = "none", "step", "ramp", "free", "constant"


class Hypothesis(NamedTuple):
    """A cause with its course in time.

    Attributes:
        kind: `none`, or the profile: `step`, `ramp`, `free` or `constant`.
        effect: index of the effect; of a constant deviation, that of the nuisance; -1: none.
        prior: priors of the nuisance.
        onset: where a step or a ramp is expected to set in, in minutes.
        size: expected size.
        log_evidence: logarithm of the evidence by the linearised model.
    """

    kind: str
    effect: int
    prior: Prior
    onset: float = 0.0
    size: float = 0.0
    log_evidence: float = 0.0

    @property
    def cause(self) -> tuple[str, int]:
        """Profile and index, by which hypotheses of one cause are found."""
        return self.kind, self.effect


@dataclass(frozen=True, eq=False)
class Courses:
    """Courses in time over the rows of a run, of which all profiles are made.

    Attributes:
        time_min: times of the rows, shape (rows,).
        period_min: sampling period.
        expected_min: an onset near which onsets are tried row by row; None: there is none.
    """

    time_min: Array
    period_min: float
    expected_min: float | None = None

    @cached_property
    def _profiles(self) -> dict[str, FittedProfile]:
        return {STEP: Step(self.time_min), RAMP: Ramp(self.time_min)}

    @property
    def span_min(self) -> float:
        """Duration from the first row to the last."""
        return float(self.time_min[-1] - self.time_min[0])

    @property
    def onsets(self) -> Array:
        """Onsets that are tried, shape (n,)."""
        result = self.time_min[0] + np.arange(ONSETS) / ONSETS * self.span_min
        if self.expected_min is not None:
            near = self.expected_min + self.period_min * NEAR_ROWS
            result = np.append(result, np.clip(near, self.time_min[0], self.time_min[-1]))
        return np.asarray(result)

    @property
    def knots(self) -> Array:
        """Times of a curve's knots, shape (KNOTS,)."""
        return np.linspace(self.time_min[0], self.time_min[-1], KNOTS)

    def course(self, kind: str, onset: float) -> Signal:
        """Course of a step, of size 1, or a ramp that reaches 1 at the end of the run."""
        return self._profiles[kind].signal(np.array([1.0, onset]))

    def by_onset(self, kind: str, onset: float) -> Signal:
        """Derivative of a course by its onset; a sensor's step jumps, so its derivative is that over a row."""
        half = 0.5 * self.period_min
        ahead, behind = self.course(kind, onset + half), self.course(kind, onset - half)
        mean, value = ahead.interval_mean - behind.interval_mean, ahead.sample_value - behind.sample_value
        return Signal(mean / self.period_min, value / self.period_min)

    def hats(self) -> Signal:
        """Functions that are 1 at a knot and 0 at the others, shape (rows, KNOTS)."""
        return PiecewiseLinear(self.time_min, KNOTS).basis_signals(np.empty(0))

    def steps(self) -> Signal:
        """Steps at all onsets, shape (rows, onsets)."""
        each = [self.course(STEP, onset) for onset in self.onsets.tolist()]
        mean, value = [item.interval_mean for item in each], [item.sample_value for item in each]
        return Signal(np.column_stack(mean), np.column_stack(value))

    def ramp_weights(self) -> Array:
        """Weights of the hats whose sum is a ramp from each onset, shape (KNOTS, onsets)."""
        spans = np.maximum(self.time_min[-1] - self.onsets, self.period_min)
        return np.asarray(np.maximum(self.knots[:, None] - self.onsets, 0.0) / spans)


def random_walk(typical: float) -> Array:
    """Factor of a curve's prior covariance: the first knot and each increment to the next, shape (KNOTS, KNOTS)."""
    return np.asarray(typical * np.tril(np.ones((KNOTS, KNOTS))) * np.append(1.0, np.full(KNOTS - 1, 0.5)))
