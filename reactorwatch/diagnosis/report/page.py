"""A diagnosis as one page: self-contained, without a script, readable on a light and on a dark ground."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import PurePath
from shlex import quote

import jinja2

from reactorwatch.diagnosis.difference import Difference
from reactorwatch.diagnosis.report import pictures
from reactorwatch.diagnosis.report.equations import balances, meanings
from reactorwatch.diagnosis.report.words import (
    adjusted_said,
    causes_said,
    difference_said,
    place,
    place_of,
    size_said,
    verdict,
    when,
    with_interval,
)
from reactorwatch.diagnosis.result import AMBIGUOUS, NOMINAL, Cause, Diagnosis, Experiment
from reactorwatch.diagnosis.whiteness import WHITE
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import FREE_NAME, PROFILES

_PAGES = jinja2.Environment(
    loader=jinja2.PackageLoader("reactorwatch.diagnosis", "report"),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


@dataclass(frozen=True)
class _CauseSaid:
    name: str
    profile: str
    label: str
    place: str
    size: str
    when: str
    symbol: str
    course: str
    parameters: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class _RivalRow:
    label: str
    place: str
    size: str
    when: str


def as_page(
    diagnosis: Diagnosis,
    model: ProcessModel,
    effects: Sequence[Effect],
    file: str,
    model_file: str,
    experiment_file: str = "experiment.csv",
    *,
    on_the_bus: bool = True,
) -> str:
    """The page, as HTML.

    Args:
        diagnosis: with its curves.
        model: that was diagnosed.
        effects: the catalogue.
        file: of the record, as it was named.
        model_file: of the extended model.
        experiment_file: of the proposed input.
        on_the_bus: whether there are nodes that could take it.

    Raises:
        ValueError: the diagnosis has no curves.
    """
    catalogue = {effect.name: effect for effect in effects}
    found = [catalogue[cause.cause] for cause in diagnosis.causes]
    meant = meanings(found)
    return _PAGES.get_template("page.html.j2").render(
        diagnosis=diagnosis,
        file=file,
        verdict=verdict(diagnosis, effects),
        place=place(diagnosis) if diagnosis.verdict != NOMINAL else "",
        causes=[
            _said(diagnosis, effects, cause, item.symbol) for cause, item in zip(diagnosis.causes, meant, strict=True)
        ],
        rivals=_rivals(diagnosis, effects) if diagnosis.verdict == AMBIGUOUS else [],
        parameters=[(name, adjusted_said(item)) for name, item in diagnosis.parameters.items()],
        meanings=meant,
        equations=balances(model, found),
        outputs=pictures.outputs(diagnosis, model),
        closer=pictures.closer(diagnosis, model) if diagnosis.causes else [],
        courses=pictures.courses(diagnosis),
        unknown=pictures.unknown_course(diagnosis),
        residuals=pictures.residuals(diagnosis, model),
        differences=[(difference_said(name, item), _strips(item)) for name, item in diagnosis.differences.items()],
        white=WHITE,
        evidence=_evidence(diagnosis, effects),
        experiment=[] if diagnosis.experiment is None else pictures.experiment(diagnosis.experiment, model),
        apart=[] if diagnosis.experiment is None else _apart(diagnosis.experiment),
        experiment_file=experiment_file,
        experiment_command=_experiment_command(diagnosis.experiment, experiment_file),
        model_file=model_file,
        commands=_commands(file, model_file, on_the_bus=on_the_bus),
        error=lambda value: f"{value:.3g}" if isfinite(value) else "ran away",
    )


def _rivals(diagnosis: Diagnosis, effects: Sequence[Effect]) -> list[tuple[list[_RivalRow], str]]:
    """All explanations that the record does not tell apart, and by how much each is worse than the first."""
    explanations = [(diagnosis.causes, 0.0), *((item.explanation, item.delta_bic) for item in diagnosis.alternatives)]
    return [
        (
            [_RivalRow(item.label, place_of(item.location), size_said(item, effects), when(item)) for item in causes],
            f"{worse:.1f}",
        )
        for causes, worse in explanations
    ]


def _said(diagnosis: Diagnosis, effects: Sequence[Effect], cause: Cause, symbol: str) -> _CauseSaid:
    profile = next((item for item in PROFILES if item.name == cause.profile), None)
    return _CauseSaid(
        cause.cause,
        cause.profile,
        cause.label,
        place_of(cause.location),
        size_said(cause, effects),
        when(cause, diagnosis.curves),
        symbol,
        cause.profile if profile is None else profile.meaning,
        tuple(
            (name.replace("_", " "), f"{size_said(cause, effects)}; m = {with_interval(item)}")
            if name == "size"
            else (name.replace("_", " "), with_interval(item))
            for name, item in cause.parameters.items()
            if cause.profile != FREE_NAME or name == "size"  # a curve is better seen than read
        ),
    )


def _strips(item: Difference) -> list[tuple[str, list[tuple[str, str, int]]]]:
    """By axis: each range, the error in it, and how dark it is, from 0 (noise) to 100 (the worst)."""
    ranges = [part for parts in item.along.values() for part in parts]
    most = max((part.rmse for part in ranges), default=0.0) - item.noise_sd
    return [
        (
            axis,
            [
                (
                    f"{part.lower:.4g} – {part.upper:.4g}",
                    f"{part.rmse:.3g}",
                    round(100 * min(max((part.rmse - item.noise_sd) / max(most, item.noise_sd), 0.0), 1.0)),
                )
                for part in parts
            ],
        )
        for axis, parts in item.along.items()
    ]


def _evidence(diagnosis: Diagnosis, effects: Sequence[Effect]) -> list[tuple[str, str]]:
    if not diagnosis.causes:
        return [("the simulation as it is", "0")]
    best = causes_said([(cause.cause, cause.profile) for cause in diagnosis.causes], effects)
    rows = [(best, "0")]
    rows += [(causes_said(item.causes, effects), f"{item.delta_bic:.1f}") for item in diagnosis.alternatives]
    return [*rows, ("the simulation as it was", f"{diagnosis.gain.delta_bic:,.1f}")]


def _apart(experiment: Experiment) -> list[tuple[str, str, str]]:
    return [
        (" or ".join(item.between), f"{item.expected_delta_bic:.1f}", _percent(item.probability))
        for item in experiment.apart
    ]


def _percent(share: float) -> str:
    return "over 99 %" if share > 0.99 else f"{100.0 * share:.0f} %"


def _experiment_command(experiment: Experiment | None, experiment_file: str) -> str:
    if experiment is None:
        return ""
    return f"reactorwatch plant --scenario {quote(experiment_file)} --duration {experiment.span_min:g}"


def _commands(file: str, model_file: str, *, on_the_bus: bool) -> list[str]:
    record, extended = quote(file), quote(model_file)
    simulated = quote(f"{PurePath(file).stem}-simulated.csv")
    nodes = [f"reactorwatch {node} --model {extended}" for node in ("monitor", "plant")]
    return [
        f"reactorwatch simulate {record} -o {simulated} --model {extended}",
        f"reactorwatch diagnose {record} --model {extended}",
        *(nodes if on_the_bus else []),
    ]
