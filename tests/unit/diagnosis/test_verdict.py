"""The verdict of a search: a table of hypotheses and the verdict, at and beside the stated differences of BIC."""

from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import reactorwatch.diagnosis.decide as decide_module
from reactorwatch.diagnosis.decide import (
    SURE,
    Found,
    Graded,
    PlaceFound,
    Verdict,
    decide,
    decide_without_nuisance,
    grade_of,
)
from reactorwatch.diagnosis.exact.answer import alternatives_of
from reactorwatch.diagnosis.exact.explain import _drop_hidden, _search_evidence
from reactorwatch.diagnosis.graded import separate_corrections
from reactorwatch.diagnosis.result import AMBIGUOUS, LISTED, NAMED, NOMINAL, UNKNOWN, Estimate, make_cause
from reactorwatch.diagnosis.search.search import FittedHypothesis, SearchResult
from reactorwatch.process import effects_of
from reactorwatch.process.library.cstr import cstr

BEST_BIC = 100.0
LEAK, FOULING, SOURCE = "leak", "fouling", "source of A"


@dataclass(frozen=True)
class NamedEffect:
    name: str

    @property
    def is_source(self) -> bool:
        return self.name == SOURCE


def hypothesis(causes: tuple[str, ...], above: float) -> FittedHypothesis:
    effects: Any = tuple(map(NamedEffect, causes))
    stated: Any = SimpleNamespace(causes=causes, filter=SimpleNamespace(effects=effects))
    return FittedHypothesis(stated, SimpleNamespace(), BEST_BIC + above)  # type: ignore[arg-type]


def result(*hypotheses: tuple[tuple[str, ...], float], nominal: float = 1000.0) -> SearchResult:
    noise: Any = None
    return SearchResult(noise, noise, hypothesis((), nominal), [hypothesis(*item) for item in hypotheses])


@pytest.mark.parametrize(
    ("hypotheses", "verdict"),
    [
        ([((LEAK,), 0.0)], NAMED),
        ([((LEAK,), 0.0), ((FOULING,), SURE)], NAMED),
        ([((LEAK,), 0.0), ((FOULING,), SURE - 0.01)], AMBIGUOUS),
        ([((LEAK,), 0.0), ((LEAK,), 1.0)], NAMED),  # another profile of the same cause
        ([((LEAK, FOULING), 0.0), ((LEAK,), 1.0)], AMBIGUOUS),
        ([((SOURCE,), 0.0)], UNKNOWN),
        ([((SOURCE,), 0.0), ((LEAK,), SURE)], UNKNOWN),
        ([((SOURCE,), 0.0), ((LEAK,), 1.0)], AMBIGUOUS),
        ([((LEAK,), 0.0), ((SOURCE,), 1.0)], AMBIGUOUS),
        ([((SOURCE, LEAK), 0.0)], NAMED),
    ],
)
def test_the_verdict_follows_from_the_causes_near_the_best(
    hypotheses: list[tuple[tuple[str, ...], float]], verdict: str
) -> None:
    found = result(*hypotheses)
    assert decide_without_nuisance(_search_evidence(found, found.best, np.zeros(1)), None) == verdict


@pytest.mark.parametrize("nearest", [0.01, 100.0])
def test_the_nominal_hypothesis_wins_whatever_is_near(nearest: float) -> None:
    found = result(((LEAK,), nearest), nominal=0.0)  # of which the search takes the nominal one
    assert decide_without_nuisance(_search_evidence(found, found.nominal, np.zeros(1)), None) == NOMINAL
    assert alternatives_of(found, found.nominal) == []


def test_the_alternatives_are_the_best_of_every_other_set_of_causes_within_the_limit() -> None:
    found = result(
        ((LEAK,), 0.0),
        ((LEAK,), 1.0),
        ((FOULING,), 2.0),
        ((FOULING,), 3.0),
        ((SOURCE,), LISTED),
        ((LEAK, FOULING), 9.9),
    )
    assert [(item.hypothesis.causes, item.bic) for item in alternatives_of(found, found.best)] == [
        ((FOULING,), BEST_BIC + 2.0),
        ((LEAK, FOULING), BEST_BIC + 9.9),
    ]


@pytest.mark.parametrize(("named", "kept"), [(SURE - 0.01, 1), (SURE, 2)])
def test_hypotheses_of_sources_are_left_out_if_a_named_one_is_near(named: float, kept: int) -> None:
    found = result(((SOURCE,), 0.0), ((LEAK,), named))
    hidden = found.hypotheses[0].hypothesis.filter.effects
    assert len(_drop_hidden(found, hidden).hypotheses) == kept


def test_without_a_named_hypothesis_the_sources_stay() -> None:
    found = result(((SOURCE,), 0.0))
    assert _drop_hidden(found, found.hypotheses[0].hypothesis.filter.effects) is found


WHITE_RESIDUAL, COLOURED, MUCH = 0.3, 9.0, 40.0  # minus the decimal logarithms of p-values


@pytest.mark.parametrize(
    ("found", "place", "verdict"),
    [
        (Found(50.0, False, False, 1, WHITE_RESIDUAL), PlaceFound(False, -100.0, True), NAMED),
        (Found(50.0, False, False, 1, WHITE_RESIDUAL), PlaceFound(True, 100.0, True), UNKNOWN),
        (Found(50.0, False, False, 2, WHITE_RESIDUAL), PlaceFound(False, 0.0, True), AMBIGUOUS),
        (Found(50.0, False, False, 1, COLOURED), PlaceFound(False, -100.0, True), NAMED),
        (Found(50.0, False, False, 1, COLOURED), PlaceFound(False, -100.0, False), UNKNOWN),
        (Found(50.0, False, False, 1, MUCH), PlaceFound(False, -100.0, True), UNKNOWN),
        (Found(50.0, False, False, 2, 15.0), PlaceFound(False, -100.0, True), UNKNOWN),
        (Found(0.0, False, False, 0, MUCH), PlaceFound(False, -100.0, False), UNKNOWN),
        (Found(0.0, False, False, 0, WHITE_RESIDUAL), PlaceFound(True, 100.0, True), NOMINAL),
    ],
)
def test_the_verdict_is_unknown_where_a_place_or_the_residual_calls_for_it(
    found: Found, place: PlaceFound, verdict: str
) -> None:
    assert decide_without_nuisance(found, place) == verdict


NONE = Graded(0.0, 0.0, 4.0, 0.0, "constant")
WITHIN = NONE._replace(left=0.9)
CAUSE = Graded(500.0, 0.99, 0.1, 3.0, "step")


@pytest.mark.parametrize(
    ("none", "graded", "verdict"),
    [
        (NONE, [CAUSE], Verdict(NAMED, "explained", with_nuisance=True)),
        (NONE, [CAUSE._replace(share=0.9, left=2.0)], Verdict(NAMED, "mostly", with_nuisance=True)),
        (NONE, [CAUSE._replace(share=0.9, left=0.9)], Verdict(NAMED, "explained", with_nuisance=True)),
        (NONE, [CAUSE._replace(share=0.7, left=2.0)], Verdict(UNKNOWN, "nearest")),
        (NONE, [CAUSE, CAUSE._replace(lead=491.0)], Verdict(AMBIGUOUS, "explained", with_nuisance=True)),
        (NONE, [CAUSE, CAUSE._replace(lead=489.0)], Verdict(NAMED, "explained", with_nuisance=True)),
        (NONE, [CAUSE._replace(share=0.4, left=3.0)], Verdict(UNKNOWN, "nearest")),
        (NONE, [CAUSE._replace(share=0.05, left=3.9)], Verdict(UNKNOWN, "unknown")),
        (NONE, [CAUSE._replace(lead=9.9)], Verdict(UNKNOWN, "nearest")),
        (WITHIN, [CAUSE._replace(lead=9.9)], Verdict(NOMINAL, "right", with_nuisance=True)),
        (WITHIN, [CAUSE], Verdict(NAMED, "explained", with_nuisance=True)),
        (WITHIN, [CAUSE._replace(effect=0.4)], Verdict(NOMINAL, "right", with_nuisance=True)),
        (WITHIN, [CAUSE._replace(share=0.7)], Verdict(NOMINAL, "right", with_nuisance=True)),
        (WITHIN, [CAUSE._replace(profile="constant")], Verdict(NOMINAL, "right", with_nuisance=True)),
    ],
)
def test_the_grade_follows_from_what_the_best_cause_removes_and_leaves(
    none: Graded, graded: list[Graded], verdict: Verdict
) -> None:
    assert decide(UNKNOWN, 0.0, 4.0, none, graded) == verdict


def test_a_law_stays_unless_a_cause_with_an_onset_explains_the_record() -> None:
    constant = [CAUSE._replace(profile="constant")]
    curve, part = CAUSE._replace(profile="free"), CAUSE._replace(share=0.9)
    assert decide(UNKNOWN, 0.0, 4.0, WITHIN, [curve], is_law=True) == Verdict(UNKNOWN, "nearest")
    assert decide(UNKNOWN, 0.0, 4.0, WITHIN, [part], is_law=True) == Verdict(UNKNOWN, "nearest")
    assert decide(UNKNOWN, 0.0, 4.0, WITHIN, [CAUSE], is_law=True).verdict == NAMED
    rough = CAUSE._replace(left=22.0)  # more than the law leaves
    assert decide(UNKNOWN, 0.0, 0.3, WITHIN, [rough], is_law=True).verdict == UNKNOWN
    assert decide(UNKNOWN, 0.0, 4.0, WITHIN, constant, is_law=True) == Verdict(UNKNOWN, "nearest")
    nothing = WITHIN._replace(left=0.1)
    assert decide(UNKNOWN, 0.0, 4.0, nothing, constant, is_law=True) == Verdict(UNKNOWN, "nearest")


@pytest.mark.parametrize("verdict", [NOMINAL, NAMED, AMBIGUOUS, UNKNOWN])
def test_without_nuisance_the_verdict_of_the_search_stays(verdict: str) -> None:
    assert decide(verdict, 0.97, 3.0, None, []) == Verdict(verdict, grade_of(verdict, 0.97, 3.0))


def test_the_page_has_the_table_of_the_decision() -> None:
    def table(text: str) -> list[str]:
        lines = text.splitlines()
        first = next(row for row, line in enumerate(lines) if line.startswith("| condition, the first that holds |"))
        return list(takewhile(lambda line: line.startswith("|"), lines[first:]))

    page = (Path(__file__).parents[3] / "docs" / "diagnosis.md").read_text(encoding="utf-8")
    assert len(table(page)) > 4
    assert table(page) == table(decide_module.__doc__ or "")


@pytest.mark.parametrize(
    ("profile", "share", "is_small"),
    [("constant", 1.0, True), ("constant", 1.2, False), ("step", 0.08, True), ("step", 0.15, False)],
)
def test_a_small_deviation_beside_a_larger_one_is_a_correction_and_no_cause(
    profile: str, share: float, *, is_small: bool
) -> None:
    effects = {effect.name: effect for effect in effects_of(cstr())}
    first, other = effects["feed_temperature"], effects["reaction_heat"]
    causes = [
        make_cause(effect, name, {"size": Estimate(size * effect.typical, 0.0, effect.unit)})
        for effect, name, size in ((other, profile, -share), (first, "step", 1.0))
    ]
    shown, corrections = separate_corrections(causes, [0.5, 3.0], tuple(effects.values()))
    assert [item.cause for item in shown] == [first.name, other.name][: 2 - is_small]
    assert [item.name for item in corrections] == [other.name] * is_small


def test_a_cause_by_itself_is_no_correction_however_small() -> None:
    (effect, *_) = effects = effects_of(cstr())
    cause = make_cause(effect, "constant", {"size": Estimate(0.01 * effect.typical, 0.0, effect.unit)})
    assert separate_corrections([cause], [0.01], effects) == ((cause,), ())
