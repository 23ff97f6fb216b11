"""Identifiability of causes, before any deviation is there.

A cause is a constant deviation from the first row on. Its signature is what a unit size of it does to the innovations
of the nominal filter, so with noise levels and excitation given, the noncentrality of a size is known (`signatures`).
An effect with internal states is evaluated at sizes, as it is not linear.

- The smallest size is the one at which the BIC refutes the nominal model with a probability of `POWER`.
- Two causes are alike if at `TIMES` their smallest size the best imitation of one by the other costs less than `LISTED`
  in BIC, with that probability. In a group each two are alike.
- A cause is invisible if no size within its bounds is seen.
- The noise of a sensor counts as noise that sets in in the middle of the record, and is like no other cause.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log, sqrt

import numpy as np
from scipy.special import ndtri

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.fault_filter import huber_clip
from reactorwatch.diagnosis.fitting.hypothesis import Fit, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant
from reactorwatch.diagnosis.result import LISTED
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.noise import LEAST_GAIN
from reactorwatch.diagnosis.search.search import Search, smallest_noise
from reactorwatch.process.effect import Effect, SensorEffect
from reactorwatch.process.model import ProcessModel

POWER, TIMES = 0.9, 3.0

REFUTED = 10.0
"""Threshold in BIC of a finding."""

FOLLOWED = 2.0
"""Ratio of the evidence to what a diagnosis has of it, measured on a linear tank: the nominal hypothesis has noise
levels of its own, with which its filter follows part of a deviation."""

SIZES, SMALLEST, LARGEST = 10, 1e-2, 30.0
"""Sizes at which an effect with internal states is evaluated; the first and the last, in its typical sizes."""

NOISE_SIZES = 200
"""Sizes at which further noise is evaluated, from `SMALLEST` to `LARGEST` of the usual noise."""


@dataclass(frozen=True, eq=False)
class Visibility:
    """One cause, as these sensors and this excitation show it.

    Attributes:
        effect: the cause.
        smallest: smallest size that is seen; NaN: it is invisible.
        signature: change of the innovations by `TIMES` that size, shape (values,).
    """

    effect: Effect
    smallest: float
    signature: Array

    @property
    def is_visible(self) -> bool:
        """True if a size within its bounds is seen."""
        return bool(np.isfinite(self.smallest))


@dataclass(frozen=True, eq=False)
class Identifiability:
    """Causes of a process, as some sensors and an excitation distinguish them.

    Attributes:
        causes: every possible cause, in the order of the catalogue.
        alike: groups of causes that look the same, by name.
    """

    causes: tuple[Visibility, ...]
    alike: tuple[tuple[str, ...], ...]


def identifiability(model: ProcessModel, effects: Sequence[Effect], run: Run) -> Identifiability:
    """Find which causes a run could show and tell apart.

    Args:
        model: process model of the plant.
        effects: possible causes.
        run: the excitation; its noise levels are those under which the nominal model is most likely.
    """
    search = Search(model, effects, run, smallest_noise(model, run.measured))
    nominal = search.fit_nominal()
    wanted = FOLLOWED * _least_noncentrality(REFUTED + log(search.run.values))
    causes = [
        *_static(search, nominal.hypothesis, nominal.fit, wanted),
        *(_dynamic(search, nominal.fit, effect, wanted) for effect in search.screen.dynamic_effects),
        *(_noise(search, effect) for effect in search.noise_effects),
    ]
    order = {effect.name: index for index, effect in enumerate(effects)}
    causes.sort(key=lambda item: order[item.effect.name])
    # Noise is seen in squares of the innovations, all others in the innovations themselves.
    return Identifiability(
        tuple(causes), _groups([item for item in causes if item.is_visible and not item.effect.is_noise])
    )


def _least_noncentrality(threshold: float) -> float:
    """Noncentrality whose gain, with a spread of twice its root, exceeds a threshold with the probability `POWER`."""
    z = float(ndtri(POWER))
    return (z + sqrt(z * z + threshold)) ** 2


def _static(search: Search, hypothesis: Hypothesis, fit: Fit, wanted: float) -> list[Visibility]:
    """Effects without internal states, to first order."""
    dynamics = search.screen.dynamics_of_all(hypothesis, fit, ())
    effects, result = search.screen.static_effects, []
    for effect, g in zip(effects, signatures.constant_signatures(dynamics, len(effects)).T.copy(), strict=True):
        size = sqrt(wanted / max(float(g @ g), 1e-300))
        signs = [sign for sign in (1.0, -1.0) if effect.lower <= sign * size <= effect.upper and np.all(np.isfinite(g))]
        smallest = size if signs else float("nan")
        result.append(Visibility(effect, smallest, TIMES * size * (signs or [1.0])[0] * g))
    return result


def _noise(search: Search, effect: Effect) -> Visibility:
    """Noise of a sensor that sets in in the middle of the run: the likelihood ratio of two variances against one."""
    assert isinstance(effect, SensorEffect)
    index = search.screen.model.output_names.index(effect.output)
    sd = float(search.noise.sensor_sd(search.screen.model.output_names)[index])
    half = 0.5 * np.count_nonzero(np.isfinite(search.run.measured[:, index]))
    sizes = sd * np.geomspace(SMALLEST, LARGEST, NOISE_SIZES)
    ratio = 1.0 + np.square(sizes / sd)
    gains = 2.0 * half * np.log(0.5 * (1.0 + ratio)) - half * np.log(ratio)
    wanted = _least_noncentrality(LEAST_GAIN + 2.0 * log(search.run.values))
    seen = np.flatnonzero((gains >= wanted) & (sizes <= effect.upper))
    smallest = float(sizes[seen[0]]) if seen.size else float("nan")
    return Visibility(effect, smallest, np.zeros(0))


def _dynamic(search: Search, nominal: Fit, effect: Effect, wanted: float) -> Visibility:
    """An effect with internal states, evaluated at sizes; between them the noncentrality is a power of the size."""
    sizes = np.geomspace(SMALLEST, LARGEST, SIZES) * abs(effect.typical)
    sizes = np.unique(np.minimum(sizes, effect.upper))
    constant, before = Constant(search.run.time_min), huber_clip(nominal.w)

    def changes(values: Array) -> list[Array]:
        signals = [[constant.signal(np.array([value]))] for value in values]
        results = search.filter((effect,)).evaluate_all(search.run, signals)
        return [(before - huber_clip(item.w))[2:].ravel() for item in results]

    gains = np.array([float(item @ item) for item in changes(sizes)])
    seen = np.flatnonzero(gains >= wanted)
    if not seen.size:
        return Visibility(effect, float("nan"), np.zeros(before[2:].size))
    first = int(seen[0])
    smallest = float(sizes[first])
    if first and gains[first - 1] > 0.0:
        smallest = float(
            np.exp(np.interp(log(wanted), np.log(gains[first - 1 : first + 1]), np.log(sizes[first - 1 : first + 1])))
        )
    return Visibility(effect, smallest, changes(np.array([min(TIMES * smallest, effect.upper)]))[0])


def _groups(causes: Sequence[Visibility]) -> tuple[tuple[str, ...], ...]:
    """Groups of causes of which each two are alike, the most alike joined first."""
    if len(causes) < 2:
        return ()
    left = np.array([[_unlike(one, other) for other in causes] for one in causes])
    left = np.minimum(left, left.T)
    groups = [[index] for index in range(len(causes))]
    least = _least_noncentrality(LISTED)
    pairs = sorted((left[i, j], i, j) for i in range(len(causes)) for j in range(i) if left[i, j] < least)
    for _, i, j in pairs:
        one, other = (next(group for group in groups if index in group) for index in (i, j))
        if one is not other and all(left[a, b] < least for a in one for b in other):
            groups.remove(other)
            one += other
    names = (tuple(causes[index].effect.name for index in sorted(group)) for group in groups if len(group) > 1)
    return tuple(sorted(names))


def _unlike(truth: Visibility, other: Visibility) -> float:
    """Noncentrality that remains of a cause at `TIMES` its smallest size where another one imitates it best."""
    g, h = truth.signature, other.signature
    square = float(h @ h)
    scale = float(g @ h) / square if square > 0.0 else 0.0
    # The signature is that of this size; a one-sided effect cannot do the opposite.
    size = TIMES * other.smallest
    lowest, highest = other.effect.lower / size, other.effect.upper / size
    scale = float(np.clip(scale, min(lowest, 0.0), max(highest, 0.0)))
    return float(np.sum((g - scale * h) ** 2))
