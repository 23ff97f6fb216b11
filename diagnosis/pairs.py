"""Two causes at once.

Two deviations that are there together can look like a third one, and then the best single cause is neither of them. So
a second one is not only put beside the best: each of the two is then exchanged, the other held, for whatever explains
the rest better, until nothing does; and it all begins from several single causes. A pair is a strong claim and takes a
gain of `LEAST_PAIR_GAIN`.
"""

from collections.abc import Sequence
from typing import TypeAlias

from diagnosis.courses import Course
from diagnosis.hypothesis import Hypothesis
from diagnosis.screen import Lead
from diagnosis.search import IN_QUESTION, Explained, Found, Key, Search, keep
from reactorwatch.process.effects.base import Effect
from reactorwatch.process.model import Array

Part: TypeAlias = tuple[Effect, Course, Array]
"""An effect, its course and its numbers."""

LEAST_PAIR_GAIN = 40.0
"""In BIC, of a pair over the best single cause."""

BEGINNINGS, SECONDS, EXCHANGED = 2, 2, 4
"""How many single causes it begins from, leads that are put beside each, and leads that are tried in an exchange."""

EXCHANGES = 4


def with_pairs(search: Search, found: Found) -> Found:
    """What was found, and pairs if the best single cause leaves so much that a second one explains.

    Args:
        search: that found it.
        found: single causes.
    """
    if not found.explained or found.best is found.nominal:
        return found
    single = found.best
    pairs: dict[Key, Explained] = {}
    for begin in _beginnings(found.explained):
        left = _promising(search, search.screen.leads(begin.hypothesis, begin.fit), LEAST_PAIR_GAIN)
        if begin is single and not left:
            return found
        for lead in _others(left, begin)[:SECONDS]:
            keep(pairs, _fitted(search, [*_parts(begin), (lead.effect, lead.course, lead.theta)]))
    if not pairs:
        return found
    best = min(pairs.values(), key=lambda item: item.bic)
    for _ in range(EXCHANGES):
        search.settle(best)
        pairs = {best.key: search.refitted(best)}
        best = again = pairs[best.key]
        for place in (0, 1):
            leads = search.screen.leads(best.hypothesis, best.fit, replaced=(place,))
            least = max((item.score(search.run.values) for item in leads), default=0.0) - IN_QUESTION
            for lead in search.chosen(_others(leads, best, place), EXCHANGED, least):
                keep(pairs, _exchanged(search, best, place, lead))
        best = min(pairs.values(), key=lambda item: item.bic)
        if best is again:
            break
    if search.refitted(single).bic - best.bic < LEAST_PAIR_GAIN:
        return found
    explained = sorted(pairs.values(), key=lambda item: item.bic)
    return Found(search.noise, found.own_noise, found.nominal, explained)


def _beginnings(explained: Sequence[Explained]) -> list[Explained]:
    """The best of different causes."""
    found: dict[tuple[str, ...], Explained] = {}
    for item in explained:
        found.setdefault(item.hypothesis.causes, item)
    return list(found.values())[:BEGINNINGS]


def _promising(search: Search, leads: Sequence[Lead], least: float) -> list[Lead]:
    return [lead for lead in leads if lead.score(search.run.values) > least]


def _others(leads: Sequence[Lead], beside: Explained, replaced: int | None = None) -> list[Lead]:
    """Leads of causes that are not there already, but for the one to be replaced."""
    taken = [effect for place, effect in enumerate(beside.hypothesis.sized.effects) if place != replaced]
    return [lead for lead in leads if lead.effect not in taken]


def _exchanged(search: Search, pair: Explained, place: int, lead: Lead) -> Explained:
    """With one of the two replaced."""
    parts = _parts(pair)
    parts[place] = (lead.effect, lead.course, lead.theta)
    return _fitted(search, parts)


def _parts(explained: Explained) -> list[Part]:
    hypothesis = explained.hypothesis
    return list(zip(hypothesis.sized.effects, hypothesis.courses, explained.fit.theta, strict=True))


def _fitted(search: Search, parts: Sequence[Part]) -> Explained:
    effects, courses, theta = zip(*parts, strict=True)
    return search.fit(Hypothesis(search.sized(effects), courses), theta)
