"""Two causes at once.

Two deviations that are there together can look like a third one, and then the best single cause is neither of them. So
all pairs are screened together (`pair_screen`), about the run of the best single cause, and the best are fitted
roughly, with curves that can be anything. Of the best of these each cause takes the simplest course that does, and
about its run, where linear equations hold, all pairs are screened again.

A curve can take what belongs to the other cause. So if one is left, a pair is grown without curves too, from the best
single cause of a simple course, and the likelier of the two goes on. In the end each of the two is exchanged, the other
held, for whatever explains the rest better, until nothing does. A pair is a strong claim and takes a gain of
`LEAST_PAIR_GAIN`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.fault_filter import Followed, clipped
from reactorwatch.diagnosis.fitting.hypothesis import MOST_STEPS, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant, Course, Free, Signal
from reactorwatch.diagnosis.search.pair_screen import PairLead, PairScreen, Remembered
from reactorwatch.diagnosis.search.screen import KNOTS, Lead
from reactorwatch.diagnosis.search.search import IN_QUESTION, Explained, Found, Key, Search, keep
from reactorwatch.diagnosis.whiteness import DOUBTFUL, minus_log10_p
from reactorwatch.process.effect import Effect

LEAST_PAIR_GAIN = 40.0
"""In BIC, of a pair over the best single cause."""

SHORTLIST, AGAIN, REFINED = 6, 3, 2
"""How many pairs of a screen are fitted, how many of these again with the noise of the best, and how many well."""

COURSES, EXCHANGED = 2, 4
"""How many courses of one cause are fitted, and how many leads in an exchange."""

NEAR_BEST = 20.0
"""In BIC: what is exchanged and fits worse, roughly, is not fitted to the end."""

ROUNDS, EXCHANGES = 3, 3
ROUGH_STEPS, EXCHANGE_STEPS = 3, 6
_NEAR = 0.05  # of what a pair gains: what a rough fit may fall short


@dataclass(frozen=True, eq=False)
class Part:
    """One cause of a pair."""

    effect: Effect
    course: Course
    theta: Array


def with_pairs(search: Search, found: Found) -> Found:
    """What was found, and pairs if the best single cause leaves so much that a second one explains.

    Args:
        search: that found it.
        found: single causes.
    """
    single = found.best
    if not _inadequate(search, single):
        return found
    pairs = PairSearch(search, found)
    best, known = pairs.found()
    if best is not None and pairs.gain(best) >= LEAST_PAIR_GAIN:
        return Found(search.noise, found.own_noise, found.nominal, sorted(known.values(), key=_bic))
    if pairs.single.key == single.key:
        search.noise = found.noise
        return found
    # One of a pair, alone, in a course that was not tried before.
    search.settle(pairs.single)
    rivals = [item for item in found.explained if item.bic < single.bic + IN_QUESTION]
    explained = sorted((search.refitted(item) for item in (pairs.single, *rivals)), key=_bic)
    return Found(search.noise, found.own_noise, found.nominal, explained)


def _inadequate(search: Search, single: Explained) -> bool:
    """Whether a single cause leaves so much that there may be a second."""
    if np.any(minus_log10_p(single.fit.w, search.run.inputs) > DOUBTFUL):
        return True
    leads = search.screen.leads(single.hypothesis, single.fit) if single.key else []
    return any(lead.score(search.run.values) > LEAST_PAIR_GAIN for lead in leads)


class PairSearch:
    """Searches one run for two causes.

    Args:
        search: of the run.
        found: single causes.

    Attributes:
        single: the best single cause.
    """

    def __init__(self, search: Search, found: Found) -> None:
        self._search, self._run, self._found = search, search.run, found
        self._pair_screen = PairScreen(search.screen, search.run)
        self._order = {effect.name: place for place, effect in enumerate(search.screen.effects)}
        self._constant = Constant(search.run.time_min)
        self._tried: set[frozenset[str]] = set()
        self.single = found.best

    def found(self) -> tuple[Explained | None, dict[Key, Explained]]:
        """The best pair, and all that were fitted well under the same noise."""
        best = self._curved()
        if best is None or _curves(best):
            best = min((item for item in (best, self._grown()) if item is not None), key=_bic, default=None)
        if best is None:
            return None, {}
        self._search.settle(best)
        return self._exchanged(self._fitted(_parts(best)))

    def _curved(self) -> Explained | None:
        """The best that is found with curves, of which each then takes the simplest course that does."""
        search, nominal = self._search, self._found.nominal
        best: Explained | None = None
        leads = self._screened(self._found.best)
        for _ in range(ROUNDS):
            rough = sorted((self._fitted(_parts_of(lead), ROUGH_STEPS) for lead in self._fresh(leads, best)), key=_bic)
            if not rough:
                break
            if best is None:
                search.settle(rough[0])
                rough = sorted((self._fitted(_parts(item), ROUGH_STEPS) for item in rough[:AGAIN]), key=_bic)
            before, near = best, min(item.bic for item in (*rough, best) if item is not None)
            near += _NEAR * max(nominal.bic - near, 0.0)
            refined = [self._refined(item) for item in rough[:REFINED] if item.bic <= near]
            best = min((item for item in (best, *refined) if item is not None), key=_bic)
            if best is before:
                break
            search.settle(best)
            best = self._fitted(_parts(best))
            if self.gain(best) < LEAST_PAIR_GAIN:
                return None
            if not np.any(minus_log10_p(best.fit.w, self._run.inputs) > DOUBTFUL):
                break
            leads = self._screened(best)
        return best

    def _grown(self) -> Explained | None:
        """From the best single cause whose course has few numbers: a curve takes what belongs to a second one."""
        search = self._search
        simple = [item for item in self._found.explained if not _curves(item)]
        if not simple:
            search.noise = self._found.own_noise
            nominal = self._found.nominal
            leads = self._simple(search.screen.leads(nominal.hypothesis, nominal.fit))
            simple = [self._fitted([_part_of(lead)], EXCHANGE_STEPS) for lead in leads]
        if not simple:
            return None
        first = min(simple, key=_bic)
        search.settle(first)
        first = search.refitted(first)
        (part,) = _parts(first)
        leads = search.screen.leads(first.hypothesis, first.fit)
        others = [effect for effect in search.screen.with_memory if effect is not part.effect]
        leads += search.memory.leads(first.fit, lambda item, signals: self._followed([part], item, signals), others)
        leads = self._simple([lead for lead in leads if lead.effect is not part.effect])
        pairs = [self._fitted([part, _part_of(lead)], EXCHANGE_STEPS) for lead in leads]
        if not pairs:
            return None
        best = min(pairs, key=_bic)
        search.settle(best)
        best = self._exchanged(self._fitted(_parts(best)), curves=False)[0]
        search.settle(best)
        return self._fitted(_parts(best))

    def _simple(self, leads: Sequence[Lead]) -> list[Lead]:
        """The most promising of different causes that are no curves."""
        leads = [lead for lead in leads if not isinstance(lead.course, Free)]
        leads.sort(key=lambda item: -item.score(self._run.values))
        return self._search.chosen(leads, EXCHANGED, -inf, of_a_cause=1)

    def gain(self, pair: Explained) -> float:
        """In BIC, of a pair over the best single cause, with the noise that holds now; either of the two, too."""
        singles = [self._search.refitted(self.single)] if self.single.key else [self._search.nominal()]
        singles += [self._fitted([part]) for part in _parts(pair)]
        self.single = min(singles, key=_bic)
        return self.single.bic - pair.bic

    def _fresh(self, leads: Sequence[PairLead], best: Explained | None) -> list[PairLead]:
        """Those that were not fitted yet and promise more than the best pair itself, which has been fitted."""
        found = []
        for lead in leads:
            if best is not None and lead.causes == set(best.hypothesis.causes):
                break
            if lead.causes not in self._tried:
                self._tried.add(lead.causes)
                found.append(lead)
        return found

    def _exchanged(self, best: Explained, curves: bool = True) -> tuple[Explained, dict[Key, Explained]]:
        """Each of the two exchanged for whatever is better, with curves or without them, until nothing is."""
        search = self._search
        known: dict[Key, Explained] = {best.key: best}
        for turn in range(EXCHANGES):
            if turn:
                search.settle(best)
                best = self._fitted(_parts(best))
            best = search.resolved(best, EXCHANGE_STEPS)
            known, again = {best.key: best}, best
            for place in (0, 1):
                leads = self._new(self._leads(best, place), best)
                leads = [lead for lead in leads if curves or not isinstance(lead.course, Free)]
                least = max((item.score(self._run.values) for item in leads), default=0.0) - IN_QUESTION
                for lead in search.chosen(leads, EXCHANGED, least):
                    knots = best.hypothesis.courses[place].coefficients
                    item = self._fitted(_with(best, place, lead, knots), EXCHANGE_STEPS)
                    if isinstance(lead.course, Free) and item.bic < best.bic + IN_QUESTION:
                        item = search.resolved(item, EXCHANGE_STEPS)
                    if item.bic < best.bic + NEAR_BEST:
                        keep(known, self._fitted(_parts(item), scan=lead.effect.is_discontinuous))
            best = min(known.values(), key=_bic)
            if best.key == again.key:
                break
        return best, known

    def _refined(self, pair: Explained) -> Explained:
        """Each cause with the best of its courses. What acts in jumps had a curve only until a course is found."""
        best = pair
        for place in (0, 1):
            about, jumps = best, best.hypothesis.sized.effects[place].is_discontinuous
            provisional = jumps and isinstance(about.hypothesis.courses[place], Free)
            leads = self._leads(about, place, own=True)
            leads = leads if jumps else self._new(leads, about)  # its size has not been looked for yet
            items = [
                self._fitted(_with(about, place, lead), EXCHANGE_STEPS, scan=jumps)
                for lead in self._search.chosen(leads, COURSES, -inf, of_a_cause=COURSES)
            ]
            best = min(items if provisional and items else [*items, about], key=_bic)
        return self._fitted(_parts(best))

    def _new(self, leads: Sequence[Lead], pair: Explained) -> list[Lead]:
        """Those that are no part of a pair with the same course already, unless there may be another optimum."""
        there = {(part.effect.name, part.course.name) for part in _parts(pair) if not part.course.numbers}
        return [lead for lead in leads if (lead.effect.name, lead.course.name) not in there]

    def _leads(self, pair: Explained, place: int, own: bool = False) -> list[Lead]:
        """What may take the place of one of the two.

        Args:
            pair: the two.
            place: of the one.
            own: its own cause alone, in any course.
        """
        search, parts = self._search, _parts(pair)
        effect, other = parts[place].effect, parts[1 - place]
        leads: list[Lead] = []
        if not own or effect in search.screen.direct:
            leads += search.screen.leads(pair.hypothesis, pair.fit, (place,), (effect,) if own else None)
        if effect in search.screen.with_memory:
            alone = search.explained(Hypothesis(search.sized((other.effect,)), (other.course,)), (other.theta,))
            of = [
                item for item in search.screen.with_memory if item is not other.effect and (item is effect or not own)
            ]
            leads += search.memory.leads(alone.fit, lambda item, signals: self._followed([other], item, signals), of)
        leads = [lead for lead in leads if lead.effect is not other.effect]
        return sorted(leads, key=lambda item: -item.score(self._run.values))

    def _followed(self, beside: Sequence[Part], effect: Effect, signals: Sequence[Signal]) -> list[Followed]:
        """What filters make of the run with one more deviation, of several."""
        others = {part.effect.name: part.course.signal(part.theta) for part in beside}
        effects = self._sorted([*(part.effect for part in beside), effect])
        several = [[(others | {effect.name: signal})[item.name] for item in effects] for signal in signals]
        return self._search.sized(effects).follow_all(self._run, several)

    def _screened(self, about: Explained) -> list[PairLead]:
        """Pairs that may explain all that there is to explain, linearised about a run."""
        search = self._search
        hypothesis, fit = about.hypothesis, about.fit
        with np.errstate(over="ignore", invalid="ignore"):
            ways = search.screen.ways_of_all(hypothesis, fit, range(len(hypothesis.courses)))
            return self._pair_screen.leads(ways, self._remembered(about), SHORTLIST)

    def _remembered(self, about: Explained) -> list[Remembered]:
        found = []
        parts = _parts(about)
        own = {part.effect.name: place for place, part in enumerate(parts)}
        for effect in self._search.screen.with_memory:
            starts = effect.start_values or (effect.typical,)
            beside, before = parts, about.fit.w
            if effect.name in own:
                part = parts[own[effect.name]]
                starts = (max(float(np.mean(np.abs(part.course.signal(part.theta).at_row))), 0.1 * effect.typical),)
                beside = [item for item in parts if item is not part]
                before = about.hypothesis.without(self._run, about.fit, own[effect.name])
            followed = self._followed(beside, effect, [self._constant.signal(np.array([start])) for start in starts])
            for start, item in zip(starts, followed, strict=True):
                found.append(Remembered(effect, start, clipped(before) - clipped(item.w)))
        return found

    def _fitted(self, parts: Sequence[Part], steps: int = MOST_STEPS, scan: bool = False) -> Explained:
        search = self._search
        parts = sorted(parts, key=lambda part: self._order[part.effect.name])
        hypothesis = Hypothesis(search.sized(tuple(part.effect for part in parts)), [part.course for part in parts])
        return search.fit(hypothesis, [part.theta for part in parts], steps, scan)

    def _sorted(self, effects: Sequence[Effect]) -> tuple[Effect, ...]:
        return tuple(sorted(effects, key=lambda effect: self._order[effect.name]))


def _parts_of(lead: PairLead) -> list[Part]:
    return [Part(*part) for part in lead.parts]


def _parts(explained: Explained) -> list[Part]:
    hypothesis = explained.hypothesis
    whole = zip(hypothesis.sized.effects, hypothesis.courses, explained.fit.theta, strict=True)
    return [Part(*item) for item in whole]


def _part_of(lead: Lead) -> Part:
    return Part(lead.effect, lead.course, lead.theta)


def _with(explained: Explained, place: int, lead: Lead, knots: int = KNOTS) -> list[Part]:
    """One of the two exchanged; a curve with at least so many knots."""
    parts, part = _parts(explained), _part_of(lead)
    parts[place] = _with_knots(part, knots) if isinstance(lead.course, Free) and knots > KNOTS else part
    return parts


def _with_knots(part: Part, knots: int) -> Part:
    """The same curve with more knots."""
    finer = Free(part.course.time_min, knots)
    values = part.course.functions(np.empty(0))[0] @ part.theta
    return Part(part.effect, finer, np.interp(finer.knots_min, part.course.time_min, values))


def _curves(explained: Explained) -> bool:
    """Whether one of its courses is a curve."""
    return any(isinstance(course, Free) for course in explained.hypothesis.courses)


def _bic(explained: Explained) -> float:
    return explained.bic
