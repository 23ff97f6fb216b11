"""A diagnosis as lines for a terminal."""

from collections.abc import Sequence

from reactorwatch.diagnosis.report.words import (
    describe_difference,
    describe_explanation,
    describe_holdout,
    describe_parameter,
    describe_place,
    describe_size,
    describe_timing,
    describe_verdict,
    law_rows,
)
from reactorwatch.diagnosis.result import AMBIGUOUS, NOMINAL, Diagnosis
from reactorwatch.process.effect import Effect
from reactorwatch.terminal import printable_lines

INDENT = 14


def as_text(diagnosis: Diagnosis, file: str, effects: Sequence[Effect]) -> str:
    """Verdict, causes with their 95 % intervals, gain, alternatives and remarks.

    Args:
        diagnosis: diagnosis of the file.
        file: name of the file as given.
        effects: the catalogue.
    """
    lines = [f"{file}: {diagnosis.samples} rows over {diagnosis.span_min:g} min", describe_verdict(diagnosis)]
    ambiguous = diagnosis.verdict == AMBIGUOUS
    if ambiguous:
        lines += [_line("either", f"{describe_explanation(diagnosis.causes, effects)}  (95 %)")]
        lines += _alternatives(diagnosis, effects) + _experiment(diagnosis)
    for cause in () if ambiguous else diagnosis.causes:
        lines += [
            _line("cause", f"{cause.label} ({cause.cause}, {cause.profile})"),
            _line("size", f"{describe_size(cause, effects)}  (95 %)"),
            _line("when", describe_timing(cause, diagnosis.curves)),
        ]
    if len(diagnosis.locations) > 1:
        places = [f"{describe_place(name)} ({worse:.1f})" for name, worse in diagnosis.locations.items()]
        lines.append(_line("where", f"{', '.join(places)}: worse in BIC"))
    if diagnosis.law is not None:
        lines += [_line(name, text) for name, text in law_rows(diagnosis.law)]
    if diagnosis.verdict != NOMINAL:
        lines.append(_line("evidence", f"{diagnosis.gain.delta_bic:,.1f} in BIC over the simulation as it was"))
        lines += [_line("differs", describe_difference(name, item)) for name, item in diagnosis.differences.items()]
    for name, known in diagnosis.parameters.items():
        lines.append(_line("parameter", f"{name} {describe_parameter(known)}  (95 %)"))
    for name, item in diagnosis.gain.held_out.items():
        lines.append(_line("held out", describe_holdout(name, item, improved=diagnosis.is_extended)))
    if not ambiguous:
        lines += _alternatives(diagnosis, effects) + _experiment(diagnosis)
    if diagnosis.causes and not diagnosis.alternatives:
        lines.append(_line("or", "nothing else in the catalogue comes near"))
    lines += [_line("note", remark) for remark in diagnosis.remarks]
    return printable_lines(lines)


def _alternatives(diagnosis: Diagnosis, effects: Sequence[Effect]) -> list[str]:
    return [
        _line("or", f"{describe_explanation(item.explanation, effects)}, worse by {item.delta_bic:.1f} in BIC")
        for item in diagnosis.alternatives
    ]


def _experiment(diagnosis: Diagnosis) -> list[str]:
    return [] if diagnosis.experiment is None else [_line("experiment", diagnosis.experiment.why)]


def _line(key: str, text: str) -> str:
    return f"  {key:<{INDENT - 2}}{text}"
