"""Reliability: how often what is stated with a probability is right.

Of sizes and onsets, an interval of a probability holds the truth in this share of the records. Of verdicts, the best
explanation has the probability exp(0) over the sum of exp(-BIC difference / 2) of all listed ones. Of the monitor's
suspects, the smallest set whose probabilities sum to 90 % holds the truth in at least 90 % of the alarms.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import ndtri

from benchmarks.hidden.classes import CLASSES, NEARLY
from benchmarks.hidden.score import Share
from benchmarks.hidden.suspects import SuspectsJudged
from benchmarks.hidden.tables import markdown, percent
from tests.hidden_effect.judge import NOMINAL, UNKNOWN, Judged

INTERVALS = (0.5, 0.8, 0.9, 0.95)
BINS = (0.0, 0.5, 0.8, 0.95, 1.0)
SET = 0.9
"""Probability of a set of suspects."""


@dataclass(frozen=True)
class Group:
    """Records that are shown in one block of the table."""

    name: str
    judged: Sequence[Judged]


def reliability_table(found: Mapping[str, Sequence[Judged]], suspects: Sequence[SuspectsJudged] = ()) -> str:
    """Table of what was stated and how often it was right, as Markdown."""
    rows = []
    for group in _groups(found):
        scores = [score for item in group.judged for score in item.size_scores]
        onsets = [score for item in group.judged for score in item.onset_scores]
        for what, values in (("size", scores), ("onset of a step", onsets)):
            for level in INTERVALS if values else ():
                inside = Share.of(value <= float(ndtri(0.5 + 0.5 * level)) for value in values)
                rows.append([group.name, f"{what} in its interval", f"{100 * level:.0f}", percent(inside)])
        named = [item for item in group.judged if item.verdict not in (NOMINAL, UNKNOWN) and not item.remark]
        rows += _bins(group.name, "verdict", [(item.probability, item.first) for item in named])
        if named:
            held = Share.of(set(item.truth) <= set(item.said) for item in named)
            rows.append([group.name, "hidden cause among those named", "–", percent(held)])
    for nearly in (False, True):
        of_kind = [item for item in suspects if item.nearly is nearly]
        name = NEARLY if nearly else "the model itself"
        rows += _bins(name, "first suspect", [(item.first_probability, item.first) for item in of_kind])
        if of_kind:
            inside = Share.of(item.in_set for item in of_kind)
            rows.append([name, "cause in the set of suspects", f"{100 * SET:.0f}", percent(inside)])
    return markdown(["records", "stated", "with %", "right %"], rows)


def _groups(found: Mapping[str, Sequence[Judged]]) -> list[Group]:
    groups: dict[str, list[Judged]] = {}
    for study in CLASSES:
        if study.kind == "single" and study.name in found:
            name = NEARLY if study.name == NEARLY else "the model itself"
            groups.setdefault(name, []).extend(found[study.name])
    return [Group(name, judged) for name, judged in groups.items()]


def _bins(name: str, what: str, stated: Iterable[tuple[float, bool]]) -> list[list[str]]:
    """A row for each range of stated probabilities."""
    items, rows = list(stated), []
    for low, high in pairwise(BINS):
        inside = [(p, right) for p, right in items if low < p <= high]
        if inside:
            mean = float(np.mean([p for p, _ in inside]))
            rows.append([name, what, f"{100 * mean:.0f}", percent(Share.of(right for _, right in inside))])
    return rows
