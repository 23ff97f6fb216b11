"""The verdict of a search: a table of hypotheses and the verdict, at and beside the stated differences of BIC."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest

from reactorwatch.diagnosis.diagnose import SURE, _alternatives, _decide_verdict, _drop_hidden
from reactorwatch.diagnosis.result import AMBIGUOUS, LISTED, NAMED, NOMINAL, UNKNOWN
from reactorwatch.diagnosis.search.search import FittedHypothesis, SearchResult

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
    assert _decide_verdict(found, found.best) == verdict


@pytest.mark.parametrize("nearest", [0.01, 100.0])
def test_the_nominal_hypothesis_wins_whatever_is_near(nearest: float) -> None:
    found = result(((LEAK,), nearest), nominal=0.0)
    assert _decide_verdict(found, found.best) == NOMINAL
    assert _alternatives(found, found.best) == []


def test_the_alternatives_are_the_best_of_every_other_set_of_causes_within_the_limit() -> None:
    found = result(
        ((LEAK,), 0.0),
        ((LEAK,), 1.0),
        ((FOULING,), 2.0),
        ((FOULING,), 3.0),
        ((SOURCE,), LISTED),
        ((LEAK, FOULING), 9.9),
    )
    assert [(item.hypothesis.causes, item.bic) for item in _alternatives(found, found.best)] == [
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
