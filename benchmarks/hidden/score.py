"""Scores of judged records, and the tables of the study.

Reliability is how often what is stated with a probability is right. Of sizes and onsets, an interval of a probability
holds the truth in this share of the records. Of verdicts, the best explanation has the probability exp(0) over the sum
of exp(-BIC difference / 2) of all listed ones. Of the monitor's suspects, the smallest set whose probabilities sum to
90 % holds the truth in at least 90 % of the alarms.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf, isfinite, isnan

import numpy as np
from scipy.special import ndtri
from scipy.stats import binomtest

import reactorwatch as rw
from benchmarks.harness.study import markdown
from benchmarks.hidden.classes import CLASSES, NEARLY, find_class
from monitor_node.causes.isolation import causes_of
from reactorwatch.description.read import find_process
from tests.hidden_effect.catalogue import named
from tests.hidden_effect.draw import CannotHideError, Hidden, draw
from tests.hidden_effect.judge import NOMINAL, UNKNOWN, Judged

SPAN_MIN, TRAINING_MIN, LATEST = 300.0, 60.0, 0.65
"""Length of a record and of its training; latest onset as a share of the span."""

SET = 0.9
TRIES = 200


@dataclass(frozen=True)
class SuspectsJudged:
    """Suspects of one alarm."""

    truth: str  # name of the hidden cause
    nearly: bool  # whether the plant is not quite the model
    first_probability: float  # probability of the first suspect
    first: bool  # whether it is the hidden cause
    in_set: bool  # whether the hidden cause is in the smallest set with 90 %


def judge_suspects(job: tuple[int, bool, int]) -> SuspectsJudged | None:
    """Draw a record of a number, watch it, and judge the last suspects; None if no alarm has any."""
    number, nearly, first_seed = job
    hidden = _draw(number, nearly, first_seed)
    found = rw.backtest(hidden.record, "cstr", training_min=TRAINING_MIN)
    suspects = next((alarm.suspect for alarm in reversed(found.alarms) if alarm.suspect), None)
    if suspects is None:
        return None
    (truth,) = hidden.causes
    ordered = sorted(((item.probability, item.cause) for item in suspects), reverse=True)
    before = np.cumsum([0.0, *(probability for probability, _ in ordered[:-1])])
    in_set = {cause for (_, cause), total in zip(ordered, before.tolist(), strict=True) if total < SET}
    probability, cause = ordered[0]
    return SuspectsJudged(truth, nearly, probability, cause == truth, truth in in_set)


def _draw(number: int, nearly: bool, first_seed: int) -> Hidden:
    """A record with a step of a cause that the monitor compares, after the training."""
    reactor = find_process().model
    assert reactor is not None
    traced = {effect.name for effect in causes_of(reactor)}
    effects = [effect for effect in named() if effect.name in traced and "step" in effect.courses]
    effect = effects[number % len(effects)]
    circumstances = replace(find_class(NEARLY if nearly else "medium").circumstances(number), span_min=SPAN_MIN)
    for turn in range(TRIES):
        try:
            hidden = draw(first_seed + 1000 * number + turn, (effect,), circumstances, ("step",))
        except CannotHideError:
            continue
        if TRAINING_MIN + 10.0 < hidden.courses[0].onset_min < LATEST * SPAN_MIN:
            return hidden
    raise CannotHideError(f"seed {first_seed}: no step of {effect.name} after the training")


INTERVALS = (0.5, 0.8, 0.9, 0.95)
BINS = (0.0, 0.5, 0.8, 0.95, 1.0)


def percent(flags: Iterable[bool]) -> str:
    """Share of the true ones as a percentage with its 95 % interval (Wilson 1927); a dash of none."""
    values = list(flags)
    if not values:
        return "–"
    low, high = binomtest(sum(values), len(values)).proportion_ci(method="wilson")
    return f"{100.0 * sum(values) / len(values):.1f} ({100.0 * low:.0f}–{100.0 * high:.0f})"


def quantiles(values: Iterable[float], digits: int = 2, share: float = 0.9, factor: float = 1.0) -> str:
    """The median and another quantile, each a value that occurred; what is not a number counts as infinite."""
    found = [value if isfinite(value) else inf for value in values]
    if not found:
        return "–"
    both = np.quantile(found, (0.5, share), method="inverted_cdf")
    return " / ".join(f"{factor * value:.{digits}f}" for value in both.tolist())


def score(judged: Sequence[Judged]) -> dict[str, str]:
    """Cells of the main table for some records, by the title of their column."""
    ended = [item for item in judged if not item.remark]
    drawn = [item for item in ended if not isnan(item.drawn)]
    profiles = [pair for item in judged if item.first for pair in zip(item.courses, item.profiles, strict=True)]
    return {
        "n": str(len(judged)),
        "first %": percent(item.first for item in judged),
        "listed %": percent(item.listed for item in judged),
        "list": f"{np.mean([item.count for item in ended]):.2f}" if ended else "–",
        "wrong %": percent(item.wrong for item in judged),
        "unknown %": percent(item.verdict == UNKNOWN for item in judged),
        "unknown, in place %": percent(item.verdict == UNKNOWN and item.right_place for item in judged),
        "place %": percent(item.right_place for item in judged),
        "profile %": percent(course == profile for course, profile in profiles),
        "size error %, median / 90 %": quantiles((e for item in judged for e in item.size_errors), factor=100.0),
        "in 95 % interval %": percent(inside for item in judged for inside in item.size_inside),
        "curve error %": quantiles((e for item in judged for e in item.curve_errors), 1, factor=100.0),
        "onset error min": quantiles(e for item in judged for e in item.onset_errors),
        "in interval %": percent(inside for item in judged for inside in item.onset_inside),
        "held-out T / noise drawn": quantiles((item.held_out / item.drawn for item in drawn), 3),
        "/ its sd": quantiles((item.held_out for item in ended), 3),
        "the truth's": quantiles((item.drawn for item in drawn), 3),
        "before": quantiles((item.before for item in ended), 1),
        "seconds of a core, median / most": quantiles((item.seconds for item in judged), 1, share=1.0),
        "errors": str(sum(bool(item.remark) for item in judged)),
    }


def confusion(judged: Sequence[Judged]) -> list[tuple[str, list[tuple[str, int]]]]:
    """Names given to each truth, the most frequent first."""
    called: dict[str, Counter[str]] = {}
    for item in judged:
        called.setdefault("+".join(item.truth) or NOMINAL, Counter())[item.called] += 1
    return [(truth, counts.most_common()) for truth, counts in called.items()]


def main_table(found: Mapping[str, Sequence[Judged]]) -> str:
    """A row for each class, each group of classes of which all are there, and all in which causes are hidden."""
    groups = {name: [name] for name in found}
    for group in dict.fromkeys(item.group for item in CLASSES if item.group):
        members = [item.name for item in CLASSES if item.group == group]
        if all(name in found for name in members):
            groups[group] = members
    hidden = [item.name for item in CLASSES if item.kind in ("single", "pair") and item.name in found]
    if len(hidden) > 1:
        groups["all with one cause or two"] = hidden
    scores = {name: score([item for member in members for item in found[member]]) for name, members in groups.items()}
    rows = [[name, *cells.values()] for name, cells in scores.items()]
    return markdown(["records", *score([])], rows)


def confusion_table(found: Mapping[str, Sequence[Judged]], kinds: Sequence[str] = ("single", "nominal")) -> str:
    """Names given to each cause, over all classes with single hidden causes, or none."""
    judged = [item for study in CLASSES if study.kind in kinds for item in found.get(study.name, ())]
    rows = []
    for truth, called in confusion(judged):
        total = sum(count for _, count in called)
        right = dict(called).get(truth, 0)
        others = ", ".join(f"{name} {count}" for name, count in called if name != truth)
        rows.append([truth, str(total), str(right), others])
    return markdown(["hidden", "n", "called so", "called otherwise"], rows)


def failures(found: Mapping[str, Sequence[Judged]]) -> list[str]:
    """A line for each record in which exactly what is hidden was not named; or, where it has no name, not its place."""
    nameless = {study.name for study in CLASSES if study.kind == "outside"}
    lines = []
    for name, judged in found.items():
        for item in judged:
            if item.first or (name in nameless and item.verdict == UNKNOWN and item.right_place):
                continue
            truth = ", ".join(
                f"{cause} {course} {size:.4g}"
                for cause, course, size in zip(item.truth, item.courses, item.sizes, strict=True)
            )
            said = ", ".join(f"{cause} {profile}" for cause, profile in zip(item.said, item.profiles, strict=True))
            rivals = f"; also {', '.join(item.alternatives)}" if item.alternatives else ""
            place = f" ({item.location})" if item.location else ""
            told = item.remark or f"{item.verdict} {said}{place}{rivals}"
            lines.append(
                f"{name}, seed {item.seed}: {truth or 'nothing'} (strength {item.strength:.3g}) -> {told}"
                f"{' [listed]' if item.listed else ''}"
            )
    return lines


def reliability_table(found: Mapping[str, Sequence[Judged]], suspects: Sequence[SuspectsJudged] = ()) -> str:
    """Table of what was stated and how often it was right, as Markdown."""
    rows = []
    for title, judged in _groups(found).items():
        scores = [score for item in judged for score in item.size_scores]
        onsets = [score for item in judged for score in item.onset_scores]
        for what, values in (("size", scores), ("onset of a step", onsets)):
            for level in INTERVALS if values else ():
                inside = percent(value <= float(ndtri(0.5 + 0.5 * level)) for value in values)
                rows.append([title, f"{what} in its interval", f"{100 * level:.0f}", inside])
        named = [item for item in judged if item.verdict not in (NOMINAL, UNKNOWN) and not item.remark]
        rows += _bins(title, "verdict", [(item.probability, item.first) for item in named])
        if named:
            held = percent(set(item.truth) <= set(item.said) for item in named)
            rows.append([title, "hidden cause among those named", "–", held])
    for nearly in (False, True):
        of_kind = [item for item in suspects if item.nearly is nearly]
        name = NEARLY if nearly else "the model itself"
        rows += _bins(name, "first suspect", [(item.first_probability, item.first) for item in of_kind])
        if of_kind:
            inside = percent(item.in_set for item in of_kind)
            rows.append([name, "cause in the set of suspects", f"{100 * SET:.0f}", inside])
    return markdown(["records", "stated", "with %", "right %"], rows)


def _groups(found: Mapping[str, Sequence[Judged]]) -> dict[str, list[Judged]]:
    """Records with one cause, of the model itself and of plants that are not quite it."""
    groups: dict[str, list[Judged]] = {}
    for study in CLASSES:
        if study.kind == "single" and study.name in found:
            name = NEARLY if study.name == NEARLY else "the model itself"
            groups.setdefault(name, []).extend(found[study.name])
    return groups


def _bins(name: str, what: str, stated: Iterable[tuple[float, bool]]) -> list[list[str]]:
    """A row for each range of stated probabilities."""
    items, rows = list(stated), []
    for low, high in pairwise(BINS):
        inside = [(p, right) for p, right in items if low < p <= high]
        if inside:
            mean = float(np.mean([p for p, _ in inside]))
            rows.append([name, what, f"{100 * mean:.0f}", percent(right for _, right in inside)])
    return rows
