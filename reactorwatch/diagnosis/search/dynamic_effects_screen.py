"""Screen for effects with internal states: lags, valve stiction, delays.

They have no infinitesimal deviation, so each is evaluated at a few typical magnitudes. Its signature is the reduction
of the innovations by a magnitude. The internal dynamics are fast beside the profiles, so the signature of a profile is
taken for the signature times the profile.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.fault_filter import FilterEvaluation, huber_clip
from reactorwatch.diagnosis.fitting.hypothesis import Fit
from reactorwatch.diagnosis.fitting.profiles import Constant, Decay, FittedProfile, PiecewiseLinear, Ramp, Signal, Step
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.screen import DECAYS, EDGE_ROWS, KNOTS, Candidate
from reactorwatch.process.effect import Effect

Evaluate: TypeAlias = Callable[[Effect, Sequence[Signal]], Sequence[FilterEvaluation]]
"""Function from deviations of an effect to the filter results with them."""


class DynamicEffectsScreen:
    """Screens one run for effects with internal states.

    Args:
        effects: effects with internal states.
        run: the record.
    """

    def __init__(self, effects: Sequence[Effect], run: Run) -> None:
        self._effects, self._run = tuple(effects), run
        t = run.time_min
        self._constant, self._step, self._ramp, self._decay = Constant(t), Step(t), Ramp(t), Decay(t)
        self._free = PiecewiseLinear(t, KNOTS)

    def candidates(
        self, baseline: Fit, evaluate: Evaluate, of: Sequence[Effect] | None = None, least_score: float = 0.0
    ) -> list[Candidate]:
        """Best magnitude of each effect as a constant and, scaled from there, a step, a ramp, decays and a curve.

        Args:
            baseline: fit without any of these effects.
            evaluate: runs the filter of the same hypothesis plus deviations of one effect.
            of: effects to screen; None: all.
            least_score: predicted gains below this, in BIC, are not confirmed by a filter run.
        """
        result = []
        for effect in self._effects if of is None else of:
            starts = effect.start_values or (effect.typical,)
            results = evaluate(effect, [self._constant.signal(np.array([start])) for start in starts])
            gains = [2.0 * (baseline.loss - item.loss) for item in results]
            best = int(np.argmax(gains))
            if gains[best] > 0.0:
                result.append(Candidate(effect, self._constant, np.array([starts[best]]), gains[best]))
            w = huber_clip(baseline.w)
            reductions = [(w - huber_clip(item.w)) / start for start, item in zip(starts, results, strict=True)]
            scaled = [self.scale_signature(effect, w, g) for g in reductions]
            confirmations = self._confirmations(baseline, evaluate, scaled, least_score)
            for candidates, confirmed in zip(scaled, confirmations, strict=True):
                # A discontinuous effect does not scale: a fit has to scan its size, and can scan only one.
                result += [
                    replace(item, gain=confirmed * item.gain)
                    for item in candidates
                    if confirmed > 0.0 and (not effect.is_discontinuous or item.profile.name in ("constant", "step"))
                ]
        return result

    def _confirmations(
        self, baseline: Fit, evaluate: Evaluate, scaled: Sequence[Sequence[Candidate]], least_score: float
    ) -> list[float]:
        """Fraction of the predicted gain that a filter run at that constant magnitude confirms, at most 1.

        Small predictions and discontinuous effects are taken without a run.
        """
        confirmed, to_confirm = [1.0] * len(scaled), []
        for number, candidates in enumerate(scaled):
            constant = candidates[0]
            if (
                constant.effect.is_discontinuous
                or max(item.score(self._run.values) for item in candidates) <= least_score
            ):
                continue
            if constant.gain > 0.0:
                to_confirm.append(number)
            elif constant.gain < 0.0:
                confirmed[number] = 0.0
        if to_confirm:
            signals = [self._constant.signal(scaled[number][0].parameters) for number in to_confirm]
            for number, item in zip(to_confirm, evaluate(scaled[0][0].effect, signals), strict=True):
                confirmed[number] = min(2.0 * (baseline.loss - item.loss) / scaled[number][0].gain, 1.0)
        return confirmed

    def scale_signature(self, effect: Effect, w: Array, g: Array) -> list[Candidate]:
        """Candidates from the signature of a unit magnitude in every row.

        Args:
            effect: the effect.
            w: normalised innovations to explain, shape (rows, n_y).
            g: the signature, shape (rows, n_y).
        """
        a, b = np.sum(w * g, axis=1), np.sum(g * g, axis=1)
        t = self._run.time_min
        candidates = [_candidate(effect, self._constant, a.sum(), b.sum(), ())]
        later_a, later_b = _sums_to_end(a), _sums_to_end(b)
        moments = [_sums_to_end(item * t**power) for item in (a, b) for power in (0, 1, 2)]
        span = np.maximum(t[-1] - t, self._ramp.period_min)
        grown_a = (moments[1] - t * moments[0]) / span
        grown_b = np.maximum(moments[5] - 2 * t * moments[4] + t**2 * moments[3], 0.0) / span**2
        onsets: list[tuple[FittedProfile, Array, Array, tuple[float, ...]]]
        onsets = [(self._step, later_a, later_b, ()), (self._ramp, grown_a, grown_b, ())]
        for share in DECAYS:
            constant = share * self._run.span_min
            remaining = np.exp((t[-1] - t) / constant)  # backwards from the end
            short_a, short_b, shorter_b = (
                _sums_to_end(item * w) / w for item, w in ((a, remaining), (b, remaining), (b, remaining**2))
            )
            grown_b = np.maximum(later_b - 2.0 * short_b + shorter_b, 0.0)
            onsets.append((self._decay, later_a - short_a, grown_b, (constant,)))
        for profile, of_a, of_b, shape in onsets:
            index = _best(of_a, of_b, effect)
            candidates.append(_candidate(effect, profile, of_a[index], of_b[index], (t[index], *shape)))
        hats = self._free.basis_functions(np.empty(0))[0]
        A, B = hats.T @ a, hats.T @ (hats * b[:, None])
        by = np.clip(np.asarray(np.linalg.lstsq(B, A, rcond=1e-9)[0]), effect.lower, effect.upper)
        candidates.append(Candidate(effect, self._free, by, float(by @ (2.0 * A - B @ by))))
        return candidates


def _sums_to_end(values: Array) -> Array:
    """Sums from each row to the last."""
    return np.asarray(np.cumsum(values[::-1])[::-1])


def _candidate(effect: Effect, profile: FittedProfile, a: float, b: float, shape: tuple[float, ...]) -> Candidate:
    """Candidate at the nearest possible magnitude, with the gain there, because a filter run is compared with it."""
    size = float(np.clip(a / max(b, 1e-300), effect.lower, effect.upper))
    return Candidate(effect, profile, np.array([size, *shape]), size * (2.0 * float(a) - size * float(b)))


def _best(a: Array, b: Array, effect: Effect) -> int:
    size = np.clip(a / np.maximum(b, 1e-300), effect.lower, effect.upper)
    gain = size * (2.0 * a - size * b)
    return EDGE_ROWS + int(np.argmax(gain[EDGE_ROWS:-EDGE_ROWS]))
