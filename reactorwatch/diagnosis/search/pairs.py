"""Search for two simultaneous causes.

Two deviations together can look like a third one, so that the best single cause is neither of them. So all pairs are
screened together (`PairScreen`) about the run of the best single cause, and the best are fitted roughly, with curves
of any shape. In the best of these each cause then gets its simplest adequate profile, and all pairs are screened again
about its run, where the linearisation holds.

A curve can take what belongs to the other cause. So if a curve remains, a pair is also grown without curves, from the
best single cause with a simple profile, and the better of the two is kept. Finally each of the two causes is exchanged
for whatever explains the remainder better, until nothing does. A pair is a strong claim: it needs a gain of
`LEAST_PAIR_GAIN`.
"""

from collections.abc import Sequence
from functools import partial
from math import inf
from typing import TypeAlias

import numpy as np

from reactorwatch.diagnosis.fitting.fault_filter import FilterEvaluation, huber_clip
from reactorwatch.diagnosis.fitting.hypothesis import MOST_STEPS, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant, PiecewiseLinear, Signal
from reactorwatch.diagnosis.search.dynamic_and_pair_screens import (
    DynamicSignature,
    PairScreen,
    can_be_together,
)
from reactorwatch.diagnosis.search.screen import KNOTS, Candidate, Part
from reactorwatch.diagnosis.search.search import IN_QUESTION, FittedHypothesis, Label, Search, SearchResult, keep_best
from reactorwatch.diagnosis.whiteness import DOUBTFUL, minus_log10_p
from reactorwatch.process.effect import Effect
from reactorwatch.progress import track

LEAST_PAIR_GAIN = 40.0
"""Threshold in BIC, of a pair over the best single cause."""

SHORTLIST, AGAIN, REFINED = 6, 3, 2
"""Pairs fitted after a screen; pairs fitted again with the noise of the best; pairs refined."""

MOST_PROFILES, EXCHANGED = 2, 4
"""Profiles fitted for one cause, and candidates fitted in an exchange."""

NEAR_BEST = 20.0
"""Threshold in BIC: an exchanged pair whose rough fit is worse by more is not fitted fully."""

Pair: TypeAlias = tuple[Part, Part]
"""Two causes with profiles and initial parameters."""

ROUNDS, EXCHANGES = 3, 3
ROUGH_STEPS, EXCHANGE_STEPS = 3, 6
_NEAR = 0.05  # fraction of a pair's gain that a rough fit may lack


def search_pairs(search: Search, result: SearchResult) -> SearchResult:
    """Search for pairs if the best single cause leaves enough for a second one.

    Args:
        search: search of the run.
        result: result for single causes.
    """
    single = result.best
    if not _may_have_second_cause(search, single):
        return result
    pairs = _PairSearch(search, result)
    best, by_label = pairs.search()
    if best is not None and pairs.gain(best) >= LEAST_PAIR_GAIN:
        return SearchResult(search.noise, result.nominal_noise, result.nominal, sorted(by_label.values(), key=_bic))
    if pairs.single.label == single.label:
        search.noise = result.noise
        return result
    # One cause of a pair alone, with a profile that was not tried before.
    search.update_noise(pairs.single)
    alternatives = [item for item in result.hypotheses if item.bic < single.bic + IN_QUESTION]
    fitted = sorted((search.refit(item) for item in (pairs.single, *alternatives)), key=_bic)
    return SearchResult(search.noise, result.nominal_noise, result.nominal, fitted)


def _may_have_second_cause(search: Search, single: FittedHypothesis) -> bool:
    """Return true if the residual of a single cause leaves room for a second one."""
    if np.any(minus_log10_p(single.fit.w, search.run.inputs) > DOUBTFUL):
        return True
    candidates = search.screen.candidates(single.hypothesis, single.fit) if single.label else []
    return any(candidate.score(search.run.values) > LEAST_PAIR_GAIN for candidate in candidates)


class _PairSearch:
    """Searches one run for two causes; `single` is the best single cause."""

    def __init__(self, search: Search, result: SearchResult) -> None:
        self._search, self._run, self._result = search, search.run, result
        self._pair_screen = PairScreen(search.screen, search.run)
        self._order = {effect.name: index for index, effect in enumerate(search.screen.effects)}
        self._constant = Constant(search.run.time_min)
        self._tried: set[frozenset[str]] = set()
        self.single = result.best

    def search(self) -> tuple[FittedHypothesis | None, dict[Label, FittedHypothesis]]:
        """Find the best pair, and all that were fitted fully under the same noise levels."""
        best = self._search_curves()
        if best is None or _has_curve(best):
            best = min((item for item in (best, self._grow_from_single()) if item is not None), key=_bic, default=None)
        if best is None:
            return None, {}
        self._search.update_noise(best)
        return self._exchange(self._fit(best.parts))

    def _search_curves(self) -> FittedHypothesis | None:
        """Find the best pair with curves, and give each cause its simplest adequate profile."""
        search, nominal = self._search, self._result.nominal
        best: FittedHypothesis | None = None
        candidates = self._screen_pairs(self._result.best)
        for _ in range(ROUNDS):
            untried = self._skip_tried(candidates, best)
            rough = sorted((self._fit(parts, ROUGH_STEPS) for parts in track("fitting pair", untried)), key=_bic)
            if not rough:
                break
            if best is None:
                search.update_noise(rough[0])
                rough = sorted((self._fit(item.parts, ROUGH_STEPS) for item in rough[:AGAIN]), key=_bic)
            before, near = best, min(item.bic for item in (*rough, best) if item is not None)
            near += _NEAR * max(nominal.bic - near, 0.0)
            refined = [self._refine(item) for item in track("refining pair", rough[:REFINED]) if item.bic <= near]
            best = min((item for item in (best, *refined) if item is not None), key=_bic)
            if best is before:
                break
            search.update_noise(best)
            best = self._fit(best.parts)
            if self._largest_gain(best) < LEAST_PAIR_GAIN:
                return None
            if not np.any(minus_log10_p(best.fit.w, self._run.inputs) > DOUBTFUL):
                break
            candidates = self._screen_pairs(best)
        return best

    def _grow_from_single(self) -> FittedHypothesis | None:
        """Grow a pair from the best single cause with a simple profile; a curve takes what belongs to others."""
        search = self._search
        simple = [item for item in self._result.hypotheses if not _has_curve(item) and not _has_source(item)]
        if not simple:
            search.noise = self._result.nominal_noise
            nominal = self._result.nominal
            candidates = search.screen.candidates(nominal.hypothesis, nominal.fit)
            candidates = self._select_simple([item for item in candidates if not item.effect.is_source])
            simple = [self._fit([candidate], EXCHANGE_STEPS) for candidate in candidates]
        if not simple:
            return None
        first = min(simple, key=_bic)
        search.update_noise(first)
        first = search.refit(first)
        (part,) = first.parts
        candidates = search.screen.candidates(first.hypothesis, first.fit)
        others = [effect for effect in search.screen.dynamic_effects if can_be_together(effect, part.effect)]
        candidates += search.dynamic_screen.candidates(first.fit, partial(self._evaluate_with, [part]), others)
        candidates = self._select_simple([item for item in candidates if can_be_together(item.effect, part.effect)])
        pairs = [self._fit([part, candidate], EXCHANGE_STEPS) for candidate in track("fitting pair", candidates)]
        if not pairs:
            return None
        best = min(pairs, key=_bic)
        search.update_noise(best)
        best = self._exchange(self._fit(best.parts), curves=False)[0]
        search.update_noise(best)
        return self._fit(best.parts)

    def _select_simple(self, candidates: Sequence[Candidate]) -> list[Candidate]:
        """Select the best candidates of different causes that are not curves."""
        candidates = [item for item in candidates if not isinstance(item.profile, PiecewiseLinear)]
        candidates.sort(key=lambda item: -item.score(self._run.values))
        return self._search.select(candidates, EXCHANGED, -inf, of_a_cause=1)

    def gain(self, pair: FittedHypothesis) -> float:
        """Gain of a pair in BIC over the best single cause, either of the two included, at the present noise levels."""
        singles = [self._search.refit(self.single)] if self.single.label else [self._search.fit_nominal()]
        singles += [self._fit([part]) for part in pair.parts]
        self.single = min(singles, key=_bic)
        return self.single.bic - pair.bic

    def _largest_gain(self, pair: FittedHypothesis) -> float:
        """Upper bound of `gain`: the best single cause as it was fitted at other noise levels."""
        single = self._search.fit_nominal()
        if self.single.label:
            self._search.filter(self.single.hypothesis.filter.effects)
            single = self._search.evaluate(self.single.hypothesis, self.single.fit.parameters)
        return single.bic - pair.bic

    def _skip_tried(self, candidates: Sequence[Pair], best: FittedHypothesis | None) -> list[Pair]:
        """Select pairs that were not fitted and predict more than the best pair itself."""
        result = []
        for pair in candidates:
            causes = frozenset(part.effect.name for part in pair)
            if best is not None and causes == set(best.hypothesis.causes):
                break
            if causes not in self._tried:
                self._tried.add(causes)
                result.append(pair)
        return result

    def _exchange(
        self, best: FittedHypothesis, curves: bool = True
    ) -> tuple[FittedHypothesis, dict[Label, FittedHypothesis]]:
        """Exchange each cause for a better one, with or without curves, until nothing is better."""
        search = self._search
        by_label: dict[Label, FittedHypothesis] = {best.label: best}
        for turn in range(EXCHANGES):
            if turn:
                search.update_noise(best)
                best = self._fit(best.parts)
            best = search.with_selected_knots(best, EXCHANGE_STEPS)
            by_label, unchanged = {best.label: best}, best
            for index in (0, 1):
                candidates = self._select_new(self._candidates(best, index), best)
                candidates = [item for item in candidates if curves or not isinstance(item.profile, PiecewiseLinear)]
                least = max((item.score(self._run.values) for item in candidates), default=0.0) - IN_QUESTION
                for candidate in track("fitting pair", search.select(candidates, EXCHANGED, least)):
                    knots = best.hypothesis.profiles[index].n_linear
                    item = self._fit(_replace_part(best, index, candidate, knots), EXCHANGE_STEPS)
                    if isinstance(candidate.profile, PiecewiseLinear) and item.bic < best.bic + IN_QUESTION:
                        item = search.with_selected_knots(item, EXCHANGE_STEPS)
                    if item.bic < best.bic + NEAR_BEST:
                        keep_best(by_label, self._fit(item.parts, scan=candidate.effect.is_discontinuous))
            best = min(by_label.values(), key=_bic)
            if best.label == unchanged.label:
                break
        return best, by_label

    def _refine(self, pair: FittedHypothesis) -> FittedHypothesis:
        """Give each cause the best of its profiles.

        A discontinuous effect keeps its curve only until a profile is fitted.
        """
        best = pair
        for index in (0, 1):
            about, jumps = best, best.hypothesis.filter.effects[index].is_discontinuous
            provisional = jumps and isinstance(about.hypothesis.profiles[index], PiecewiseLinear)
            candidates = self._candidates(about, index, own=True)
            # The size of a discontinuous effect has not been scanned yet.
            candidates = candidates if jumps else self._select_new(candidates, about)
            items = [
                self._fit(_replace_part(about, index, candidate), EXCHANGE_STEPS, scan=jumps)
                for candidate in self._search.select(candidates, MOST_PROFILES, -inf, of_a_cause=MOST_PROFILES)
            ]
            best = min(items if provisional and items else [*items, about], key=_bic)
        return self._fit(best.parts)

    def _select_new(self, candidates: Sequence[Candidate], pair: FittedHypothesis) -> list[Candidate]:
        """Select candidates that differ from the pair's parts.

        With nonlinear parameters the same profile may have another optimum.
        """
        fixed = {item.label for item in pair.parts if not item.profile.nonlinear_parameters}
        return [item for item in candidates if item.label not in fixed]

    def _candidates(self, pair: FittedHypothesis, index: int, own: bool = False) -> list[Candidate]:
        """Candidates to replace one cause of a pair; with `own` that cause itself alone, with any profile."""
        search, parts = self._search, pair.parts
        effect, other = parts[index].effect, parts[1 - index]
        candidates: list[Candidate] = []
        if not own or effect in search.screen.static_effects:
            candidates += search.screen.candidates(pair.hypothesis, pair.fit, (index,), (effect,) if own else None)
        if effect in search.screen.dynamic_effects:
            reduced = search.evaluate(Hypothesis(search.filter((other.effect,)), (other.profile,)), (other.parameters,))
            of = [item for item in search.screen.dynamic_effects if can_be_together(item, other.effect)]
            of = [effect] if own else of
            candidates += search.dynamic_screen.candidates(reduced.fit, partial(self._evaluate_with, [other]), of)
        candidates = [item for item in candidates if can_be_together(item.effect, other.effect)]
        return sorted(candidates, key=lambda item: -item.score(self._run.values))

    def _evaluate_with(
        self, beside: Sequence[Part], effect: Effect, signals: Sequence[Signal]
    ) -> list[FilterEvaluation]:
        """Run filters with one more deviation, for several such deviations."""
        others = {part.effect.name: part.profile.signal(part.parameters) for part in beside}
        effects = self._order_effects([*(part.effect for part in beside), effect])
        several = [[(others | {effect.name: signal})[item.name] for item in effects] for signal in signals]
        return self._search.filter(effects).evaluate_all(self._run, several)

    def _screen_pairs(self, about: FittedHypothesis) -> list[Pair]:
        """Screen for pairs that explain everything, linearised about a run."""
        search = self._search
        hypothesis, fit = about.hypothesis, about.fit
        with np.errstate(over="ignore", invalid="ignore"):
            dynamics = search.screen.dynamics_of_all(hypothesis, fit, range(len(hypothesis.profiles)))
            return self._pair_screen.candidates(dynamics, self._dynamic_signatures(about), SHORTLIST)

    def _dynamic_signatures(self, about: FittedHypothesis) -> list[DynamicSignature]:
        result = []
        parts = about.parts
        own = {part.effect.name: index for index, part in enumerate(parts)}
        for effect in track("screening for pairs, dynamic cause", self._search.screen.dynamic_effects):
            starts = effect.start_values or (effect.typical,)
            beside, before = parts, about.fit.w
            if effect.name in own:
                part = parts[own[effect.name]]
                mean = float(np.mean(np.abs(part.profile.signal(part.parameters).sample_value)))
                starts = (max(mean, 0.1 * effect.typical),)
                beside = [item for item in parts if item is not part]
                before = about.hypothesis.innovations_without(self._run, about.fit, own[effect.name])
            if effect.delays_output is not None and any(item.effect.delays_output is not None for item in beside):
                continue  # a filter delays one output
            signals = [self._constant.signal(np.array([start])) for start in starts]
            for start, item in zip(starts, self._evaluate_with(beside, effect, signals), strict=True):
                result.append(DynamicSignature(effect, start, huber_clip(before) - huber_clip(item.w)))
        return result

    def _fit(self, parts: Sequence[Part], steps: int = MOST_STEPS, scan: bool = False) -> FittedHypothesis:
        search = self._search
        parts = sorted(parts, key=lambda part: self._order[part.effect.name])
        hypothesis = Hypothesis(search.filter(tuple(part.effect for part in parts)), [part.profile for part in parts])
        return search.fit(hypothesis, [part.parameters for part in parts], steps, scan)

    def _order_effects(self, effects: Sequence[Effect]) -> tuple[Effect, ...]:
        return tuple(sorted(effects, key=lambda effect: self._order[effect.name]))


def _replace_part(fitted: FittedHypothesis, index: int, candidate: Candidate, knots: int = KNOTS) -> list[Part]:
    """Replace one of the two; a curve gets at least this many knots."""
    curve, parts = isinstance(candidate.profile, PiecewiseLinear), fitted.parts
    parts[index] = _refine_knots(candidate, knots) if curve and knots > KNOTS else candidate
    return parts


def _refine_knots(part: Part, knots: int) -> Part:
    """Interpolate the curve on more knots."""
    finer = PiecewiseLinear(part.profile.time_min, knots)
    values = part.profile.basis_functions(np.empty(0))[0] @ part.parameters[: part.profile.n_linear]
    return Part(part.effect, finer, np.interp(finer.knots_min, part.profile.time_min, values))


def _has_curve(fitted: FittedHypothesis) -> bool:
    """Return true if one of the profiles is a curve."""
    return any(isinstance(profile, PiecewiseLinear) for profile in fitted.hypothesis.profiles)


def _has_source(fitted: FittedHypothesis) -> bool:
    """Return true if one of the causes is an unmodelled source."""
    return any(effect.is_source for effect in fitted.hypothesis.filter.effects)


def _bic(fitted: FittedHypothesis) -> float:
    return fitted.bic
