"""Estimated parameters of an explanation, with their intervals."""

from collections.abc import Mapping, Sequence
from math import inf, sqrt

import numpy as np
from msgspec import structs

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.profile_likelihood import refine
from reactorwatch.diagnosis.result import AdjustedParameter, Cause, Estimate
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis, Search
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import Record


def covariances_of(run: Run, best: FittedHypothesis) -> list[Array]:
    """Covariance of each effect's parameters, marginal over the others."""
    if not best.label:
        return []
    whole, parts, begin = best.hypothesis.covariance(run, best.fit), [], 0
    for fitted in best.fit.parameters:
        parts.append(whole[begin : begin + fitted.size, begin : begin + fitted.size])
        begin += fitted.size
    return parts


def refine_parameters(search: Search, best: FittedHypothesis) -> tuple[FittedHypothesis, list[Array]]:
    """Move parameters with a rough likelihood to its maximum, and scale the covariances to its spread."""
    covariances = covariances_of(search.run, best)
    sds = [np.sqrt(np.maximum(np.diag(item), 0.0)) for item in covariances]
    moved, rough = refine(search, best, sds)
    if moved is not best:
        best, covariances = moved, covariances_of(search.run, moved)
    for effect, whole, numbers in zip(best.hypothesis.filter.effects, covariances, rough, strict=True):
        for number, sd in numbers.items():
            share = sd / max(float(np.sqrt(whole[number, number])), 1e-300)
            share = (
                max(share, 1.0) if effect.has_derivative else share
            )  # the derivatives' spread is marginal over the others
            whole[number] *= share
            whole[:, number] *= share
    return best, covariances


def adjusted_parameters(
    run: Run,
    model: ProcessModel,
    uncertain: Mapping[str, float],
    best: FittedHypothesis,
    sds: Mapping[str, float] | None = None,
) -> dict[str, AdjustedParameter]:
    """Estimates of the uncertain parameters under the best hypothesis, marginal over its parameters.

    Args:
        run: the record.
        model: process model with the stated values.
        uncertain: stated standard deviations, by name.
        best: best hypothesis.
        sds: standard deviations of the estimates, where they are parameters of its model; None: they are its states.
    """
    if sds is None:
        sds = best.hypothesis.offset_sds(run, best.fit) if uncertain else {}
    offsets = best.hypothesis.offsets(best.fit)
    result = {}
    for name, stated_sd in uncertain.items():
        item, about = model.parameter(name), best.hypothesis.filter.model.parameter(name)
        value = about.value + offsets.get(name, 0.0)
        result[name] = AdjustedParameter(item.value, stated_sd, value, sds[name], item.unit)
    return result


def convert_to_run_minutes(causes: Sequence[Cause], record: Record) -> tuple[Cause, ...]:
    """Convert the times of causes to minutes of the run in which they set in.

    Args:
        causes: causes with times that increase over all runs (`Record.continuous_min`).
        record: record that they explain.
    """
    if len(record.run_starts) == 1:
        return tuple(causes)
    starts_min = record.continuous_min[list(record.run_starts)]
    result = []
    for cause in causes:
        times = {name for name in cause.parameters if name in ("onset", "end") or name.startswith("time_")}
        times.discard("time_constant")
        first_min = min((cause.parameters[name].value for name in times), default=-inf)
        run = max(int(np.searchsorted(starts_min, first_min, side="right")), 1)
        shift_min = record.run_shifts_min[run - 1]
        parameters = {
            name: structs.replace(item, value=item.value - shift_min) if name in times else item
            for name, item in cause.parameters.items()
        }
        result.append(structs.replace(cause, parameters=parameters, run=run, run_shift_min=shift_min))
    return tuple(result)


def causes_of(best: FittedHypothesis, covariances: Sequence[Array]) -> list[Cause]:
    """Causes of a hypothesis with their estimated parameters.

    Args:
        best: fitted hypothesis.
        covariances: covariance of each effect's parameters.
    """
    causes = []
    for item, part in zip(best.parts, covariances, strict=True):
        effect, profile, fitted = item.effect, item.profile, item.parameters
        value = profile.profile_values(fitted)
        slope = {name: np.zeros(fitted.size) for name in value}
        for index in range(fitted.size):
            step = 0.01 * sqrt(max(float(part[index, index]), 1e-300))
            near = fitted.copy()
            near[index] += step
            for name, number in profile.profile_values(near).items():
                slope[name][index] = (number - value[name]) / step
        parameters = {
            name: Estimate(
                number, sqrt(max(float(slope[name] @ part @ slope[name]), 0.0)), profile.unit(name, effect.unit)
            )
            for name, number in value.items()
        }
        for index, constant in enumerate(profile.constants, start=profile.n_shape):
            sd = sqrt(max(float(part[index, index]), 0.0))
            parameters[constant.name] = Estimate(float(fitted[index]), sd, constant.unit)
        causes.append(
            Cause(
                cause=effect.name,
                profile=profile.name,
                label=effect.labels.get(profile.name, effect.label),
                location=effect.location,
                parameters=parameters,
            )
        )
    return causes
