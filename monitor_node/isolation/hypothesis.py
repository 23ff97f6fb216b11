"""One hypothesis: a cause that set in as a step or as a ramp, and how well it goes with some rows.

Its loss is that of its own filter (see `segment`). It is lowered by Gauss and Newton's steps in size and
onset, damped as Levenberg and Marquardt do, with derivatives that are differences of filter runs.

A sensor's step is seen at a row, no matter when between two rows it came. So that the search does not stop on such a
plateau, the onset is moved by whole rows as long as that helps, and in the end taken from the middle of it.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import inf, sqrt

import numpy as np

from monitor_node.isolation.segment import HUBER, Loss, Stretch
from reactorwatch.arrays import Array
from reactorwatch.kalman.ekf import Filter, NoiseLevels
from reactorwatch.kalman.ekf_step import MODEL_CACHE_SIZE
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import RAMP, STEP, Profile

SETTLED = 0.05
"""In log likelihood."""

_TRIES, _JUMPS, _DAMPING, _MORE_DAMPING = 3, 4, 1e-3, 30.0


class Hypothesis:
    """A cause with a profile.

    Args:
        model: of the plant.
        noise: of the plant and its sensors.
        effect: the cause.
        profile: step or ramp; the size of a ramp is its slope here, in a minute.
    """

    def __init__(self, model: ProcessModel, noise: NoiseLevels, effect: Effect, profile: Profile) -> None:
        self.effect, self.profile = effect, profile
        self._noise, self._extended = noise, _extended(model, effect)
        self._names = self._extended.parameter_names[len(model.parameters) :]

    @cached_property
    def _filter(self) -> Filter:
        """Made when it is needed: it takes some milliseconds, and many causes never come into question."""
        return Filter(self._extended, self._noise)

    def prepare(self) -> None:
        """Make now what the first call of `loss` would make."""
        self._filter.prepare()

    def limited(self, size: float, onset_min: float, end_min: float) -> float:
        """The physically possible size that is nearest to it; a ramp's is so until the end."""
        span = end_min - onset_min if self.profile is RAMP else 1.0
        return min(max(size, self.effect.lower / span), self.effect.upper / span)

    def loss(self, stretch: Stretch, size: float, onset_min: float) -> Loss:
        """That over the rows of a stretch."""
        end_min = onset_min
        if self.profile is RAMP:
            end_min = stretch.end_min
            size = min(max(size * (end_min - onset_min), self.effect.lower), self.effect.upper)
        self._filter.set_parameters(dict(zip(self._names, (size, onset_min, end_min), strict=True)))
        self._filter.budget = stretch.budget
        return stretch.loss(self._filter, onset_min)


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def _extended(model: ProcessModel, effect: Effect) -> ProcessModel:
    """The model with a ramp of the effect in it, and with a step: that is the ramp which ends where it begins."""
    return effect.extend(model, RAMP)


@dataclass(frozen=True, eq=False)
class Point:
    """A size and an onset, and what they make of the rows.

    Attributes:
        size: see `Hypothesis`.
        onset_min: when it sets in.
        loss: see `segment`.
        w: the whitened innovations, shape (rows, n_y); 0 where nothing was measured.
    """

    size: float
    onset_min: float
    loss: float
    w: Array


@dataclass(frozen=True, eq=False)
class Slope:
    """How w changes with size and onset, near a point.

    Attributes:
        of_w: shape (2, values), size first, then onset.
        information: of the two, shape (2, 2).
    """

    of_w: Array
    information: Array

    @property
    def covariance(self) -> Array:
        """Of size and onset, shape (2, 2)."""
        return np.asarray(np.linalg.inv(self.information))

    @property
    def size_sd(self) -> float:
        """Of the size, whatever the onset."""
        return sqrt(float(self.covariance[0, 0]))

    @property
    def onset_sd_min(self) -> float:
        """Of the onset, whatever the size."""
        return sqrt(float(self.covariance[1, 1]))


class Descent:
    """The search for the size and the onset of one hypothesis.

    Args:
        hypothesis: hypothesis of the descent.
        stretch: the rows.
    """

    def __init__(self, hypothesis: Hypothesis, stretch: Stretch) -> None:
        self._hypothesis, self._stretch, self._times = hypothesis, stretch, stretch.times
        self._end_min = stretch.end_min
        self._latest_min = float(self._times[-1 if hypothesis.profile is STEP else -2])

    def at(self, size: float, onset_min: float) -> Point:
        """The point, or the nearest one that is possible."""
        onset_min = min(max(onset_min, self._stretch.earliest_min), self._latest_min)
        size = self._hypothesis.limited(size, onset_min, self._end_min)
        return Point(size, onset_min, *self._hypothesis.loss(self._stretch, size, onset_min))

    def reached(self, point: Point, slope: Slope) -> tuple[float, float]:
        """The size in the last row and its standard deviation."""
        if self._hypothesis.profile is STEP:
            return point.size, slope.size_sd
        span = self._end_min - point.onset_min
        by = np.array([span, -point.size])
        return point.size * span, sqrt(float(by @ slope.covariance @ by))

    def slope(self, point: Point, size_sd: float) -> Slope:
        """By differences: of a tenth of a standard deviation of the size, and of a quarter of a row."""
        of_size, of_onset = 0.1 * size_sd, 0.25 * self._spacing(point.onset_min)
        if point.size + of_size > self._hypothesis.limited(inf, point.onset_min, self._end_min):
            of_size = -of_size
        if point.onset_min + of_onset > self._latest_min:
            of_onset = -of_onset
        near = self.at(point.size + of_size, point.onset_min), self.at(point.size, point.onset_min + of_onset)
        w = point.w.ravel()
        of_w = np.array([(near[0].w.ravel() - w) / of_size, (near[1].w.ravel() - w) / of_onset])
        least = np.diag([(1e-3 / size_sd) ** 2, (self._end_min - float(self._times[0])) ** -2])
        return Slope(of_w, (of_w * _weights(w)) @ of_w.T + least)

    def stepped(self, point: Point, slope: Slope) -> Point:
        """After a damped step; the point itself if none helps."""
        w, damping = point.w.ravel(), _DAMPING
        gradient = slope.of_w @ (_weights(w) * w)
        longest = max(0.5 * (self._end_min - point.onset_min), 3.0 * self._spacing(point.onset_min))
        for _ in range(_TRIES):
            change = -np.linalg.solve(slope.information * (1.0 + damping * np.eye(2)), gradient)
            change *= min(1.0, longest / max(abs(float(change[1])), longest))
            found = self.at(point.size + float(change[0]), point.onset_min + float(change[1]))
            if found.loss < point.loss:
                return found
            damping *= _MORE_DAMPING
        # On the edge of a plateau the derivative by the onset is worth nothing.
        found = self.at(point.size - float(gradient[0] / slope.information[0, 0]), point.onset_min)
        return found if found.loss < point.loss else point

    def jumped(self, point: Point, slope: Slope) -> tuple[Point, float]:
        """With the onset some rows away if that is better, and how the loss rises on average a row away from it."""
        spacing = self._spacing(point.onset_min)
        with_onset = -float(slope.information[0, 1] / slope.information[0, 0])  # d size / d onset along the valley
        rise = 0.0
        for _ in range(_JUMPS):
            sides = [self.at(point.size + with_onset * way, point.onset_min + way) for way in (-spacing, spacing)]
            best = min(sides, key=lambda item: item.loss)
            if not best.loss < point.loss:
                rise = 0.5 * (sides[0].loss + sides[1].loss) - point.loss
                break
            point = best
        return point, rise

    def onset(self, point: Point, rise: float, slope: Slope) -> tuple[Point, float]:
        """The point, in the middle of a plateau if it is on one, and the standard deviation of its onset."""
        spacing = self._spacing(point.onset_min)
        of_rows = max(spacing / sqrt(2.0 * rise) if rise > 0.0 else slope.onset_sd_min, spacing / sqrt(12.0))
        row = min(int(np.searchsorted(self._times, point.onset_min)), self._times.size - 1)
        within = [self.at(point.size, float(self._times[row]) - share * spacing) for share in (0.1, 0.5, 0.9)]
        if max(abs(item.loss - point.loss) for item in within) < SETTLED:
            return within[1], of_rows
        return point, min(slope.onset_sd_min, of_rows)

    def _spacing(self, onset_min: float) -> float:
        """Between the rows about an onset."""
        place = int(np.clip(np.searchsorted(self._times, onset_min), 1, self._times.size - 1))
        return float(self._times[place] - self._times[place - 1])


def _weights(w: Array) -> Array:
    """Of Huber's loss: that of least squares times these has the same gradient."""
    return np.asarray(HUBER / np.maximum(np.abs(w), HUBER))
