"""Grade a diagnosis: shares and probabilities of its explanations, and those with nuisance in its place."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from msgspec import structs

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.decide import Verdict, decide
from reactorwatch.diagnosis.estimates import (
    convert_to_run_minutes,
    extended_model,
)
from reactorwatch.diagnosis.holdout import Errors, excess, rms, share_of, simulate_outputs
from reactorwatch.diagnosis.inexact import answer
from reactorwatch.diagnosis.inexact.explain import Explained, Explanation
from reactorwatch.diagnosis.problem import Problem
from reactorwatch.diagnosis.result import (
    AMBIGUOUS,
    LISTED,
    NOMINAL,
    UNKNOWN,
    AdjustedParameter,
    Alternative,
    Cause,
    Diagnosis,
    Gain,
    HeldOut,
    Nuisance,
    Remaining,
)
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis, SearchResult
from reactorwatch.process.effect import Effect, ParameterEffect, ParameterShift
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import CONSTANT
from reactorwatch.records.record import Record

MOST_NEAREST = 5
"""Number of explanations that are listed, whatever the verdict."""

SMALL = 1.1
"""Share of its typical size below which a constant deviation beside a cause with a larger effect is a small correction:
data sheets and constants of the literature are no better than a typical size."""

TINY = 0.1
"""The same of a deviation with any course in time: a second effect so small mends the course of the first. The smallest
ones that are worth finding have 0.1 to 0.8."""


class Weight(NamedTuple):
    """Share of the squared error that an explanation removes, and its probability."""

    share: float
    probability: float

    def of(self, causes: Sequence[Cause]) -> tuple[Cause, ...]:
        """The causes of an explanation with this weight."""
        names = [item.cause for item in causes]
        return tuple(
            structs.replace(
                item,
                share=self.share,
                probability=self.probability,
                beside=tuple(name for name in names if name != item.cause),
            )
            for item in causes
        )


def weights_of(
    items: Sequence[FittedHypothesis], nominal: FittedHypothesis, run: Run, before: Errors, noise_sd: Array
) -> list[Weight]:
    """Weights of hypotheses without nuisance; the squared errors are those on the rows that are held out.

    Args:
        items: the hypotheses, without the nominal one.
        nominal: the nominal one.
        run: the record.
        before: errors of the nominal model on held-out rows.
        noise_sd: standard deviation of each sensor's noise, shape (n_y,).
    """
    bics = np.array([item.bic for item in (nominal, *items)])
    likely = np.exp(-0.5 * (bics - bics.min()))
    result = []
    for item, probability in zip(items, (likely / likely.sum())[1:].tolist(), strict=True):
        hypothesis = item.hypothesis
        simulated = simulate_outputs(run, hypothesis.filter, hypothesis.signals(item.fit), hypothesis.offsets(item.fit))
        with np.errstate(invalid="ignore"):
            error = rms(np.where(before.values, run.measured - simulated, np.nan))
        share = share_of(before.simulation, error, noise_sd)
        result.append(Weight(share, share**2 * probability))
    return result


def nearest_of(result: SearchResult, best: FittedHypothesis) -> list[FittedHypothesis]:
    """The best hypothesis of each set of causes, at most `MOST_NEAREST`; the best first if it has causes."""
    ordered = [best, *result.hypotheses] if best.label else result.hypotheses
    first: dict[frozenset[str], FittedHypothesis] = {}
    for item in ordered:
        first.setdefault(frozenset(item.hypothesis.causes), item)
    return list(first.values())[:MOST_NEAREST]


def list_causes(explanations: Sequence[tuple[Cause, ...]], weights: Sequence[Weight]) -> tuple[Cause, ...]:
    """Causes of explanations with their weights; those that differ in small corrections only are listed once."""
    found = dict[frozenset[str], tuple[Cause, ...]]()
    for causes, weight in zip(explanations, weights, strict=True):
        found.setdefault(frozenset(item.cause for item in causes), weight.of(causes))
    return tuple(item for causes in found.values() for item in causes)


def remaining_of(held_out: Mapping[str, HeldOut], location: str | None) -> dict[str, Remaining]:
    """Errors that are left, by output."""
    return {
        name: Remaining(item.rmse_after, item.noise_sd, item.unit, location if _is_left(item) else None)
        for name, item in held_out.items()
    }


def _is_left(item: HeldOut) -> bool:
    """True if more than a tenth of the squared error is no noise."""
    return not item.rmse_after**2 < 1.1 * item.noise_sd**2


def effect_sizes(item: FittedHypothesis, run: Run, tolerances: Array) -> list[float]:
    """Root mean square difference that each cause of a hypothesis makes, in tolerances, the largest of the outputs."""
    hypothesis, signals = item.hypothesis, item.hypothesis.signals(item.fit)
    if len(signals) < 2:
        return [np.inf] * len(signals)
    offsets = hypothesis.offsets(item.fit)
    whole, result = simulate_outputs(run, hypothesis.filter, signals, offsets), list[float]()
    for index, effect in enumerate(hypothesis.filter.effects):
        nothing = np.full(run.time_min.size, effect.neutral)
        neutral = list(signals)
        neutral[index] = signals[index]._replace(interval_mean=nothing, sample_value=nothing)
        without = simulate_outputs(run, hypothesis.filter, neutral, offsets)
        result.append(float(np.nan_to_num(np.max(rms(whole - without) / tolerances), nan=np.inf)))
    return result


def separate_corrections(
    causes: Sequence[Cause], sizes: Sequence[float], effects: Sequence[Effect]
) -> tuple[tuple[Cause, ...], tuple[Nuisance, ...]]:
    """Causes by their effect on the outputs, the largest first, and small deviations beside them.

    Args:
        causes: causes of an explanation.
        sizes: effect of each on the outputs.
        effects: the catalogue.
    """
    typical = {effect.name: abs(effect.typical) for effect in effects}
    ordered = [item for _, item in sorted(zip(sizes, causes, strict=True), key=lambda pair: -pair[0])]
    small = [
        item
        for item in ordered[1:]
        if abs(item.parameters["size"].value)
        < (SMALL if item.profile == CONSTANT.name else TINY) * typical.get(item.cause, 0.0)
    ]
    kept = tuple(item for item in ordered if item not in small)
    return kept, tuple(Nuisance(item.cause, item.parameters["size"], None) for item in small)


def with_nuisance(exact: Diagnosis, explained: Explained, problem: Problem) -> Diagnosis:
    """A diagnosis with the explanations with nuisance in the place of those without, if these say more.

    Args:
        exact: diagnosis without nuisance.
        explained: explanations with nuisance.
        problem: the record and what is known of its plant.
    """
    bands, record = problem.bands, problem.record
    graded = [answer.grades(item, explained, bands) for item in explained.explanations]
    first = exact.nearest[0].share if exact.causes and exact.nearest else 0.0
    left = left_in_tolerances(exact.gain.held_out, problem.tolerances)
    none = answer.grades(explained.none, explained, bands)
    verdict = decide(exact.verdict, first, left, none, graded, is_law=exact.law is not None)
    nearest = [cause for item in explained.explanations for cause in answer.causes_of(item, explained)[:1]]
    nearest = list(convert_to_run_minutes(nearest[:MOST_NEAREST], record))
    if not verdict.with_nuisance:
        onset = exact.onset or answer.onset_of(nearest)
        kept = exact.nearest if verdict.verdict != UNKNOWN else tuple(nearest)
        causes = () if verdict.verdict == UNKNOWN else exact.causes
        return structs.replace(
            exact, verdict=verdict.verdict, grade=verdict.grade, nearest=kept, onset=onset, causes=causes
        )
    found = _answer_with_nuisance(exact, explained, verdict, tuple(nearest), problem)
    # what the whole record differs by may be nuisance, so the cause is judged by its own effect
    return structs.replace(found, practical=verdict.verdict != NOMINAL and graded[0].effect > 1.0)


def _answer_with_nuisance(
    exact: Diagnosis,
    explained: Explained,
    verdict: Verdict,
    nearest: tuple[Cause, ...],
    problem: Problem,
) -> Diagnosis:
    """The diagnosis that the explanations with nuisance give."""
    model, record = problem.model, problem.record
    is_right = verdict.verdict == NOMINAL
    best = explained.none if is_right else explained.explanations[0]
    own = convert_to_run_minutes(answer.causes_of(best, explained), record)
    causes = own[:1]
    alternatives = tuple(Alternative((item,), 0.0, best.share, best.probability) for item in own[1:])
    if verdict.verdict == AMBIGUOUS:
        alternatives = (*alternatives, *_rivals(best, explained, record))
    assert exact.curves is not None
    curves = answer.curves_with(best, explained, exact.curves)
    held_out = {
        name: structs.replace(
            item,
            rmse_after=float(np.hypot(best.left[index], explained.noise_sd[index])),
            noise_sd=float(explained.noise_sd[index]),
        )
        for index, (name, item) in enumerate(exact.gain.held_out.items())
    }
    adjusted = answer.adjusted_model(best, explained, model)
    lead = 2.0 * (best.log_evidence - explained.none.log_evidence)
    return structs.replace(
        exact,
        verdict=verdict.verdict,
        grade=verdict.grade,
        causes=causes,
        alternatives=alternatives,
        nearest=nearest,
        onset=answer.onset_of(causes),
        nuisance=answer.nuisance_of(best, explained),
        relative_delays=answer.relative_delays(best, explained),
        remaining=remaining_of(held_out, None),
        location=causes[0].location if causes else None,
        locations=(),
        law=None,
        significant=not is_right,
        gain=Gain(lead, held_out),
        experiment=None,
        extended_model=extended_model(adjusted, problem.effects, causes, record.zero_ns),
        parameters=_parameters(best, explained, model, problem.uncertain),
        curves=curves,
        with_nuisance=True,
    )


def _rivals(best: Explanation, explained: Explained, record: Record) -> list[Alternative]:
    """Explanations within `LISTED` of the best."""
    result = []
    for item in explained.explanations[1:]:
        delta = 2.0 * (best.log_evidence - item.log_evidence)
        if delta < LISTED:
            causes = convert_to_run_minutes(answer.causes_of(item, explained)[:1], record)
            result.append(Alternative(causes, delta, item.share, item.probability))
    return result


def _parameters(
    item: Explanation, explained: Explained, model: ProcessModel, uncertain: Mapping[str, float]
) -> dict[str, AdjustedParameter]:
    """Estimates of the uncertain parameters under an explanation."""
    nuisance, result = explained.nuisance, dict[str, AdjustedParameter]()
    for index, effect in enumerate(nuisance.simulation.effects, start=nuisance.effects.start):
        if not isinstance(effect, (ParameterEffect, ParameterShift)) or effect.parameter not in uncertain:
            continue
        known = model.parameter(effect.parameter)
        eta, sd = float(item.fitted.theta[index]), float(item.fitted.theta_sd[index])
        scale = abs(known.value) if isinstance(effect, ParameterEffect) else 1.0
        value, stated = effect.deviate(known.value, eta), uncertain[effect.parameter]
        result[effect.parameter] = AdjustedParameter(known.value, stated, value, scale * sd, known.unit)
    return result


def left_in_tolerances(held_out: Mapping[str, HeldOut], tolerances: Mapping[str, float]) -> float:
    """Error that an explanation leaves beyond the noise, in tolerances, the largest of the outputs."""
    left = [
        float(excess(np.array(item.rmse_after), np.array(item.noise_sd))) / tolerances[name]
        for name, item in held_out.items()
    ]
    return max(left) if np.all(np.isfinite(left)) else np.inf
