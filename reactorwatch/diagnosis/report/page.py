"""A diagnosis as one self-contained page without scripts, readable in light and dark mode."""

import re
from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import PurePath
from shlex import quote

import jinja2

from reactorwatch import html
from reactorwatch.diagnosis.difference import Difference
from reactorwatch.diagnosis.report import mathml, panels
from reactorwatch.diagnosis.report.equations import Equation, balances, meanings
from reactorwatch.diagnosis.result import AMBIGUOUS, NOMINAL, Cause, Diagnosis, Experiment
from reactorwatch.diagnosis.whiteness import WHITE
from reactorwatch.process import DEFAULT_PROCESS
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import FREE_NAME, PROFILES
from reactorwatch.sentences.diagnosis import (
    acts_alike,
    describe_best_place,
    describe_causes,
    describe_difference,
    describe_parameter,
    describe_place,
    describe_remaining,
    describe_rival,
    describe_size,
    describe_timing,
    describe_verdict,
    describe_weight,
    law_rows,
    list_corrections,
    nearest_causes,
)
from reactorwatch.sentences.numbers import format_interval, odds, percent

PRINTED = 80
"""Signs of an equation that fit on a line of A4 in 11 pt, as Chromium draws them."""

_PAGES = jinja2.Environment(
    loader=jinja2.PackageLoader("reactorwatch.diagnosis", "report"),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def as_page(
    diagnosis: Diagnosis,
    model: ProcessModel,
    effects: Sequence[Effect],
    file: str,
    model_file: str,
    experiment_file: str = "experiment.csv",
    *,
    on_the_bus: bool = True,
    origin: Mapping[str, str] | None = None,
) -> str:
    """Page as HTML.

    Args:
        diagnosis: diagnosis with its curves.
        model: process model that was diagnosed.
        effects: the catalogue.
        file: name of the record as given.
        model_file: name of the extended model's file.
        experiment_file: name of the proposed input's file.
        on_the_bus: true if there are nodes that could use the model.
        origin: when and from what the page was made, by name; None: not stated.

    Raises:
        ValueError: the diagnosis has no curves.
    """
    catalogue = {effect.name: effect for effect in effects}
    causing = [catalogue[cause.cause] for cause in diagnosis.causes]
    rivals: list[tuple[tuple[Cause, ...], str]] = []
    if diagnosis.verdict == AMBIGUOUS:
        best = describe_weight(diagnosis.causes[0]) if diagnosis.with_nuisance else "the best"
        others = [(item.explanation, describe_rival(item, diagnosis)) for item in diagnosis.alternatives]
        rivals = [(diagnosis.causes, best), *others]
    return _PAGES.get_template("page.html.j2").render(
        diagnosis=diagnosis,
        file=file,
        verdict=describe_verdict(diagnosis, are_listed=True),
        place="" if diagnosis.verdict == NOMINAL else describe_best_place(diagnosis),
        alternatives=rivals,
        weight=describe_weight(diagnosis.causes[0]) if diagnosis.causes and isfinite(diagnosis.causes[0].share) else "",
        twins=[] if rivals else [item for item in diagnosis.alternatives if acts_alike(item)],
        remaining=[(name, describe_remaining(item)) for name, item in diagnosis.remaining.items()],
        corrections=list_corrections(diagnosis),
        nearest=nearest_causes(diagnosis),
        percent=percent,
        odds=odds,
        where=describe_place,
        when=describe_timing,
        size=lambda cause: describe_size(cause, effects),
        course=lambda name: next((item.meaning for item in PROFILES if item.name == name), name),
        numbers=lambda cause: _parameters(cause, effects),
        parameter=describe_parameter,
        meanings=meanings(causing),
        equations=[_wrap(equation) for equation in balances(model, causing)],
        style=html.style(),
        figure=html.figure,
        outputs=panels.outputs(diagnosis, model),
        closer=panels.closer(diagnosis, model) if diagnosis.causes else [],
        courses=panels.courses(diagnosis),
        unknown=panels.unknown_course(diagnosis),
        law=panels.law(diagnosis),
        law_rows=[] if diagnosis.law is None else law_rows(diagnosis.law),
        extended=diagnosis.is_extended,
        is_compared=diagnosis.is_extended or diagnosis.with_nuisance,
        residuals=panels.residuals(diagnosis, model),
        differences=[
            (f"{name} differs {describe_difference(item)}.", _strips(item))
            for name, item in diagnosis.differences.items()
        ],
        white=WHITE,
        evidence=_evidence(diagnosis, effects),
        experiment=[] if diagnosis.experiment is None else panels.experiment(diagnosis.experiment, model),
        experiment_file=experiment_file,
        experiment_command=_experiment_command(diagnosis.experiment, experiment_file, model.name),
        model_file=model_file,
        commands=_commands(file, model_file, on_the_bus=on_the_bus),
        origin=origin,
        error=lambda value: f"{value:.3g}" if isfinite(value) else "ran away",
    )


def _wrap(equation: Equation) -> tuple[list[str], float]:
    """Terms of an equation, between which it wraps, and the size of its text in print at which the longest fits."""
    first, *terms = mathml.wrappable(equation.right)
    parts = [f"{equation.left}<mo>=</mo>{first}" if equation.left else first, *terms]
    longest = max(len(re.sub("<[^>]*>", "", part)) for part in parts)
    return parts, min(1.0, PRINTED / longest)


def _parameters(cause: Cause, effects: Sequence[Effect]) -> list[tuple[str, str]]:
    """Parameters of a cause, each with its name; a curve is better seen than read."""
    size = f"{describe_size(cause, effects)}; m = {format_interval(cause.parameters['size'])}"
    return [
        (name.replace("_", " "), size if name == "size" else format_interval(item))
        for name, item in cause.parameters.items()
        if cause.profile != FREE_NAME or name == "size"
    ]


def _strips(item: Difference) -> list[tuple[str, list[tuple[str, str, int]]]]:
    """Ranges by axis, each with its error and a shade from 0 (noise) to 100 (the worst)."""
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
    if diagnosis.with_nuisance:
        return [
            (describe_causes([(item.cause, item.profile)], effects), describe_weight(item))
            for item in diagnosis.nearest
        ]
    if not diagnosis.is_extended:
        return [("the simulation as it is", "the best")]
    best = describe_causes([(cause.cause, cause.profile) for cause in diagnosis.causes], effects)
    best = best or "the law"
    rows = [(best, "the best")]
    rows += [(describe_causes(item.causes, effects), odds(item.delta_bic)) for item in diagnosis.alternatives]
    return [*rows, ("the simulation as it was", odds(diagnosis.gain.delta_bic))]


def _experiment_command(experiment: Experiment | None, experiment_file: str, process: str) -> str:
    if experiment is None:
        return ""
    named = "" if process == DEFAULT_PROCESS else f" --process {quote(process)}"
    return f"reactorwatch plant{named} --scenario {quote(experiment_file)} --duration {experiment.span_min:g}"


def _commands(file: str, model_file: str, *, on_the_bus: bool) -> list[str]:
    record, extended = quote(file), quote(model_file)
    simulated = quote(f"{PurePath(file).stem}-simulated.csv")
    nodes = [f"reactorwatch {node} --model {extended}" for node in ("monitor", "plant")]
    return [
        f"reactorwatch simulate {record} -o {simulated} --model {extended}",
        f"reactorwatch diagnose {record} --model {extended}",
        *(nodes if on_the_bus else []),
    ]
