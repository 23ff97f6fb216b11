"""The numbers of an explanation, with their intervals."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import inf, sqrt

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.profile_likelihood import settled
from reactorwatch.diagnosis.result import Adjusted, Cause, Estimate
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import Explained, Search
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import Record


def covariances_of(run: Run, best: Explained) -> list[Array]:
    """Of the numbers of each effect, whatever those of the others."""
    if not best.key:
        return []
    whole, parts, begin = best.hypothesis.covariance(run, best.fit), [], 0
    for theta in best.fit.theta:
        parts.append(whole[begin : begin + theta.size, begin : begin + theta.size])
        begin += theta.size
    return parts


def with_rough_numbers(search: Search, best: Explained) -> tuple[Explained, list[Array]]:
    """With the numbers in which the likelihood is rough where it is largest; and the covariances with their spread."""
    covariances = covariances_of(search.run, best)
    sds = [np.sqrt(np.maximum(np.diag(item), 0.0)) for item in covariances]
    moved, rough = settled(search, best, sds)
    if moved is not best:
        best, covariances = moved, covariances_of(search.run, moved)
    for effect, whole, numbers in zip(best.hypothesis.sized.effects, covariances, rough, strict=True):
        for number, sd in numbers.items():
            share = sd / max(float(np.sqrt(whole[number, number])), 1e-300)
            share = (
                share if effect.is_discontinuous else max(share, 1.0)
            )  # by derivatives, all other numbers may move as well
            whole[number] *= share
            whole[:, number] *= share
    return best, covariances


def adjusted_parameters(
    run: Run, model: ProcessModel, uncertain: Mapping[str, float], best: Explained
) -> dict[str, Adjusted]:
    """The uncertain parameters under the best explanation, whatever its numbers may be."""
    sds = best.hypothesis.offset_sds(run, best.fit) if uncertain else {}
    off = best.hypothesis.offsets(best.fit)
    found = {}
    for name, stated_sd in uncertain.items():
        item = model.parameter(name)
        found[name] = Adjusted(item.value, stated_sd, Estimate(item.value + off[name], sds[name], item.unit))
    return found


def in_minutes_of_runs(causes: Sequence[Cause], record: Record) -> tuple[Cause, ...]:
    """Causes with their times in the minutes of the run in which they set in.

    Args:
        causes: with times that increase over all runs (`Record.continuous_min`).
        record: that they explain.
    """
    if record.runs is None:
        return tuple(causes)
    starts_min = record.continuous_min[list(record.run_starts)]
    found = []
    for cause in causes:
        times = {name for name in cause.parameters if name in ("onset", "end") or name.startswith("time_")}
        times.discard("time_constant")
        first_min = min((cause.parameters[name].value for name in times), default=-inf)
        run = max(int(np.searchsorted(starts_min, first_min, side="right")), 1)
        shift_min = record.run_shifts_min[run - 1]
        parameters = {
            name: replace(item, value=item.value - shift_min) if name in times else item
            for name, item in cause.parameters.items()
        }
        found.append(replace(cause, parameters=parameters, run=run, run_shift_min=shift_min))
    return tuple(found)


def causes_of(best: Explained, covariances: Sequence[Array]) -> list[Cause]:
    """The causes of an explanation, with its numbers.

    Args:
        best: of the record.
        covariances: of the numbers of each of its effects.
    """
    hypothesis, causes = best.hypothesis, []
    for effect, course, theta, part in zip(
        hypothesis.sized.effects, hypothesis.courses, best.fit.theta, covariances, strict=True
    ):
        value = course.parameters(theta)
        slope = {name: np.zeros(theta.size) for name in value}
        for place in range(theta.size):
            step = 0.01 * sqrt(max(float(part[place, place]), 1e-300))
            near = theta.copy()
            near[place] += step
            for name, number in course.parameters(near).items():
                slope[name][place] = (number - value[name]) / step
        parameters = {
            name: Estimate(
                number, sqrt(max(float(slope[name] @ part @ slope[name]), 0.0)), course.unit(name, effect.unit)
            )
            for name, number in value.items()
        }
        causes.append(
            Cause(effect.name, course.name, effect.labels.get(course.name, effect.label), effect.location, parameters)
        )
    return causes
