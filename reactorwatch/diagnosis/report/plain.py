"""A diagnosis as lines for a terminal."""

from collections.abc import Sequence

from reactorwatch.diagnosis.report.words import (
    adjusted_said,
    describe_explanation,
    difference_said,
    error_left,
    size_said,
    verdict,
    when,
)
from reactorwatch.diagnosis.result import AMBIGUOUS, NOMINAL, Diagnosis
from reactorwatch.process.effect import Effect
from reactorwatch.terminal import printable_lines

INDENT = 14


def as_text(diagnosis: Diagnosis, file: str, effects: Sequence[Effect]) -> str:
    """What people read: the verdict, the causes with their 95 % intervals, the gain, the rivals, remarks.

    Args:
        diagnosis: of the file.
        file: as it was named.
        effects: the catalogue.
    """
    lines = [
        f"{file}: {diagnosis.samples} rows over {diagnosis.span_min:g} min",
        verdict(diagnosis, effects),
    ]
    ambiguous = diagnosis.verdict == AMBIGUOUS
    if ambiguous:
        lines += [_line("either", f"{describe_explanation(diagnosis.causes, effects)}  (95 %)")]
        lines += _rivals(diagnosis, effects) + _experiment(diagnosis)
    for cause in () if ambiguous else diagnosis.causes:
        lines += [
            _line("cause", f"{cause.label} ({cause.cause}, {cause.profile})"),
            _line("size", f"{size_said(cause, effects)}  (95 %)"),
            _line("when", when(cause, diagnosis.curves)),
        ]
    if diagnosis.verdict != NOMINAL:
        lines.append(_line("evidence", f"{diagnosis.gain.delta_bic:,.1f} in BIC over the simulation as it was"))
        lines += [_line("differs", difference_said(name, item)) for name, item in diagnosis.differences.items()]
    for name, known in diagnosis.parameters.items():
        lines.append(_line("parameter", f"{name} {adjusted_said(known)}  (95 %)"))
    for name, item in diagnosis.gain.held_out.items():
        lines.append(_line("held out", error_left(name, item, improved=bool(diagnosis.causes))))
    if not ambiguous:
        lines += _rivals(diagnosis, effects) + _experiment(diagnosis)
    if diagnosis.causes and not diagnosis.alternatives:
        lines.append(_line("or", "nothing else in the catalogue comes near"))
    lines += [_line("note", remark) for remark in diagnosis.remarks]
    return printable_lines(lines)


def _rivals(diagnosis: Diagnosis, effects: Sequence[Effect]) -> list[str]:
    return [
        _line("or", f"{describe_explanation(item.explanation, effects)}, worse by {item.delta_bic:.1f} in BIC")
        for item in diagnosis.alternatives
    ]


def _experiment(diagnosis: Diagnosis) -> list[str]:
    return [] if diagnosis.experiment is None else [_line("experiment", diagnosis.experiment.why)]


def _line(what: str, said: str) -> str:
    return f"  {what:<{INDENT - 2}}{said}"
