"""Scores of judged records, and the tables of the study.

Reliability is how often what is stated with a probability is right. Of sizes and onsets, an interval of a probability
holds the truth in this share of the records. Of verdicts, the best explanation has the probability exp(0) over the sum
of exp(-BIC difference / 2) of all listed ones. Of the monitor's suspects, the smallest set whose probabilities sum to
90 % holds the truth in at least 90 % of the alarms.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import isfinite, isnan, nan, sqrt

import numpy as np
from scipy.special import ndtri

import reactorwatch as rw
from benchmarks.harness.study import markdown
from benchmarks.hidden.classes import CLASSES, NEARLY, find_class
from monitor_node.causes.isolation import causes_of
from reactorwatch.description.read import find_process
from tests.hidden_effect.catalogue import named
from tests.hidden_effect.draw import CannotHideError, Hidden, draw
from tests.hidden_effect.judge import NOMINAL, UNKNOWN, WIDTH, Judged

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


Cell = Callable[["Score"], str]
INTERVALS = (0.5, 0.8, 0.9, 0.95)
BINS = (0.0, 0.5, 0.8, 0.95, 1.0)


class Share(float):
    """A share with the number of which it is one, so that its interval is known."""

    count: int

    @classmethod
    def of(cls, found: Iterable[bool]) -> "Share":
        """Share of the true ones; NaN of none."""
        values = [float(item) for item in found]
        result = cls(np.mean(values) if values else nan)
        result.count = len(values)
        return result

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval (Wilson 1927, J. American Statistical Association 22)."""
        n, z = self.count, WIDTH
        middle = (self + z * z / (2.0 * n)) / (1.0 + z * z / n)
        half = z / (1.0 + z * z / n) * sqrt(self * (1.0 - self) / n + z * z / (4.0 * n * n))
        return max(middle - half, 0.0), min(middle + half, 1.0)


@dataclass(frozen=True)
class Score:
    """Scores of some records; shares from 0 to 1, NaN without a denominator."""

    records: int  # number of records
    first: float  # share in which exactly the hidden causes are named
    listed: float  # share in which they are named or listed
    count: float  # mean number of listed explanations
    wrong: float  # share with a false claim
    unknown: float  # share called unknown
    unknown_in_place: float  # share called unknown with the right location
    right_place: float  # share with the right location, whatever the name
    same_profile: float  # share of the right causes with the right profile
    size: tuple[float, float]  # median and 90 % quantile of the relative error of the size
    curve: tuple[float, float]  # median and 90 % quantile of the relative error of the curve
    size_inside: float  # share of the 95 % intervals that contain the size
    onset: tuple[float, float]  # median and 90 % quantile of the error of a step's onset, in min
    onset_inside: float  # share of the 95 % intervals that contain the onset
    held_out: tuple[float, float]
    held_out_in_sd: tuple[float, float]  # error of T on held-out rows over the standard deviation of the noise
    drawn_in_sd: tuple[float, float]  # error of the truth on held-out rows over the standard deviation of the noise
    before: tuple[float, float]  # error of the nominal model over the standard deviation of the noise, as `held_out`
    seconds: tuple[float, float]  # median and maximum of the core seconds
    errors: int  # number of diagnoses that failed

    @classmethod
    def of(cls, judged: Sequence[Judged]) -> "Score":
        """The score of some records."""
        ended = [item for item in judged if not item.remark]
        right = [(course, profile) for item in judged if item.first for course, profile in _courses(item)]
        return cls(
            records=len(judged),
            first=Share.of(item.first for item in judged),
            listed=Share.of(item.listed for item in judged),
            count=_mean([item.count for item in ended]),
            wrong=Share.of(item.wrong for item in judged),
            unknown=Share.of(item.verdict == UNKNOWN for item in judged),
            unknown_in_place=Share.of(item.verdict == UNKNOWN and item.right_place for item in judged),
            right_place=Share.of(item.right_place for item in judged),
            same_profile=Share.of(course == profile for course, profile in right),
            size=_two([error for item in judged for error in item.size_errors], 0.9),
            curve=_two([error for item in judged for error in item.curve_errors], 0.9),
            size_inside=Share.of(inside for item in judged for inside in item.size_inside),
            onset=_two([error for item in judged for error in item.onset_errors], 0.9),
            onset_inside=Share.of(inside for item in judged for inside in item.onset_inside),
            held_out=_two([item.held_out / item.drawn for item in ended if not isnan(item.drawn)], 0.9),
            held_out_in_sd=_two([item.held_out for item in ended], 0.9),
            drawn_in_sd=_two([item.drawn for item in ended if not isnan(item.drawn)], 0.9),
            before=_two([item.before for item in ended], 0.9),
            seconds=_two([item.seconds for item in judged], 1.0),
            errors=sum(bool(item.remark) for item in judged),
        )


def confusion(judged: Sequence[Judged]) -> list[tuple[str, list[tuple[str, int]]]]:
    """Names given to each truth, the most frequent first."""
    called: dict[str, Counter[str]] = {}
    for item in judged:
        called.setdefault("+".join(item.truth) or NOMINAL, Counter())[item.called] += 1
    return [(truth, counts.most_common()) for truth, counts in called.items()]


def _courses(item: Judged) -> Iterable[tuple[str, str]]:
    return zip(item.courses, item.profiles, strict=True)


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else nan


def _two(values: Sequence[float], share: float) -> tuple[float, float]:
    """The median and another quantile; what is not a number counts as infinite."""
    if not values:
        return nan, nan
    sorted_up = np.sort(np.where(np.isfinite(values), values, np.inf))
    places = [max(int(np.ceil(item * sorted_up.size)) - 1, 0) for item in (0.5, share)]
    return float(sorted_up[places[0]]), float(sorted_up[places[1]])


def percent(share: float) -> str:
    """A share as a percentage, with its 95 % interval if the number is known; a dash if there is nothing."""
    if isnan(share):
        return "–"
    low, high = share.interval if isinstance(share, Share) else (nan, nan)
    return f"{100.0 * share:.1f}" + ("" if isnan(low) else f" ({100.0 * low:.0f}–{100.0 * high:.0f})")


def number(value: float, digits: int = 2) -> str:
    """A number; a dash if there is none."""
    return "–" if isnan(value) else f"{value:.{digits}f}" if isfinite(value) else "inf"


def both(values: tuple[float, float], digits: int = 2, factor: float = 1.0) -> str:
    """Two numbers."""
    return "–" if isnan(values[0]) else " / ".join(number(factor * value, digits) for value in values)


COLUMNS: tuple[tuple[str, Cell], ...] = (
    ("n", lambda score: str(score.records)),
    ("first %", lambda score: percent(score.first)),
    ("listed %", lambda score: percent(score.listed)),
    ("list", lambda score: number(score.count)),
    ("wrong %", lambda score: percent(score.wrong)),
    ("unknown %", lambda score: percent(score.unknown)),
    ("unknown, in place %", lambda score: percent(score.unknown_in_place)),
    ("place %", lambda score: percent(score.right_place)),
    ("profile %", lambda score: percent(score.same_profile)),
    ("size error %, median / 90 %", lambda score: both(score.size, factor=100.0)),
    ("in 95 % interval %", lambda score: percent(score.size_inside)),
    ("curve error %", lambda score: both(score.curve, 1, factor=100.0)),
    ("onset error min", lambda score: both(score.onset)),
    ("in interval %", lambda score: percent(score.onset_inside)),
    ("held-out T / noise drawn", lambda score: both(score.held_out, 3)),
    ("/ its sd", lambda score: both(score.held_out_in_sd, 3)),
    ("the truth's", lambda score: both(score.drawn_in_sd, 3)),
    ("before", lambda score: both(score.before, 1)),
    ("seconds of a core, median / most", lambda score: both(score.seconds, 1)),
    ("errors", lambda score: str(score.errors)),
)


def rows_of(found: Mapping[str, Sequence[Judged]]) -> list[list[str]]:
    """A row for each class, each group of classes of which all are there, and all in which causes are hidden."""
    rows = [[name, *(cell(Score.of(judged)) for _, cell in COLUMNS)] for name, judged in found.items()]
    for group in dict.fromkeys(item.group for item in CLASSES if item.group):
        members = [item.name for item in CLASSES if item.group == group]
        if all(name in found for name in members):
            together = Score.of([item for name in members for item in found[name]])
            rows.append([group, *(cell(together) for _, cell in COLUMNS)])
    hidden = [item.name for item in CLASSES if item.kind in ("single", "pair") and item.name in found]
    if len(hidden) > 1:
        together = Score.of([item for name in hidden for item in found[name]])
        rows.append(["all with one cause or two", *(cell(together) for _, cell in COLUMNS)])
    return rows


def main_table(found: Mapping[str, Sequence[Judged]]) -> str:
    """Main table as Markdown."""
    heading = ["records", *(title for title, _ in COLUMNS)]
    return markdown(heading, rows_of(found))


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
                inside = Share.of(value <= float(ndtri(0.5 + 0.5 * level)) for value in values)
                rows.append([title, f"{what} in its interval", f"{100 * level:.0f}", percent(inside)])
        named = [item for item in judged if item.verdict not in (NOMINAL, UNKNOWN) and not item.remark]
        rows += _bins(title, "verdict", [(item.probability, item.first) for item in named])
        if named:
            held = Share.of(set(item.truth) <= set(item.said) for item in named)
            rows.append([title, "hidden cause among those named", "–", percent(held)])
    for nearly in (False, True):
        of_kind = [item for item in suspects if item.nearly is nearly]
        name = NEARLY if nearly else "the model itself"
        rows += _bins(name, "first suspect", [(item.first_probability, item.first) for item in of_kind])
        if of_kind:
            inside = Share.of(item.in_set for item in of_kind)
            rows.append([name, "cause in the set of suspects", f"{100 * SET:.0f}", percent(inside)])
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
            rows.append([name, what, f"{100 * mean:.0f}", percent(Share.of(right for _, right in inside))])
    return rows
