"""The tables of the study, for a terminal and for a page."""

from collections.abc import Callable, Mapping, Sequence
from math import isfinite, isnan, nan

from benchmarks.hidden.classes import CLASSES
from benchmarks.hidden.score import Score, Share, confusion
from reactorwatch.diagnosis.result import UNKNOWN
from tests.hidden_effect.judge import Judged

Cell = Callable[[Score], str]


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


def markdown(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as Markdown, its columns lined up."""
    widths = [max(len(row[place]) for row in [heading, *rows]) for place in range(len(heading))]
    lines = [" | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    head = " | ".join(cell.ljust(width) for cell, width in zip(heading, widths, strict=True))
    rule = "|".join("-" * (width + 2) for width in widths)
    return "\n".join([f"| {head} |", f"|{rule}|", *(f"| {line} |" for line in lines)])
