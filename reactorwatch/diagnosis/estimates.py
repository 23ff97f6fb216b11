"""Estimated parameters of an explanation, with their intervals.

Profile likelihood of parameters in which the likelihood is rough: onsets, and magnitudes of stiction. The loss is no
parabola in them. A sensor fault has the same effect at any onset between two rows; a lag is visible only where the
input moves; stiction has the same effect for a range of magnitudes; and a fit can stay in a local optimum between two
input changes. So the parameter is scanned about the best fit with the others fixed, and the likelihood is taken as its
distribution (Sivia & Skilling 2006, Data Analysis: A Bayesian Tutorial, 2.2). The mean is the estimate if it is about
as likely as the maximum; the root mean square distance from the estimate is the standard deviation.

Effects with internal states were screened at a few magnitudes only (`dynamic_and_pair_screens`). For their steps all
onsets are evaluated at once (`fitting.scan`), because the states are fast.

Extended model: the model with the diagnosed causes, in the format of its file.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from math import inf, sqrt
from typing import Any

import numpy as np
from msgspec import structs

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import LANES
from reactorwatch.diagnosis.fitting.hypothesis import Fit
from reactorwatch.diagnosis.fitting.profiles import Step
from reactorwatch.diagnosis.fitting.scan import onset_losses
from reactorwatch.diagnosis.result import AdjustedParameter, Cause, Estimate, make_cause
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis, Search
from reactorwatch.process.effect import Effect
from reactorwatch.process.extended_model import are_named, extend, extended_model_of, is_complete
from reactorwatch.process.fault import FaultSpecification
from reactorwatch.process.law import ExtendedLaw
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import FREE_NAME, PROFILES, free_profile
from reactorwatch.records.record import Record

OFFSETS = (0.5, 1.0, 2.0)
"""First values to either side, in standard deviations of the fit, and at least rows."""

WIDENINGS, ROUNDS = 7, 3
OUT_OF_QUESTION = 7.0
"""Threshold in log likelihood: values that are worse by more add nothing, and end the scan on their side."""

LEAST_GAIN, AS_LIKELY = 0.1, 0.5
"""Threshold in log likelihood: minimum gain of a new maximum; and maximum loss of the mean against the maximum."""

FAR_BETWEEN, UNSURE, MOST_MORE, FINER = 1.01, 0.08, 12, 20
"""Maximum distance of likely values, in first reaches; maximum share of the likelihood that is uncertain between two
values; maximum number of further values for each; interpolation steps between two values."""

HOLLOWS, APART_ROWS = 3, 20
"""Onsets tried for effects with internal states, and minimum distance between them."""

WITHIN_ROW = 0.15
"""Minimum standard deviation of an onset in rows, because an effect in part of a row enters by its mean over the
row."""

LARGEST_SHARE = 0.05
"""Maximum first reach, as a fraction of the record."""

SIZE_SHARE = 0.005
"""First reach of a magnitude without a derivative, as a fraction of it."""


def refine(
    search: Search, best: FittedHypothesis, sds: Sequence[Array]
) -> tuple[FittedHypothesis, list[dict[int, float]]]:
    """Move the rough parameters of the best hypothesis to the maximum of their likelihood.

    Args:
        search: search that found it.
        best: hypothesis with or without effects.
        sds: standard deviations of each effect's parameters, by the fit.

    Returns:
        The hypothesis; and for each effect, the standard deviations of its rough parameters by index.
    """
    result = []
    for index, (effect, profile) in enumerate(
        zip(best.hypothesis.filter.effects, best.hypothesis.profiles, strict=True)
    ):
        rough: dict[int, float] = {}
        names = [item.name for item in profile.nonlinear_parameters]
        if not effect.has_derivative and profile.n_linear == 1:
            reach = SIZE_SHARE * abs(float(best.fit.parameters[index][0]))
            best, rough[0] = _Scan(search, index, 0, reach, (effect.lower, effect.upper)).refine(best)
        if "onset" in names:
            if isinstance(profile, Step) and effect in search.screen.dynamic_effects:
                best = _leave_local_optimum(search, best, index)
            number = profile.n_linear + names.index("onset")
            # Without derivatives there is no standard deviation from them.
            sd = float(sds[index][number]) if effect.has_derivative else 0.0
            reach = min(float(np.hypot(sd, profile.period_min)), LARGEST_SHARE * search.run.span_min)
            bounds = (profile.start_min, profile.end_min)
            best, sd = _Scan(search, index, number, reach, bounds).refine(best)
            rough[number] = max(sd, WITHIN_ROW * profile.period_min)
        result.append(rough)
    return best, result


def _leave_local_optimum(search: Search, best: FittedHypothesis, index: int) -> FittedHypothesis:
    """Try the onsets at which the innovations with the effect become better than those without it."""
    run, hypothesis = search.run, best.hypothesis
    (total,) = onset_losses(run, hypothesis, best.fit, index, best.fit.parameters[index][:1])
    for _ in range(HOLLOWS):
        row = int(np.argmin(total))
        trial = _evaluate(search, best, index, 1, float(run.time_min[row]))
        if trial.loss < best.fit.loss - LEAST_GAIN:
            best = search.fit(hypothesis, trial.parameters)
        total[max(row - APART_ROWS, 0) : row + APART_ROWS] = np.inf
    return best


class _Scan:
    """Scan of the likelihood along one parameter of an effect, from an initial reach on and within bounds."""

    def __init__(self, search: Search, index: int, number: int, reach: float, bounds: tuple[float, float]) -> None:
        self._search, self._place, self._number, self._reach, self._bounds = search, index, number, reach, bounds

    def refine(self, best: FittedHypothesis) -> tuple[FittedHypothesis, float]:
        """Move the parameter to the nearby maximum, or to the mean if it is as likely; also its standard deviation."""
        for _ in range(ROUNDS):
            here = float(best.fit.parameters[self._place][self._number])
            fits = {here: best.fit}
            far = OFFSETS[-1] * self._reach
            sides = [list(self._values_to_side(here, side)) for side in (-1.0, 1.0)]
            self._try(best, fits, [value for side in sides for value in side if abs(value - here) <= far])
            further = [[value for value in side if abs(value - here) > far] for side in sides]
            while further := [side for side in further if side]:
                self._try(best, fits, [side[0] for side in further])
                further = [side[1:] for side in further if fits[side[0]].loss <= best.fit.loss + OUT_OF_QUESTION]
            likeliest = min(fits.values(), key=lambda item: item.loss)
            if likeliest.loss > best.fit.loss - LEAST_GAIN:
                break
            best = self._search.fit(best.hypothesis, likeliest.parameters)
        self._fill_gaps(best, fits)
        mean, _ = _moments(fits, here)
        trial = _evaluate(self._search, best, self._place, self._number, mean)
        if trial.loss < best.fit.loss + AS_LIKELY:
            best, here = self._search.score_fit(best.hypothesis, trial), mean
        return best, _moments(fits, here)[1]

    def _fill_gaps(self, best: FittedHypothesis, fits: dict[float, Fit]) -> None:
        """Try more values where another maximum may be: in wide gaps between likely values, and on steep flanks."""
        for _ in range(MOST_MORE // LANES):
            values, above = self._values(best, fits)
            width = np.where(np.maximum(above[1:], above[:-1]) < OUT_OF_QUESTION, np.diff(values), 0.0)
            if not self._bisect(best, fits, width, FAR_BETWEEN * self._reach):
                break
        for _ in range(MOST_MORE // LANES):
            values, above = self._values(best, fits)
            likelihood = np.exp(-above)
            unsure = np.diff(values) * np.abs(np.diff(likelihood))
            if not self._bisect(best, fits, unsure, UNSURE * float(np.trapezoid(likelihood, values))):
                break

    def _values(self, best: FittedHypothesis, fits: dict[float, Fit]) -> tuple[Array, Array]:
        """Values tried, in order, and their loss above the best."""
        values = sorted(fits)
        return np.array(values), np.array([fits[value].loss - best.fit.loss for value in values])

    def _bisect(self, best: FittedHypothesis, fits: dict[float, Fit], of_each: Array, least: float) -> bool:
        """Try the middle of the intervals with the largest measure above `least`; return true if there are any."""
        values, most = sorted(fits), np.argsort(-of_each)[:LANES].tolist()
        middles = [0.5 * (values[index] + values[index + 1]) for index in most if of_each[index] > least]
        self._try(best, fits, middles)
        return bool(middles)

    def _try(self, best: FittedHypothesis, fits: dict[float, Fit], values: Sequence[float]) -> None:
        fits.update(zip(values, _evaluate_all(self._search, best, self._place, self._number, values), strict=True))

    def _values_to_side(self, here: float, side: float) -> Iterator[float]:
        """Values to try within the bounds, further and further away."""
        offsets = [*OFFSETS, *(OFFSETS[-1] * 2.0**power for power in range(1, WIDENINGS + 1))]
        before = here
        for offset in offsets:
            value = min(max(here + side * offset * self._reach, self._bounds[0]), self._bounds[1])
            if value != before:
                yield value
            before = value


def _moments(fits: dict[float, Fit], here: float) -> tuple[float, float]:
    """Mean of the likelihood along a parameter, and root mean square distance from a value."""
    tried = sorted(fits)
    fine = [np.linspace(*pair, FINER, endpoint=False) for pair in pairwise(tried)]
    values = np.array([*np.concatenate(fine), tried[-1]]) if fine else np.array(tried)
    losses = np.interp(values, tried, [fits[item].loss for item in tried])
    likelihood = np.exp(-(losses - losses.min()))
    total = float(np.trapezoid(likelihood, values))
    if total <= 0.0:  # the bounds coincide
        return here, 0.0
    mean, square = (float(np.trapezoid(likelihood * item, values)) / total for item in (values, (values - here) ** 2))
    return mean, square**0.5


def _evaluate(search: Search, best: FittedHypothesis, index: int, number: int, value: float) -> Fit:
    return _evaluate_all(search, best, index, number, [value])[0]


def _evaluate_all(
    search: Search, best: FittedHypothesis, index: int, number: int, values: Sequence[float]
) -> list[Fit]:
    """Evaluate other values of one parameter of one effect."""
    tried = [best.fit.parameters[index].copy() for _ in values]
    for parameters, value in zip(tried, values, strict=True):
        parameters[number] = value
    return list(best.hypothesis.evaluate_values(search.run, best.fit, index, tried))


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
    """Convert the times of causes to minutes of the run in which they set in, and mark those from its beginning.

    Args:
        causes: causes with times that increase over all runs (`Record.continuous_min`).
        record: record that they explain.
    """
    starts_min = record.continuous_min[list(record.run_starts)]
    result = []
    for cause in causes:
        times = {name for name in cause.parameters if name in ("onset", "end") or name.startswith("time_")}
        times.discard("time_constant")
        first_min = min((cause.parameters[name].value for name in times), default=-inf)
        run = max(int(np.searchsorted(starts_min, first_min, side="right")), 1)
        if (onset := cause.parameters.get("onset")) is not None:
            begins = bool(onset.value - starts_min[run - 1] <= 2.0 * onset.sd)
            cause = structs.replace(cause, from_beginning=begins)
        if len(record.run_starts) == 1:
            result.append(cause)
            continue
        shift_min = record.run_shifts_min[run - 1]
        parameters = {
            name: structs.replace(item, value=item.value - shift_min) if name in times else item
            for name, item in cause.parameters.items()
        }
        result.append(structs.replace(cause, parameters=parameters, run=run, run_shift_min=shift_min))
    return tuple(result)


def hypothesis_causes(best: FittedHypothesis, covariances: Sequence[Array]) -> list[Cause]:
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
        causes.append(make_cause(effect, profile.name, parameters))
    return causes


WITHIN = 1.0 - 1e-12
"""Factor for a knot at an effect's bounds: it is stored as a fraction of the size, and their product is rounded."""


def extended_model(
    model: ProcessModel,
    effects: Sequence[Effect],
    causes: Sequence[Cause],
    zero_ns: int = 0,
    law: ExtendedLaw | None = None,
) -> dict[str, Any]:
    """Extended model with the causes, as in its file (`reactorwatch.process.extended_model`).

    Args:
        model: process model of the simulation; the effects that it has already stay.
        effects: the catalogue.
        causes: diagnosed causes.
        zero_ns: time from which the record's minutes count; 0: not known.
        law: law of an unknown; None: none.
    """
    named = {effect.name: effect for effect in effects}
    before = extended_model_of(model, effects, zero_ns=zero_ns)
    result = [_specification(named[cause.cause], cause) for cause in causes]
    new_laws = () if law is None else (law,)
    found = replace(before, effects=(*before.effects, *result), laws=(*before.laws, *new_laws))
    if not (is_complete(before, model) and are_named(found)):
        found = replace(found, equations=extend(model, result, new_laws))
    return found.to_object()


def _specification(effect: Effect, cause: Cause) -> FaultSpecification:
    values = {name: estimate.value for name, estimate in cause.parameters.items()}
    size = values["size"] = min(max(values["size"], effect.lower), effect.upper)
    if cause.profile != FREE_NAME:
        return FaultSpecification(effect, next(item for item in PROFILES if item.name == cause.profile), values)
    shares = {name: share for name, share in values.items() if name.startswith("value_")}
    for name, share in shares.items():
        values[name] = share if effect.lower <= size * share <= effect.upper else WITHIN * share
    return FaultSpecification(effect, free_profile(len(shares)), values)
