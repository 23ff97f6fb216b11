"""The explanation of a record by the exact equations: a cause, two, or an unknown at a place."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.decide import LEAST_GAIN, SURE, Found, PlaceFound, decide_without_nuisance
from reactorwatch.diagnosis.fitting.hypothesis import FROM_BEGINNING
from reactorwatch.diagnosis.holdout import evaluate_holdout, is_near_noise
from reactorwatch.diagnosis.lasting import LastingResult, prefer_lasting
from reactorwatch.diagnosis.law.unknown import NOISY_SHARE, FittedLaw, Localised, UnknownSearch
from reactorwatch.diagnosis.problem import Problem
from reactorwatch.diagnosis.result import AMBIGUOUS, NAMED, UNKNOWN
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.noise import search_noise_growth, search_single_cause
from reactorwatch.diagnosis.search.pairs import search_pairs
from reactorwatch.diagnosis.search.search import FittedHypothesis, Search, SearchResult
from reactorwatch.diagnosis.whiteness import DOUBTFUL, WHITE, minus_log10_p
from reactorwatch.process.effect import Effect
from reactorwatch.process.generic import hidden_sources
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import CONSTANT, FREE_NAME
from reactorwatch.sentences.diagnosis import describe_place


@dataclass(frozen=True, eq=False)
class Exact:
    """Explanation of a record by the exact equations.

    Attributes:
        search: the search.
        result: the hypotheses that it fitted, those that it could not name left out.
        best: the explanation; the nominal hypothesis where there is none, or none in the catalogue.
        verdict: see `decide`.
        location: where the explanation acts; empty without one.
        adequacy: whiteness of the residual of the best hypothesis, minus the decimal logarithm of p, shape (n_y,).
        unknown: unknown at a place, if it is the explanation or explains the record as well as a pair.
        lasting: whether lasting causes took the place of one that drifts, with the parameters beside them.
        remarks: remarks for the user.
    """

    search: Search
    result: SearchResult
    best: FittedHypothesis
    verdict: str
    location: str
    adequacy: Array
    unknown: Localised | None = None
    lasting: LastingResult | None = None
    remarks: tuple[str, ...] = ()

    @property
    def law(self) -> FittedLaw | None:
        """Law of the unknown, if it is the explanation."""
        is_there = self.unknown is not None and self.verdict == UNKNOWN and self.unknown.location == self.location
        return self.unknown.law if self.unknown is not None and is_there else None


def explain_exactly(problem: Problem) -> Exact:
    """Explain a record by causes of the catalogue or, where none does, by an unknown at a place.

    Args:
        problem: the record and what is known of its plant.
    """
    model, effects = problem.model, problem.effects
    hidden = hidden_sources(model, effects)
    search = Search(problem.plant, (*effects, *hidden), problem.run, problem.smallest_sd)
    result = search_single_cause(search)
    if search.adopt_colored_noise(result.best):
        result = search_single_cause(search)
    unknowns = UnknownSearch(model, effects, search.run, result)
    is_white = not np.any(minus_log10_p(result.best.fit.w, search.run.inputs) >= DOUBTFUL)
    if is_white or not unknowns.is_simple:
        result = search_pairs(search, result)
    result = _drop_hidden(search_noise_growth(search, result), hidden)
    best = result.best if result.nominal.bic - result.best.bic >= LEAST_GAIN else result.nominal
    exact = _with_unknown(_first_verdict(search, result, best), unknowns, model)
    if exact.verdict in (NAMED, AMBIGUOUS) and _may_last(exact, problem):
        exact = _with_lasting(exact, problem)
    exact.best.hypothesis.filter.noise = exact.result.noise
    exact.result.nominal.hypothesis.filter.noise = exact.result.nominal_noise
    return exact


def _first_verdict(search: Search, result: SearchResult, best: FittedHypothesis) -> Exact:
    """Verdict of the catalogue alone."""
    adequacy = minus_log10_p(best.fit.w, search.run.inputs)
    verdict = decide_without_nuisance(_search_evidence(result, best, adequacy), None)
    return Exact(search, result, best, verdict, _location_of(best), adequacy)


def _with_unknown(exact: Exact, unknowns: UnknownSearch, model: ProcessModel) -> Exact:
    """The verdict beside an unknown at a place, where the catalogue does not explain the record beyond doubt."""
    result, best, run = exact.result, exact.best, exact.search.run
    found = _search_evidence(result, best, exact.adequacy)
    is_open = exact.verdict == UNKNOWN or not found.is_white
    if not (is_open or (best.label and _may_be_unknown(result, best, model))):
        return exact
    is_plain = best.label and not is_open and not seems_noisy(result, model)
    unknown = unknowns.localise(best.bic if is_plain else inf)
    kept: Localised | None = unknown
    by_source, location, remarks = exact.verdict == UNKNOWN and found.is_white, exact.location, list[str]()
    verdict = decide_without_nuisance(found, _place_result(unknown, result, best, run, found.minus_log10_p))
    if verdict == UNKNOWN:
        best, location = result.nominal, location if by_source else unknown.location
    elif unknown.gain_over(best) > -SURE and len(best.label) > 1:
        remarks.append(f"one unknown deviation {describe_place(unknown.location)} explains the record as well")
    else:
        kept = None
    if kept is None and np.any(exact.adequacy >= WHITE):
        remarks.append(
            "the residual is small, but not white: the course in time may be rougher than the fitted profile"
        )
    return replace(exact, best=best, verdict=verdict, location=location, unknown=kept, remarks=tuple(remarks))


def _with_lasting(exact: Exact, problem: Problem) -> Exact:
    """The explanation by lasting causes, if it simulates held-out rows better."""
    lasting = prefer_lasting(exact.search, exact.result, exact.best, problem.model, problem.uncertain)
    if lasting is None:
        return exact
    best = lasting.result.hypotheses[0]
    return replace(
        exact,
        result=lasting.result,
        best=best,
        verdict=AMBIGUOUS if len(lasting.result.hypotheses) > 1 else NAMED,
        location=_location_of(best),
        adequacy=minus_log10_p(best.fit.w, exact.search.run.inputs),
        unknown=None,
        lasting=lasting,
        remarks=(*exact.remarks, "a lasting cause simulates the rows that were held out better than one that drifts"),
    )


def _location_of(item: FittedHypothesis) -> str:
    return item.hypothesis.filter.effects[0].location if item.label else ""


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
    return seems_noisy(result, model) or (from_beginning and (len(profiles) > 1 or FREE_NAME in profiles))


def _may_last(exact: Exact, problem: Problem) -> bool:
    """Return true if the best hypothesis drifts, or has uncertain parameters, and process noise hides its errors."""
    profiles = [profile.name for profile in exact.best.hypothesis.profiles]
    return (profiles != [CONSTANT.name] or bool(problem.uncertain)) and seems_noisy(exact.result, problem.model)


def seems_noisy(result: SearchResult, model: ProcessModel) -> bool:
    """Return true if the best hypothesis still needs much process noise."""
    own = result.noise.process_sd[: len(model.states)]  # uncertain parameters follow, which are constant
    shares = (sd / state.scale for sd, state in zip(own, model.states, strict=True))
    return max(shares) > NOISY_SHARE


def _drop_hidden(result: SearchResult, hidden: Sequence[Effect]) -> SearchResult:
    """Result without the hypotheses of sources that the catalogue does not have, unless nothing else comes near."""
    named = [item for item in result.hypotheses if not set(item.hypothesis.filter.effects) & set(hidden)]
    best = min((item.bic for item in named), default=inf)
    return replace(result, hypotheses=named) if best < result.best.bic + SURE else result


def _is_source(item: FittedHypothesis) -> bool:
    """Return true if a hypothesis is an unmodelled source alone, which has a location and no name."""
    return all(effect.is_source for effect in item.hypothesis.filter.effects)
