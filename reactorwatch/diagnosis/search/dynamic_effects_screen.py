"""Leads among the effects that bring memory of their own: lags, a valve that sticks, a delay.

They have no infinitesimal deviation, so each is tried at a few sizes of the usual magnitude. What the innovations lose
by a size is its signature; since such memory is short beside the courses, that signature times a course is taken for
that of the course.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.fault_filter import Followed, clipped
from reactorwatch.diagnosis.fitting.hypothesis import Fit
from reactorwatch.diagnosis.fitting.profiles import Constant, Course, Decay, Free, Ramp, Signal, Step
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.screen import DECAYS, EDGE_ROWS, KNOTS, Lead
from reactorwatch.process.effect import Effect

Follow: TypeAlias = Callable[[Effect, Sequence[Signal]], Sequence[Followed]]
"""From some deviations of an effect to what filters that know of them make of the run."""


class MemoryScreen:
    """Tries the effects with memory on one run.

    Args:
        effects: those that bring states of their own.
        run: the record.
    """

    def __init__(self, effects: Sequence[Effect], run: Run) -> None:
        self._effects, self._run = tuple(effects), run
        t = run.time_min
        self._constant, self._step, self._ramp, self._decay = Constant(t), Step(t), Ramp(t), Decay(t)
        self._free = Free(t, KNOTS)

    def leads(
        self, without: Fit, follow: Follow, of: Sequence[Effect] | None = None, least_score: float = 0.0
    ) -> list[Lead]:
        """The best size of each effect as a constant, and from there a step, a ramp, decays and a free curve.

        Args:
            without: a fit without any of the effects.
            follow: what filters make of the run that know of the same, and of a deviation of one effect.
            of: these effects alone; None: all.
            least_score: promises of less, in BIC, are not held against a run of the filter.
        """
        found = []
        for effect in self._effects if of is None else of:
            starts = effect.start_values or (effect.typical,)
            followed = follow(effect, [self._constant.signal(np.array([start])) for start in starts])
            tried = [
                (2.0 * (without.loss - item.loss), start, item.w) for start, item in zip(starts, followed, strict=True)
            ]
            gain, start, _ = max(tried, key=lambda item: item[0])
            if gain > 0.0:
                found.append(Lead(effect, self._constant, np.array([start]), gain))
            before = clipped(without.w)
            scaled = [self.scaled(effect, before, (before - clipped(w)) / start) for _, start, w in tried]
            for leads, kept in zip(scaled, self._kept(without, follow, scaled, least_score), strict=True):
                # What acts in jumps does not scale: a fit has to scan its size, and can do so for one alone.
                found += [
                    replace(item, gain=kept * item.gain)
                    for item in leads
                    if kept > 0.0 and (not effect.is_discontinuous or item.course.name in ("constant", "step"))
                ]
        return found

    def _kept(self, without: Fit, follow: Follow, scaled: Sequence[Sequence[Lead]], least_score: float) -> list[float]:
        """How much of the gain that each scaling promises a run with that constant size keeps, at most all of it.

        A scaling that promises little, or is of an effect that acts in jumps, is believed without a run.
        """
        kept, asked = [1.0] * len(scaled), []
        for number, leads in enumerate(scaled):
            constant = leads[0]
            if constant.effect.is_discontinuous or max(item.score(self._run.values) for item in leads) <= least_score:
                continue
            if constant.gain > 0.0:
                asked.append(number)
            elif constant.gain < 0.0:
                kept[number] = 0.0
        if asked:
            signals = [self._constant.signal(scaled[number][0].theta) for number in asked]
            for number, item in zip(asked, follow(scaled[0][0].effect, signals), strict=True):
                kept[number] = min(2.0 * (without.loss - item.loss) / scaled[number][0].gain, 1.0)
        return kept

    def scaled(self, effect: Effect, w: Array, g: Array) -> list[Lead]:
        """From the signature of a size of 1 in every row.

        Args:
            effect: whose.
            w: what there is to explain, shape (rows, n_y).
            g: the signature, likewise.
        """
        a, b = np.sum(w * g, axis=1), np.sum(g * g, axis=1)
        t = self._run.time_min
        leads = [_lead(effect, self._constant, a.sum(), b.sum(), ())]
        later_a, later_b = _later(a), _later(b)
        place = _best(later_a, later_b, effect)
        leads.append(_lead(effect, self._step, later_a[place], later_b[place], (t[place],)))
        moments = [_later(item * t**power) for item in (a, b) for power in (0, 1, 2)]
        span = np.maximum(t[-1] - t, self._ramp.period_min)
        grown_a = (moments[1] - t * moments[0]) / span
        grown_b = np.maximum(moments[5] - 2 * t * moments[4] + t**2 * moments[3], 0.0) / span**2
        place = _best(grown_a, grown_b, effect)
        leads.append(_lead(effect, self._ramp, grown_a[place], grown_b[place], (t[place],)))
        for share in DECAYS:
            constant = share * self._run.span_min
            left = np.exp((t[-1] - t) / constant)  # of the way, seen from the end
            short_a, short_b, shorter_b = (_later(item * w) / w for item, w in ((a, left), (b, left), (b, left**2)))
            grown_a, grown_b = later_a - short_a, np.maximum(later_b - 2.0 * short_b + shorter_b, 0.0)
            place = _best(grown_a, grown_b, effect)
            leads.append(_lead(effect, self._decay, grown_a[place], grown_b[place], (t[place], constant)))
        hats = self._free.functions(np.empty(0))[0]
        A, B = hats.T @ a, hats.T @ (hats * b[:, None])
        by = np.clip(np.asarray(np.linalg.lstsq(B, A, rcond=1e-9)[0]), effect.lower, effect.upper)
        leads.append(Lead(effect, self._free, by, float(by @ (2.0 * A - B @ by))))
        return leads


def _later(values: Array) -> Array:
    """Sums from each row to the last."""
    return np.asarray(np.cumsum(values[::-1])[::-1])


def _lead(effect: Effect, course: Course, a: float, b: float, shape: tuple[float, ...]) -> Lead:
    """At the nearest possible size, with the gain of just that: a run with it is held against this gain."""
    size = float(np.clip(a / max(b, 1e-300), effect.lower, effect.upper))
    return Lead(effect, course, np.array([size, *shape]), size * (2.0 * float(a) - size * float(b)))


def _best(a: Array, b: Array, effect: Effect) -> int:
    size = np.clip(a / np.maximum(b, 1e-300), effect.lower, effect.upper)
    gain = size * (2.0 * a - size * b)
    return EDGE_ROWS + int(np.argmax(gain[EDGE_ROWS:-EDGE_ROWS]))
