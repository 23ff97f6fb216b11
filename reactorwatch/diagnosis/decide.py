"""The verdict: what is said of a record, from the evidence alone. Pure.

| condition, the first that holds | verdict | grade |
|---|---|---|
| no explanation is better than the simulation as it is by `LEAST_GAIN` | nominal | right |
| only unmodelled sources explain it, or a place explains it better than the catalogue | unknown | see below |
| a law explains it, and no cause with an onset removes 95 % with nuisance, or it leaves more than the law and the \
tolerance | unknown | see below |
| with nuisance, what is left without a cause is within the tolerance, and the best cause is better than none by less \
than `LEAST_GAIN`, is there from the beginning, changes the outputs by less than half of the tolerance or removes less \
than 0.8 | nominal | right |
| the best cause with nuisance removes at least 0.8, or half and leaves no more than the tolerance | named, or \
ambiguous | explained or mostly |
| otherwise, without nuisance | named, or ambiguous with a rival within `SURE` | explained or mostly |

Grades of a cause: *explained* if it removes 95 % of the squared error or leaves no more than the tolerance, *mostly* if
it removes half. Of an unknown: *nearest* if the nearest cause removes a tenth, else *unknown*.
"""

from collections.abc import Sequence
from typing import NamedTuple

from reactorwatch.diagnosis.result import (
    AMBIGUOUS,
    EXPLAINED,
    LISTED,
    MOSTLY,
    NAMED,
    NEAREST,
    NOMINAL,
    RIGHT,
    UNEXPLAINED,
    UNKNOWN,
)
from reactorwatch.diagnosis.whiteness import DOUBTFUL, WHITE
from reactorwatch.process.profiles import CONSTANT, FREE_NAME

LEAST_GAIN = 10.0
"""Threshold in BIC to refute the nominal model (Kass & Raftery 1995, J. American Statistical Association 90)."""

SURE = 6.0
"""Threshold in BIC, odds of twenty to one: alternatives that are worse by less are not ranked."""

MUCH_RESIDUAL, MUCH_RESIDUAL_OF_TWO = 30.0, 10.0
"""Minus the decimal logarithm of the p-value of whiteness: no right cause leaves so much, nor do two causes, which can
imitate a third."""

EXPLAINS, MOST, SOME = 0.95, 0.5, 0.1
"""Shares of the squared error from which on a cause explains a record, explains most of it, or is worth naming."""

SMALL_EFFECT, LARGE_SHARE = 0.5, 0.8
"""A record within the tolerance without any cause is right, unless a cause changes the outputs by the first of these,
in tolerances, and removes the second of the error. A cause that is named with nuisance removes at least that, or half
and leaves no more than the tolerance: where the right one was left out of the catalogue, another one removed 0.62 and
left twenty times the tolerance."""


class Found(NamedTuple):
    """Result of a search without nuisance.

    Attributes:
        lead: BIC of the nominal model minus that of the best explanation.
        is_rivalled: whether other causes are worse by less than `SURE`.
        are_sources: whether the best, and all within `SURE`, are unmodelled sources.
        causes: number of causes of the best.
        minus_log10_p: whiteness of its residual, the largest of the outputs.
    """

    lead: float
    is_rivalled: bool
    are_sources: bool
    causes: int
    minus_log10_p: float

    @property
    def is_white(self) -> bool:
        """True if nothing is left but noise."""
        return self.minus_log10_p < DOUBTFUL


class PlaceFound(NamedTuple):
    """Result of a search for an unknown.

    Attributes:
        is_better: whether it explains the record better than the catalogue, by what an unknown has to be better.
        gain: BIC of the best explanation of the catalogue minus that of the unknown.
        is_near_noise: whether the simulation with the best cause of the catalogue errs by little more than the noise.
    """

    is_better: bool
    gain: float
    is_near_noise: bool


class Graded(NamedTuple):
    """An explanation with nuisance, or nuisance alone, as far as a verdict depends on it.

    Attributes:
        lead: twice the logarithm of its evidence over that of nuisance alone.
        share: share of the squared error that it removes.
        left: what it leaves beyond the noise, in tolerances, the largest of the outputs.
        effect: how much the cause changes an output, in tolerances, the largest of the outputs.
        profile: profile of the cause in time; of nuisance alone `constant`.
    """

    lead: float
    share: float
    left: float
    effect: float
    profile: str

    @property
    def is_cause(self) -> bool:
        """True if it explains enough to be named."""
        return self.share >= LARGE_SHARE or (self.share >= MOST and self.left <= 1.0)


class Verdict(NamedTuple):
    """Verdict and grade, and true if they are those of the explanations with nuisance."""

    verdict: str
    grade: str
    with_nuisance: bool = False


def decide_without_nuisance(found: Found, place: PlaceFound | None) -> str:
    """Verdict of a search whose hypotheses are exact.

    Args:
        found: result of the search.
        place: result of the search for an unknown; None: there was none.
    """
    if found.are_sources and found.lead >= LEAST_GAIN:
        return UNKNOWN
    if place is not None:
        if _is_unknown(found, place):
            return UNKNOWN
        if place.gain > -SURE and found.causes > 1:
            return AMBIGUOUS
    if found.lead < LEAST_GAIN:
        return NOMINAL
    return AMBIGUOUS if found.is_rivalled else NAMED


def _is_unknown(found: Found, place: PlaceFound) -> bool:
    """Return true if the catalogue does not explain the run."""
    named = found.causes > 0
    if found.minus_log10_p < WHITE:
        return place.is_better and named
    much = MUCH_RESIDUAL if found.causes == 1 else MUCH_RESIDUAL_OF_TWO
    return not named or found.minus_log10_p >= much or place.is_better or not place.is_near_noise


def grade_of(verdict: str, share: float, left: float) -> str:
    """Grade of a verdict, from the share of its best explanation, and from what that leaves in tolerances."""
    if verdict == NOMINAL:
        return RIGHT
    if verdict == UNKNOWN:
        return NEAREST if share >= SOME else UNEXPLAINED
    return EXPLAINED if share >= EXPLAINS or left <= 1.0 else MOSTLY


def decide(
    verdict: str, share: float, left: float, none: Graded | None, graded: Sequence[Graded], *, is_law: bool = False
) -> Verdict:
    """Verdict and grade.

    Args:
        verdict: verdict without nuisance.
        share: share of the squared error that its best explanation removes.
        left: what that leaves, in tolerances.
        none: nuisance alone; None: the hypotheses were not compared with nuisance.
        graded: explanations with nuisance, the likeliest first.
        is_law: whether a law explains the unknown.
    """
    if none is None or not graded:
        return Verdict(verdict, grade_of(verdict, share, left))
    best = graded[0]
    is_small = best.profile == CONSTANT.name or best.effect < SMALL_EFFECT or best.share < LARGE_SHARE
    is_small = is_small or best.lead < LEAST_GAIN
    if is_law and (best.share < EXPLAINS or best.profile in (CONSTANT.name, FREE_NAME) or best.left > max(left, 1.0)):
        return Verdict(verdict, grade_of(verdict, max(item.share for item in graded), left))
    if is_small and none.left <= 1.0:
        return Verdict(NOMINAL, RIGHT, with_nuisance=True)
    if best.is_cause and best.lead >= LEAST_GAIN:
        rivals = [item for item in graded[1:] if best.lead - item.lead < LISTED and item.is_cause]
        named = AMBIGUOUS if rivals else NAMED
        return Verdict(named, grade_of(named, best.share, best.left), with_nuisance=True)
    if verdict != UNKNOWN and share >= MOST:
        return Verdict(verdict, grade_of(verdict, share, left))
    return Verdict(UNKNOWN, grade_of(UNKNOWN, max(item.share for item in graded), best.left))
