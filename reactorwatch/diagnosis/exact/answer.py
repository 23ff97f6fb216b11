"""Report of an explanation by the exact equations: causes or law, errors, alternatives, experiment, extended model."""

from collections import defaultdict
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
from msgspec import structs

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.decide import SURE, grade_of
from reactorwatch.diagnosis.estimates import (
    adjusted_parameters,
    convert_to_run_minutes,
    covariances_of,
    extended_model,
    hypothesis_causes,
    refine_parameters,
)
from reactorwatch.diagnosis.exact.explain import Exact
from reactorwatch.diagnosis.experiment.design import propose_experiment
from reactorwatch.diagnosis.fitting.colored_noise import estimate_sensor_noise
from reactorwatch.diagnosis.graded import (
    Weight,
    effect_sizes,
    left_in_tolerances,
    list_causes,
    nearest_of,
    remaining_of,
    separate_corrections,
    weights_of,
)
from reactorwatch.diagnosis.holdout import Errors, evaluate_holdout
from reactorwatch.diagnosis.inexact.answer import onset_of
from reactorwatch.diagnosis.law.describe import describe_law, law_hypothesis
from reactorwatch.diagnosis.practical_significance import (
    curves_of,
    differences_of,
    exceeds_tolerance,
    residual_exceeds_tolerance,
)
from reactorwatch.diagnosis.problem import Problem
from reactorwatch.diagnosis.result import (
    AMBIGUOUS,
    LISTED,
    NAMED,
    NOMINAL,
    UNKNOWN,
    Adequacy,
    Alternative,
    Cause,
    Curves,
    Diagnosis,
    Experiment,
    Gain,
    HeldOut,
    LocationEvidence,
)
from reactorwatch.diagnosis.search.search import FittedHypothesis, SearchResult
from reactorwatch.diagnosis.whiteness import looks_like_integration, minus_log10_p
from reactorwatch.process.effect import TIMING
from reactorwatch.process.law import ExtendedLaw
from reactorwatch.process.model import ProcessModel
from reactorwatch.sentences.numbers import odds


@dataclass(frozen=True, eq=False)
class _Estimated:
    """An explanation with its parameters refined.

    Attributes:
        best: the explanation, with all of its parameters.
        covariances: covariance of the parameters of each cause.
        adequacy: whiteness of its residual, shape (n_y,).
        law: law of the unknown; None: it has none.
        remarks: remarks for the user.
    """

    best: FittedHypothesis
    covariances: Sequence[Array]
    adequacy: Array
    law: ExtendedLaw | None = None
    remarks: tuple[str, ...] = ()


def answer_exactly(exact: Exact, problem: Problem, about_record: Sequence[str]) -> Diagnosis:
    """The diagnosis that an explanation by the exact equations gives.

    Args:
        exact: the explanation.
        problem: the record and what is known of its plant.
        about_record: remarks on the rows of the record.
    """
    model, effects, record, bands = problem.model, problem.effects, problem.record, problem.tolerances
    run, result, verdict, location = exact.search.run, exact.result, exact.verdict, exact.location
    estimated = _estimate(exact, problem)
    best, covariances = estimated.best, estimated.covariances
    remarks = [*about_record, *exact.remarks, *estimated.remarks]

    before, after = evaluate_holdout(run, result.nominal, best)
    curves = curves_of(problem.run, run, model, result.nominal, best, covariances)
    noise_sd = np.maximum(_noise_sd(exact, problem, curves), problem.smallest_sd)
    unexplained = verdict == UNKNOWN and residual_exceeds_tolerance(before, noise_sd, model, bands)
    if (
        verdict == UNKNOWN
        and not unexplained
        and looks_like_integration(problem.plant, run, result.nominal.fit.innovations)
    ):
        location = TIMING
        remarks.append(
            "the residual is small and correlated with the error of an integrator's steps: the record may be computed "
            "by a coarser integrator, or its input be stamped late"
        )
    curves = replace(curves, held_out=dict(zip(model.output_names, after.values.T, strict=True)))
    unknown = exact.unknown
    if unknown is not None and unknown.curve is not None and unknown.location == location:
        curves = replace(curves, unknown=unknown.curve.curve)
    blind = ~np.all(np.isfinite(result.nominal.fit.innovations.prediction), axis=1)

    causes = convert_to_run_minutes(hypothesis_causes(best, covariances), record) if exact.law is None else ()
    sds = None if exact.lasting is None else exact.lasting.sds
    parameters = adjusted_parameters(run, model, problem.uncertain, best, sds)
    adjusted = model.with_values({name: item.estimate.value for name, item in parameters.items()})
    alternatives = alternatives_of(result, best)
    nearest = nearest_of(result, best if exact.law is None else result.nominal)
    listed = list(dict.fromkeys([*nearest, *alternatives]))
    weights = dict(zip(listed, weights_of(listed, result.nominal, run, before, noise_sd), strict=True))
    parts = {
        item: separate_corrections(
            causes if item is best else _causes_of(item, exact, problem),
            effect_sizes(item, run, problem.bands),
            effects,
        )
        for item in listed
    }
    shown, corrections = parts[best] if causes else ((), ())
    weights = _join_weights(weights, {item: _names(parts[item][0]) for item in listed})
    if corrections:
        alternatives = [item for item in alternatives if _names(parts[item][0]) != _names(shown)]
        if verdict == AMBIGUOUS and not any(item.bic - best.bic < SURE for item in alternatives):
            verdict = NAMED
    experiment = _experiment(best, alternatives, exact, problem)
    if isinstance(experiment, str):
        remarks.append(experiment)
        experiment = None
    gain = _gain(model, result.nominal.bic - best.bic, noise_sd, before, after)
    described = (
        None
        if estimated.law is None or unknown is None
        else describe_law(adjusted, run, unknown.found, estimated.law, covariances, gain.held_out)
    )
    worse = unknown.locations if unknown is not None else _locations(best, alternatives, {i.name for i in corrections})
    share = weights[nearest[0]].share if nearest else 0.0
    return Diagnosis(
        file=record.name,
        zero=record.zero,
        samples=run.time_min.size,
        runs=len(record.run_starts),
        span_min=record.span_min,
        seconds=0.0,
        verdict=verdict,
        grade=grade_of(verdict, share, left_in_tolerances(gain.held_out, bands)),
        causes=weights[best].of(shown) if causes else (),
        alternatives=tuple(_alternative(item, weights[item], exact, best.bic, problem) for item in alternatives),
        nearest=list_causes([parts[item][0] for item in nearest], [weights[item] for item in nearest]),
        onset=onset_of(causes),
        nuisance=corrections,
        remaining=remaining_of(gain.held_out, location if verdict == UNKNOWN else None),
        location=location or None,
        locations=tuple(LocationEvidence(name, bic) for name, bic in worse.items()),
        law=described,
        significant=verdict != NOMINAL,
        practical=bool(unexplained or exceeds_tolerance(curves, bands, blind)),
        gain=gain,
        adequacy={
            name: Adequacy(item) for name, item in zip(model.output_names, estimated.adequacy.tolist(), strict=True)
        },
        experiment=experiment,
        extended_model=extended_model(adjusted, effects, causes, record.zero_ns, estimated.law),
        parameters=parameters,
        differences=differences_of(model, noise_sd, curves, bands),
        remarks=tuple(remarks),
        curves=curves,
    )


def _estimate(exact: Exact, problem: Problem) -> _Estimated:
    """Refine the parameters of an explanation."""
    if exact.law is None:
        best, covariances = refine_parameters(exact.search, exact.best)
        return _Estimated(best, covariances, exact.adequacy)
    run, remarks = exact.search.run, list[str]()
    law, best = law_hypothesis(exact.law, run, problem.model, problem.uncertain)
    assert exact.unknown is not None  # whose law it is
    if exact.unknown.approximation > LISTED:
        worse = odds(exact.unknown.approximation)
        remarks.append(f"the law is an approximation: a smooth correction there is better by odds of {worse}")
    adequacy = minus_log10_p(best.fit.w, run.inputs)
    return _Estimated(best, covariances_of(run, best), adequacy, law, tuple(remarks))


def _noise_sd(exact: Exact, problem: Problem, curves: Curves) -> Array:
    """Standard deviation of each sensor's noise, shape (n_y,).

    Where nothing explains the run, a filter takes part of the model error for noise.
    """
    names, noise, run = problem.model.output_names, exact.result.noise, exact.search.run
    if exact.law is not None:
        return exact.law.noise_sd(problem.model)
    if exact.verdict != UNKNOWN:
        return noise.sensor_sd(names)
    simulated = np.column_stack([curves.simulated_before[name] for name in names])
    return estimate_sensor_noise(noise, names, run.measured - simulated, run.measured, run.period_min)


def _causes_of(item: FittedHypothesis, exact: Exact, problem: Problem) -> tuple[Cause, ...]:
    """Causes of a hypothesis, their parameters as fitted."""
    return convert_to_run_minutes(hypothesis_causes(item, covariances_of(exact.search.run, item)), problem.record)


def _names(causes: Sequence[Cause]) -> frozenset[str]:
    return frozenset(item.cause for item in causes)


def _join_weights(
    weights: Mapping[FittedHypothesis, Weight], causes: Mapping[FittedHypothesis, frozenset[str]]
) -> dict[FittedHypothesis, Weight]:
    """Weights by which explanations that differ in small corrections alone are one, and their probabilities a sum."""
    total = defaultdict[frozenset[str], float](float)
    for item, names in causes.items():
        total[names] += weights[item].probability
    return {item: weights[item]._replace(probability=total[names]) for item, names in causes.items()}


def _experiment(
    best: FittedHypothesis, alternatives: Sequence[FittedHypothesis], exact: Exact, problem: Problem
) -> Experiment | str | None:
    """Experiment that would tell the explanations apart; a sentence where there is none, None where it needs none."""
    if not alternatives or exact.law is not None:
        return None
    return propose_experiment(
        [best, *alternatives], exact.search.run, problem.model, exact.result.noise, problem.limits
    )


def _locations(
    best: FittedHypothesis, alternatives: Sequence[FittedHypothesis], corrections: Set[str]
) -> dict[str, float]:
    """BIC of each location of the explanations over that of the best; those of small corrections are left out."""
    result: dict[str, float] = {}
    for item in (best, *alternatives):
        for effect in item.hypothesis.filter.effects:
            if effect.name not in corrections:
                result.setdefault(effect.location, item.bic - best.bic)
    return result


def alternatives_of(result: SearchResult, best: FittedHypothesis) -> list[FittedHypothesis]:
    """Best hypothesis of every other set of causes within `LISTED` of the best."""
    listed: list[FittedHypothesis] = []
    seen = {frozenset(best.hypothesis.causes)}
    if best is result.nominal:
        return []
    for item in result.hypotheses:
        causes = frozenset(item.hypothesis.causes)
        if item.bic < best.bic + LISTED and causes not in seen:
            seen.add(causes)
            listed.append(item)
    return listed


def _alternative(
    item: FittedHypothesis, weight: Weight, exact: Exact, best_bic: float, problem: Problem
) -> Alternative:
    item.hypothesis.filter.noise = exact.result.noise
    refined, covariances = refine_parameters(exact.search, item)
    causes = convert_to_run_minutes(hypothesis_causes(refined, covariances), problem.record)
    return structs.replace(Alternative(causes, item.bic - best_bic), **weight._asdict())


def _gain(model: ProcessModel, delta_bic: float, noise_sd: Array, before: Errors, after: Errors) -> Gain:
    held_out = {
        output.name: HeldOut(
            float(before.simulation[index]),
            float(after.simulation[index]),
            float(before.one_step[index]),
            float(after.one_step[index]),
            float(noise_sd[index]),
            output.unit,
        )
        for index, output in enumerate(model.outputs)
    }
    return Gain(delta_bic, held_out)
