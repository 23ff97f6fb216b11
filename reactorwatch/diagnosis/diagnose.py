"""Diagnose a simulation from a record and its model."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import replace
from math import inf

import numpy as np
from msgspec import structs

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.decide import (
    LEAST_GAIN,
    SURE,
    Found,
    PlaceFound,
    decide_without_nuisance,
    grade_of,
)
from reactorwatch.diagnosis.estimates import (
    adjusted_parameters,
    convert_to_run_minutes,
    covariances_of,
    extended_model,
    hypothesis_causes,
    refine_parameters,
)
from reactorwatch.diagnosis.experiment.design import propose_experiment
from reactorwatch.diagnosis.experiment.inputs import check_limits
from reactorwatch.diagnosis.fitting.colored_noise import Noise, estimate_sensor_noise
from reactorwatch.diagnosis.fitting.hypothesis import FROM_BEGINNING
from reactorwatch.diagnosis.graded import (
    effect_sizes,
    left_in_tolerances,
    list_causes,
    nearest_of,
    remaining_of,
    separate_corrections,
    weights_of,
    with_nuisance,
)
from reactorwatch.diagnosis.holdout import Errors, evaluate_holdout, is_near_noise
from reactorwatch.diagnosis.inexact.answer import onset_of
from reactorwatch.diagnosis.inexact.explain import explain
from reactorwatch.diagnosis.inexact.nuisance import time_sd_min
from reactorwatch.diagnosis.lasting import LastingResult, prefer_lasting
from reactorwatch.diagnosis.law.describe import describe_law, law_hypothesis
from reactorwatch.diagnosis.law.unknown import NOISY_SHARE, Localised, UnknownSearch
from reactorwatch.diagnosis.parameter_priors import add_priors
from reactorwatch.diagnosis.practical_significance import (
    curves_of,
    differences_of,
    exceeds_tolerance,
    residual_exceeds_tolerance,
    tolerances_of,
)
from reactorwatch.diagnosis.record_checks import (
    describe_outliers,
    describe_short_record,
    describe_still_inputs,
    make_run,
)
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
    Gain,
    HeldOut,
    LocationEvidence,
)
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.noise import search_noise_growth, search_single_cause
from reactorwatch.diagnosis.search.pairs import search_pairs
from reactorwatch.diagnosis.search.screen import Part
from reactorwatch.diagnosis.search.search import FittedHypothesis, Search, SearchResult, smallest_noise
from reactorwatch.diagnosis.whiteness import DOUBTFUL, WHITE, looks_like_integration, minus_log10_p
from reactorwatch.process import effects_of
from reactorwatch.process.effect import TIMING, Effect
from reactorwatch.process.generic import hidden_sources
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import CONSTANT, FREE_NAME
from reactorwatch.process.signal_effects import InputDelay, InputLag, OutputDelay, OutputLag
from reactorwatch.records.record import MAX_SPANS, Record
from reactorwatch.sentences.diagnosis import describe_place
from reactorwatch.sentences.numbers import odds

KEPT_BYTES = 31_000_000


def diagnose(
    record: Record,
    model: ProcessModel,
    effects: Sequence[Effect] | None = None,
    tolerance: Mapping[str, float] | None = None,
    uncertain: Mapping[str, float] | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> Diagnosis:
    """Diagnose the difference between a simulation by the model and a record.

    Args:
        record: record with the model's inputs and outputs as columns.
        model: process model of the simulation.
        effects: effects that may be named; None: the model's own catalogue.
        tolerance: root mean square difference that does not matter in practice, by output, in its unit; by default a
            fiftieth of the output's range.
        uncertain: standard deviations of uncertain parameters of the model, by name, in their units; the others are
            exact, and those of 0 also in the comparison with nuisance. See `reactorwatch.diagnosis.parameter_priors`.
        limits: lowest and highest value allowed in an experiment, by input and output; by default somewhat
            wider than the record.

    Raises:
        InputError: the record cannot be diagnosed; a tolerance is of no output or not positive; an uncertain parameter
            does not exist or its standard deviation is negative or larger than its value; or limits are of no signal,
            not increasing or beyond an input's bounds.
    """
    _keep_memory()
    effects = effects_of(model) if effects is None else effects
    check_limits(model, limits or {})
    whole = make_run(record, model)
    bands = tolerances_of(whole, model, tolerance or {})
    stated = uncertain or {}
    plant = add_priors(model, stated)
    uncertain = {name: sd for name, sd in stated.items() if sd > 0.0}
    hidden = hidden_sources(model, tuple(effects))
    smallest_sd = smallest_noise(model, whole.measured)
    search = Search(plant, (*effects, *hidden), whole, smallest_sd)
    run = search.run
    result = search_single_cause(search)
    if search.adopt_colored_noise(result.best):
        result = search_single_cause(search)
    unknowns = UnknownSearch(model, effects, run, result)
    single = result.best
    if not (np.any(minus_log10_p(single.fit.w, run.inputs) >= DOUBTFUL) and unknowns.is_simple):
        result = search_pairs(search, result)
    result = _drop_hidden(search_noise_growth(search, result), hidden)
    best = result.best if result.nominal.bic - result.best.bic >= LEAST_GAIN else result.nominal
    adequacy = minus_log10_p(best.fit.w, run.inputs)
    found = _search_evidence(result, best, adequacy)
    verdict = decide_without_nuisance(found, None)
    location = best.hypothesis.filter.effects[0].location if best.label else ""
    about_record = [*_describe_record(record), *describe_outliers(whole, run)]
    about_record += describe_still_inputs(model, effects, run.inputs)
    remarks = [*about_record]
    unknown: Localised | None = None
    if verdict == UNKNOWN or not found.is_white or (best.label and _may_be_unknown(result, best, model)):
        white = best.label and verdict != UNKNOWN and found.is_white and not _seems_noisy(result, model)
        unknown = unknowns.localise(best.bic if white else np.inf)
        by_source = verdict == UNKNOWN and found.is_white
        verdict = decide_without_nuisance(found, _place_result(unknown, result, best, run, found.minus_log10_p))
        if verdict == UNKNOWN:
            best = result.nominal
            if not by_source:
                location = unknown.location
        elif unknown.gain_over(best) > -SURE and len(best.label) > 1:
            remarks.append(f"one unknown deviation {describe_place(unknown.location)} explains the record as well")
        else:
            unknown = None
        if unknown is None and np.any(adequacy >= WHITE):
            remarks.append(
                "the residual is small, but not white: the course in time may be rougher than the fitted profile"
            )
    lasting: LastingResult | None = None
    if verdict in (NAMED, AMBIGUOUS) and _may_last(result, best, model, uncertain):
        lasting = prefer_lasting(search, result, best, model, uncertain)
        if lasting is not None:
            result, best, unknown = lasting.result, lasting.result.hypotheses[0], None
            verdict = AMBIGUOUS if len(result.hypotheses) > 1 else NAMED
            adequacy, location = minus_log10_p(best.fit.w, run.inputs), best.hypothesis.filter.effects[0].location
            remarks.append("a lasting cause simulates the rows that were held out better than one that drifts")
    best.hypothesis.filter.noise, result.nominal.hypothesis.filter.noise = result.noise, result.nominal_noise
    law = unknown.law if unknown is not None and verdict == UNKNOWN and unknown.location == location else None
    reported = None
    if law is None:
        best, covariances = refine_parameters(search, best)
    else:
        reported, best = law_hypothesis(law, run, model, uncertain)
        if unknown is not None and unknown.approximation > LISTED:
            better = odds(unknown.approximation)
            remarks.append(f"the law is an approximation: a smooth correction there is better by odds of {better}")
        covariances, adequacy = covariances_of(run, best), minus_log10_p(best.fit.w, run.inputs)
    before, after = evaluate_holdout(run, result.nominal, best)
    curves = curves_of(whole, run, model, result.nominal, best, covariances)
    noise_sd = _noise_sd(result, run, model, curves, verdict) if law is None else law.noise_sd(model)
    noise_sd = np.maximum(noise_sd, smallest_sd)
    unexplained = verdict == UNKNOWN and residual_exceeds_tolerance(before, noise_sd, model, bands)
    if verdict == UNKNOWN and not unexplained and looks_like_integration(plant, run, result.nominal.fit.innovations):
        location = TIMING
        remarks.append(
            "the residual is small and correlated with the error of an integrator's steps: the record may be computed "
            "by a coarser integrator, or its input be stamped late"
        )
    curves = replace(curves, held_out=dict(zip(model.output_names, after.values.T, strict=True)))
    if unknown is not None and unknown.curve is not None and unknown.location == location:
        curves = replace(curves, unknown=unknown.curve.curve)
    blind = ~np.all(np.isfinite(result.nominal.fit.innovations.prediction), axis=1)
    causes = convert_to_run_minutes(hypothesis_causes(best, covariances), record) if law is None else ()
    parameters = adjusted_parameters(run, model, uncertain, best, None if lasting is None else lasting.sds)
    adjusted = model.with_values({name: item.estimate.value for name, item in parameters.items()})
    alternatives, nearest = _alternatives(result, best), nearest_of(result, best if law is None else result.nominal)
    listed, tolerated = list(dict.fromkeys([*nearest, *alternatives])), np.array([bands[i] for i in model.output_names])
    weights = dict(zip(listed, weights_of(listed, result.nominal, run, before, noise_sd), strict=True))
    parts = {
        item: separate_corrections(
            causes if item is best else _causes_of(item, run, record), effect_sizes(item, run, tolerated), effects
        )
        for item in listed
    }
    shown, corrections = parts[best] if causes else ((), ())
    if verdict == AMBIGUOUS and corrections:
        alternatives = [item for item in alternatives if _names(parts[item][0]) != _names(shown)]
        verdict = AMBIGUOUS if any(item.bic - best.bic < SURE for item in alternatives) else NAMED
    experiment = (
        propose_experiment([best, *alternatives], run, model, result.noise, limits or {})
        if alternatives and law is None
        else None
    )
    if isinstance(experiment, str):
        remarks.append(experiment)
        experiment = None
    gain = _gain(model, result.nominal.bic - best.bic, noise_sd, before, after)
    described = (
        None
        if reported is None or unknown is None
        else describe_law(adjusted, run, unknown.found, reported, covariances, gain.held_out)
    )
    worse = unknown.locations if unknown is not None else _locations(best, alternatives, {i.name for i in corrections})
    share = weights[nearest[0]].share if nearest else 0.0
    exact = Diagnosis(
        file=record.name,
        zero=record.zero,
        samples=run.time_min.size,
        runs=len(record.run_starts),
        span_min=record.span_min,
        seconds=0.0,
        verdict=verdict,
        grade=grade_of(verdict, share, left_in_tolerances(gain.held_out, bands)),
        causes=weights[best].of(shown) if causes else (),
        alternatives=tuple(
            structs.replace(_alternative(search, item, result.noise, best.bic, record), **weights[item]._asdict())
            for item in alternatives
        ),
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
        adequacy={name: Adequacy(item) for name, item in zip(model.output_names, adequacy.tolist(), strict=True)},
        experiment=experiment,
        extended_model=extended_model(adjusted, effects, causes, record.zero_ns, reported),
        parameters=parameters,
        differences=differences_of(model, noise_sd, curves, bands),
        remarks=tuple(remarks),
        curves=curves,
    )
    if not _calls_for_nuisance(exact, result, best, model, run):
        return exact
    explained = explain(model, effects, run, _starts(run, result.nominal, model), stated, smallest_sd)
    if explained is None:
        return exact
    answer = with_nuisance(exact, explained, model, effects, record, bands, uncertain)
    about_record += describe_short_record(run, explained.nuisance.size)
    return structs.replace(answer, remarks=tuple(about_record)) if answer.with_nuisance else answer


def _causes_of(item: FittedHypothesis, run: Run, record: Record) -> tuple[Cause, ...]:
    """Causes of a hypothesis, their parameters as fitted."""
    return convert_to_run_minutes(hypothesis_causes(item, covariances_of(run, item)), record)


def _names(causes: Sequence[Cause]) -> set[str]:
    return {item.cause for item in causes}


def _calls_for_nuisance(
    diagnosis: Diagnosis, result: SearchResult, best: FittedHypothesis, model: ProcessModel, run: Run
) -> bool:
    """True if the hypotheses are to be compared with nuisance: nothing simple explains the record to the noise."""
    is_white = all(item.minus_log10_p < DOUBTFUL for item in diagnosis.adequacy.values())
    if diagnosis.verdict == UNKNOWN:
        return diagnosis.practical or diagnosis.law is None or not is_white
    is_pair = len(best.label) > 1
    is_simple = not is_pair and FREE_NAME not in [profile.name for profile in best.hypothesis.profiles]
    if is_pair and all(_is_a_little_late(part, run) for part in best.parts):
        return True  # as clocks and sensors are everywhere
    if is_white:
        return not is_simple and _seems_noisy(result, model)
    return not is_simple or diagnosis.verdict == AMBIGUOUS


def _is_a_little_late(part: Part, run: Run) -> bool:
    """True if a cause is a constant lag or delay within twice the standard deviation of its prior as nuisance."""
    is_lag = isinstance(part.effect, (InputLag, OutputLag))
    most_min = 2.0 * time_sd_min(run, is_lag=is_lag)
    is_time = is_lag or isinstance(part.effect, (InputDelay, OutputDelay))
    return is_time and part.profile.name == CONSTANT.name and float(part.parameters[0]) <= most_min


def _starts(run: Run, nominal: FittedHypothesis, model: ProcessModel) -> Array:
    """States at the first row of each part of a run, by the filter, shape (parts, n_x)."""
    x = nominal.fit.innovations.x[:, : len(model.states)]
    known = np.flatnonzero(np.all(np.isfinite(x), axis=1))
    rows = known[np.minimum(np.searchsorted(known, (0, *run.breaks)), known.size - 1)]
    return np.asarray(x[rows])


def _search_evidence(result: SearchResult, best: FittedHypothesis, adequacy: Array) -> Found:
    """Evidence of a search, for `decide`."""
    others = [item for item in result.hypotheses if item.hypothesis.causes != best.hypothesis.causes]
    close = [item for item in others if item.bic - best.bic < SURE]
    return Found(
        result.nominal.bic - best.bic,
        bool(close),
        bool(best.hypothesis.causes) and all(_is_source(item) for item in (best, *close)),
        len(best.hypothesis.causes),
        float(np.max(adequacy)),
    )


def _place_result(
    unknown: Localised, result: SearchResult, best: FittedHypothesis, run: Run, log_p: float
) -> PlaceFound:
    """Evidence of a search for an unknown, for `decide`."""
    is_near = False
    if best.label and log_p >= WHITE:
        sensor_sd = result.noise.sensor_sd(result.nominal.hypothesis.filter.model.output_names)
        is_near = is_near_noise(evaluate_holdout(run, result.nominal, best)[1], sensor_sd)
    return PlaceFound(unknown.is_better(best), unknown.gain_over(best), is_near)


def _may_be_unknown(result: SearchResult, best: FittedHypothesis, model: ProcessModel) -> bool:
    """Return true if one unknown could explain what the best hypothesis explains with noise, a curve or two causes."""
    profiles = [profile.name for profile in best.hypothesis.profiles]
    from_beginning = all(name in FROM_BEGINNING for name in profiles)
    return _seems_noisy(result, model) or (from_beginning and (len(profiles) > 1 or FREE_NAME in profiles))


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


def _may_last(
    result: SearchResult, best: FittedHypothesis, model: ProcessModel, uncertain: Mapping[str, float]
) -> bool:
    """Return true if the best hypothesis drifts, or has uncertain parameters, and process noise hides its errors."""
    profiles = [profile.name for profile in best.hypothesis.profiles]
    return (profiles != [CONSTANT.name] or bool(uncertain)) and _seems_noisy(result, model)


def _seems_noisy(result: SearchResult, model: ProcessModel) -> bool:
    """Return true if the best hypothesis still needs much process noise."""
    own = result.noise.process_sd[: len(model.states)]  # uncertain parameters follow, which are constant
    shares = (sd / state.scale for sd, state in zip(own, model.states, strict=True))
    return max(shares) > NOISY_SHARE


def _keep_memory() -> None:
    """Make the allocator keep freed memory.

    GNU's allocator returns large arrays to the system and maps them again page by page, in a third of the time of a
    fit. It keeps twice the largest size that it has seen freed, up to 32 MB.
    """
    np.empty(KEPT_BYTES // 8)


def _drop_hidden(result: SearchResult, hidden: Sequence[Effect]) -> SearchResult:
    """Result without the hypotheses of sources that the catalogue does not have, unless nothing else comes near."""
    named = [item for item in result.hypotheses if not set(item.hypothesis.filter.effects) & set(hidden)]
    best = min((item.bic for item in named), default=inf)
    return replace(result, hypotheses=named) if best < result.best.bic + SURE else result


def _is_source(item: FittedHypothesis) -> bool:
    """Return true if a hypothesis is an unmodelled source alone, which has a location and no name."""
    return all(effect.is_source for effect in item.hypothesis.filter.effects)


def _alternatives(result: SearchResult, best: FittedHypothesis) -> list[FittedHypothesis]:
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


def _noise_sd(result: SearchResult, run: Run, model: ProcessModel, curves: Curves, verdict: str) -> Array:
    """Standard deviation of each sensor's noise, shape (n_y,).

    Where nothing explains the run, a filter takes part of the model error for noise.
    """
    if verdict != UNKNOWN:
        return result.noise.sensor_sd(model.output_names)
    simulated = np.column_stack([curves.simulated_before[name] for name in model.output_names])
    return estimate_sensor_noise(
        result.noise, model.output_names, run.measured - simulated, run.measured, run.period_min
    )


def _alternative(search: Search, item: FittedHypothesis, noise: Noise, best_bic: float, record: Record) -> Alternative:
    item.hypothesis.filter.noise = noise
    refined, covariances = refine_parameters(search, item)
    return Alternative(convert_to_run_minutes(hypothesis_causes(refined, covariances), record), item.bic - best_bic)


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


def _describe_record(record: Record) -> list[str]:
    """Remarks on the rows of a record."""
    if record.runs is None:
        return record.remarks
    shifts = ", ".join(f"{shift:+.4g}" for shift in record.run_shifts_min[1 : MAX_SPANS + 1])
    later = f"pictures and differences show those after the first {shifts} min later"
    return [f"{record.remarks[0]}; the state starts again in each, and {later}", *record.remarks[1:]]
