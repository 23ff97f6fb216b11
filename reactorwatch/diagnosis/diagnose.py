"""Diagnose a simulation from a record and its model."""

from collections.abc import Mapping, Sequence

import numpy as np
from msgspec import structs

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.exact.answer import answer_exactly
from reactorwatch.diagnosis.exact.explain import Exact, explain_exactly, seems_noisy
from reactorwatch.diagnosis.experiment.inputs import check_limits
from reactorwatch.diagnosis.graded import with_nuisance
from reactorwatch.diagnosis.inexact.explain import explain
from reactorwatch.diagnosis.inexact.nuisance import time_sd_min
from reactorwatch.diagnosis.practical_significance import tolerances_of
from reactorwatch.diagnosis.problem import Problem
from reactorwatch.diagnosis.record_checks import (
    describe_outliers,
    describe_short_record,
    describe_still_inputs,
    make_run,
)
from reactorwatch.diagnosis.result import AMBIGUOUS, UNKNOWN, Diagnosis
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.screen import Part
from reactorwatch.diagnosis.search.search import smallest_noise
from reactorwatch.diagnosis.whiteness import DOUBTFUL
from reactorwatch.process import effects_of
from reactorwatch.process.effect import TIMING, Effect
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import CONSTANT, FREE_NAME
from reactorwatch.process.signal_effects import InputDelay, InputLag, OutputDelay, OutputLag
from reactorwatch.records.record import MAX_SPANS, Record

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
    check_limits(model, limits or {})
    run = make_run(record, model)
    tolerances = tolerances_of(run, model, tolerance or {})
    stated = uncertain or {}
    catalogue = tuple(effects_of(model) if effects is None else effects)
    smallest_sd = smallest_noise(model, run.measured)
    problem = Problem(record, run, model, catalogue, stated, tolerances, limits or {}, smallest_sd)
    exact = explain_exactly(problem)
    used = exact.search.run
    about_record = [*_describe_record(record), *describe_outliers(run, used)]
    about_record += describe_still_inputs(model, catalogue, used.inputs)
    diagnosis = answer_exactly(exact, problem, about_record)
    if not _calls_for_nuisance(diagnosis, exact, model):
        return diagnosis
    explained = explain(model, catalogue, used, _starts(exact, model), stated, smallest_sd)
    if explained is None:
        return diagnosis
    answer = with_nuisance(diagnosis, explained, problem)
    about_record += describe_short_record(used, explained.nuisance.size)
    return structs.replace(answer, remarks=tuple(about_record)) if answer.with_nuisance else answer


def _calls_for_nuisance(diagnosis: Diagnosis, exact: Exact, model: ProcessModel) -> bool:
    """True if the hypotheses are to be compared with nuisance: nothing simple explains the record to the noise."""
    if diagnosis.location == TIMING:
        return False  # an integrator's steps are named, and nuisance would imitate them
    best, is_white = exact.best, all(item.minus_log10_p < DOUBTFUL for item in diagnosis.adequacy.values())
    if diagnosis.verdict == UNKNOWN:
        return diagnosis.practical or diagnosis.law is None or not is_white
    is_pair = len(best.label) > 1
    is_simple = not is_pair and FREE_NAME not in [profile.name for profile in best.hypothesis.profiles]
    if is_pair and all(_is_a_little_late(part, exact.search.run) for part in best.parts):
        return True  # as clocks and sensors are everywhere
    if is_white:
        return not is_simple and seems_noisy(exact.result, model)
    return not is_simple or diagnosis.verdict == AMBIGUOUS


def _is_a_little_late(part: Part, run: Run) -> bool:
    """True if a cause is a constant lag or delay within twice the standard deviation of its prior as nuisance."""
    is_lag = isinstance(part.effect, (InputLag, OutputLag))
    most_min = 2.0 * time_sd_min(run, is_lag=is_lag)
    is_time = is_lag or isinstance(part.effect, (InputDelay, OutputDelay))
    return is_time and part.profile.name == CONSTANT.name and float(part.parameters[0]) <= most_min


def _starts(exact: Exact, model: ProcessModel) -> Array:
    """States at the first row of each part of a run, by the filter, shape (parts, n_x)."""
    x = exact.result.nominal.fit.innovations.x[:, : len(model.states)]
    known = np.flatnonzero(np.all(np.isfinite(x), axis=1))
    rows = known[np.minimum(np.searchsorted(known, (0, *exact.search.run.breaks)), known.size - 1)]
    return np.asarray(x[rows])


def _keep_memory() -> None:
    """Make the allocator keep freed memory.

    GNU's allocator returns large arrays to the system and maps them again page by page, in a third of the time of a
    fit. It keeps twice the largest size that it has seen freed, up to 32 MB.
    """
    np.empty(KEPT_BYTES // 8)


def _describe_record(record: Record) -> list[str]:
    """Remarks on the rows of a record."""
    if record.runs is None:
        return record.remarks
    shifts = ", ".join(f"{shift:+.4g}" for shift in record.run_shifts_min[1 : MAX_SPANS + 1])
    later = f"pictures and differences show those after the first {shifts} min later"
    return [f"{record.remarks[0]}; the state starts again in each, and {later}", *record.remarks[1:]]
