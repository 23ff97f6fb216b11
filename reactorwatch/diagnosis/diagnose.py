"""From a record and a model to what is wrong with the simulation."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.curves import curves_of, differences_of
from reactorwatch.diagnosis.estimates import adjusted_parameters, causes_of, in_minutes_of_runs, with_rough_numbers
from reactorwatch.diagnosis.experiment.constraints import checked_limits
from reactorwatch.diagnosis.experiment.design import proposed
from reactorwatch.diagnosis.extended import extended_model
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.holdout import Errors, gained
from reactorwatch.diagnosis.integration_error import looks_like_integration
from reactorwatch.diagnosis.parameter_priors import with_uncertain
from reactorwatch.diagnosis.practical_significance import bands_of, left_matters, matters
from reactorwatch.diagnosis.record_checks import run_of
from reactorwatch.diagnosis.result import (
    AMBIGUOUS,
    LISTED,
    NAMED,
    NOMINAL,
    UNKNOWN,
    Alternative,
    Curves,
    Diagnosis,
    Gain,
    HeldOut,
)
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.noise_masking import explained_by_one
from reactorwatch.diagnosis.search.pairs import with_pairs
from reactorwatch.diagnosis.search.search import Explained, Found, Search
from reactorwatch.diagnosis.sensor_noise import sensor_noise
from reactorwatch.diagnosis.unknown_input.localise import MARGIN, Located, bic_of, located
from reactorwatch.diagnosis.whiteness import DOUBTFUL, WHITE, minus_log10_p
from reactorwatch.process import effects_of
from reactorwatch.process.effect import TIMING, Effect
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MAX_SPANS, Record

LEAST_GAIN = 10.0
"""In BIC: less does not refute the nominal model (Kass & Raftery 1995, J. American Statistical Association 90)."""

SURE = 6.0
"""In BIC, odds of twenty to one: where a rival is worse by less, the record does not rank them."""

MUCH_LEFT, MUCH_LEFT_BY_TWO = 30.0, 10.0
"""Minus the decimal logarithm of the p-value that what is left is white: so much is left by no cause that is right, nor
by two of them, which can imitate a third."""

NOISY_SHARE = 0.003
"""Of a state's scale per square root of a minute: a cause that leaves the process so noisy may not be all there is."""

NEARLY = 1.15
"""Times the noise: a free run that errs no more explains what matters, though something is left."""

KEPT_BYTES = 31_000_000

SMALLEST_NOISE = 1e-3
"""Of a state's scale: no sensor is taken for better, and files have so many digits."""


def diagnose(
    record: Record,
    model: ProcessModel,
    effects: Sequence[Effect] | None = None,
    tolerance: Mapping[str, float] | None = None,
    uncertain: Mapping[str, float] | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> Diagnosis:
    """What a simulation by the model gets wrong of a record.

    Args:
        record: with the model's inputs and outputs as columns.
        model: the simulation.
        effects: the causes that may be named; None: those of the model's own catalogue.
        tolerance: by output, the root mean square difference that does not matter in practice, in its unit; where
            nothing is said, a fiftieth of the output's range.
        uncertain: by parameter of the model, the standard deviation to which its value is known, in its unit; the
            others are known exactly. See `reactorwatch.diagnosis.parameter_priors`.
        limits: by input and output, the lowest and the highest value that an experiment may lead to; where nothing is
            said, somewhat wider than the record.

    Raises:
        InputError: the record cannot be diagnosed, a tolerance is of no output or not positive, what is uncertain is no
            parameter or its standard deviation not positive, or limits are of no signal, do not rise or are beyond what
            an input can be.
    """
    _keep_memory()
    effects = effects_of(model) if effects is None else effects
    checked_limits(model, limits or {})
    whole = run_of(record, model)
    bands = bands_of(whole, model, tolerance or {})
    plant = with_uncertain(model, uncertain or {})
    search = Search(plant, effects, whole, _smallest_sd(model))
    run = search.run
    found = explained_by_one(search)
    if search.remembers(found.best):
        found = explained_by_one(search)
    found = with_pairs(search, found)
    best = found.best if found.nominal.bic - found.best.bic >= LEAST_GAIN else found.nominal
    adequacy = minus_log10_p(best.fit.w, run.inputs)
    verdict, location = _verdict(found, best), best.hypothesis.sized.effects[0].location if best.key else ""
    remarks = [*_said_of(record), *_left_out(whole, run)]
    strange: Located | None = None
    if np.any(adequacy >= DOUBTFUL) or (best.key and _seems_noisy(found, model)):
        off = found.nominal.hypothesis.offsets(found.nominal.fit)
        known = model.with_values({name: model.parameter(name).value + value for name, value in off.items()})
        strange = located(known, effects, run, found.nominal.fit, found.own_noise)
        if _is_unknown(strange, found, best, run, float(np.max(adequacy))):
            verdict, best = UNKNOWN, found.nominal  # what is not explained is not extended
            location = strange.effect.location if strange is not None else location
        elif np.any(adequacy >= WHITE):
            remarks.append(
                "what is left is small, but not white: the course in time may be rougher than what was fitted"
            )
    best.hypothesis.sized.noise, found.nominal.hypothesis.sized.noise = found.noise, found.own_noise
    best, covariances = with_rough_numbers(search, best)
    before, after = gained(run, found.nominal, best)
    curves = curves_of(whole, run, model, found.nominal, best, covariances)
    noise_sd = _noise_sd(found, run, model, curves, verdict)
    unexplained = verdict == UNKNOWN and left_matters(before, noise_sd, model, bands)
    if verdict == UNKNOWN and not unexplained and looks_like_integration(plant, run, found.nominal.fit.found):
        location = TIMING
        remarks.append(
            "what is left is small and goes with the error of an integrator's steps: it looks like integration "
            "of the record's own making, or timing of its input"
        )
    curves = replace(curves, held_out=dict(zip(model.output_names, after.values.T, strict=True)))
    if verdict == UNKNOWN and strange is not None and strange.effect.location == location:
        curves = replace(curves, unknown=strange.course)
    blind = ~np.all(np.isfinite(found.nominal.fit.found.prediction), axis=1)
    causes = in_minutes_of_runs(causes_of(best, covariances), record)
    parameters = adjusted_parameters(run, model, uncertain or {}, best)
    adjusted = model.with_values({name: item.estimate.value for name, item in parameters.items()})
    rivals = _rivals(found, best)
    experiment = proposed([best, *rivals], run, model, found.noise, limits or {}) if rivals else None
    if isinstance(experiment, str):
        remarks.append(experiment)
        experiment = None
    return Diagnosis(
        samples=run.time_min.size,
        span_min=record.span_min,
        verdict=verdict,
        causes=causes,
        alternatives=tuple(_alternative(search, item, found.noise, best.bic, record) for item in rivals),
        location=location,
        significant=verdict != NOMINAL,
        practical=unexplained or matters(curves, bands, blind),
        differences=differences_of(model, noise_sd, curves),
        gain=_gain(model, found.nominal.bic - best.bic, noise_sd, before, after),
        adequacy=dict(zip(model.output_names, adequacy.tolist(), strict=True)),
        experiment=experiment,
        extended_model=extended_model(adjusted, effects, causes, record.zero_ns),
        remarks=tuple(remarks),
        parameters=parameters,
        curves=curves,
        runs=len(record.run_starts),
    )


def _is_unknown(strange: Located | None, found: Found, best: Explained, run: Run, left: float) -> bool:
    """Whether what is named or nominal does not explain the run, but something else would.

    Args:
        strange: what would.
        found: of the catalogue.
        best: of it.
        run: the record.
        left: minus the decimal logarithm of the p-value that what it leaves is white.
    """
    better = strange is not None and strange.bic < bic_of(best, strange.known, run) - MARGIN
    if left < WHITE:
        return better and bool(best.key)
    if not best.key or left >= (MUCH_LEFT if len(best.key) == 1 else MUCH_LEFT_BY_TWO):
        return True
    return better or not _nearly_explained(found, gained(run, found.nominal, best)[1])


def _seems_noisy(found: Found, model: ProcessModel) -> bool:
    """Whether with the best hypothesis much still moves the states that is not in the model."""
    own = found.noise.process_sd[: len(model.states)]  # behind them uncertain parameters, which never move
    shares = (sd / state.scale for sd, state in zip(own, model.states, strict=True))
    return max(shares) > NOISY_SHARE


def _nearly_explained(found: Found, after: Errors) -> bool:
    """Whether the free run's errors come near to the noise on rows that were not fitted."""
    outputs = found.nominal.hypothesis.sized.model.output_names
    return bool(np.all(after.free < NEARLY * found.noise.sensor_sd(outputs)))


def _keep_memory() -> None:
    """Have the allocator keep what is freed.

    That of GNU gives large arrays back and takes them anew, page by page, in a third of the time of a fit. It keeps
    twice as much as the largest that it has seen freed, of 32 MB at most.
    """
    np.empty(KEPT_BYTES // 8)


def _verdict(found: Found, best: Explained) -> str:
    if best is found.nominal:
        return NOMINAL
    rivals = [item.bic - best.bic for item in found.explained if item.hypothesis.causes != best.hypothesis.causes]
    return AMBIGUOUS if rivals and min(rivals) < SURE else NAMED


def _rivals(found: Found, best: Explained) -> list[Explained]:
    """The best of every other set of causes that comes near."""
    listed: list[Explained] = []
    seen = {frozenset(best.hypothesis.causes)}
    if best is found.nominal:
        return []
    for item in found.explained:
        causes = frozenset(item.hypothesis.causes)
        if item.bic < best.bic + LISTED and causes not in seen:
            seen.add(causes)
            listed.append(item)
    return listed


def _noise_sd(found: Found, run: Run, model: ProcessModel, curves: Curves, verdict: str) -> Array:
    """Standard deviation of each sensor's noise, shape (n_y,).

    Where nothing explains the run, a filter takes part of what the model errs for noise.
    """
    if verdict != UNKNOWN:
        return found.noise.sensor_sd(model.output_names)
    simulated = np.column_stack([curves.free_before[name] for name in model.output_names])
    period_min = float(np.median(np.diff(run.time_min)))
    return sensor_noise(found.noise, model.output_names, run.measured - simulated, run.measured, period_min)


def _alternative(search: Search, item: Explained, noise: Noise, best_bic: float, record: Record) -> Alternative:
    item.hypothesis.sized.noise = noise
    explained, covariances = with_rough_numbers(search, item)
    return Alternative(in_minutes_of_runs(causes_of(explained, covariances), record), item.bic - best_bic)


def _gain(model: ProcessModel, delta_bic: float, noise_sd: Array, before: Errors, after: Errors) -> Gain:
    held_out = {
        output.name: HeldOut(
            float(before.free[place]),
            float(after.free[place]),
            float(before.one_step[place]),
            float(after.one_step[place]),
            float(noise_sd[place]),
            output.unit,
        )
        for place, output in enumerate(model.outputs)
    }
    return Gain(delta_bic, held_out)


def _said_of(record: Record) -> list[str]:
    """Remarks on the rows of a record, for people."""
    if record.runs is None:
        return record.remarks
    shifts = ", ".join(f"{shift:+.4g}" for shift in record.run_shifts_min[1 : MAX_SPANS + 1])
    later = f"pictures and differences show those after the first {shifts} min later"
    return [f"{record.remarks[0]}; the state starts again in each, and {later}", *record.remarks[1:]]


def _left_out(whole: Run, run: Run) -> list[str]:
    """What is to be said of outliers."""
    count = whole.values - run.values
    if count == 0:
        return []
    values = "1 value was" if count == 1 else f"{count} values were"
    return [f"{values} left out for outliers: far off for a moment, they say nothing of the plant"]


def _smallest_sd(model: ProcessModel) -> list[float]:
    scales = {state.name: state.scale for state in model.states}
    return [SMALLEST_NOISE * scales.get(output.name, 1.0) for output in model.outputs]
