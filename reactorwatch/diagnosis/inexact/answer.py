"""Report of explanations with nuisance: causes, nuisance, errors, curves and the extended model."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from msgspec import structs

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.decide import Graded
from reactorwatch.diagnosis.inexact.explain import Explained, Explanation
from reactorwatch.diagnosis.inexact.hypotheses import CONSTANT, CURVE, RAMP, STEP
from reactorwatch.diagnosis.result import Cause, Curves, Estimate, Nuisance, make_cause
from reactorwatch.process.effect import ParameterEffect, ParameterShift, SensorEffect
from reactorwatch.process.model import ProcessModel

WORTH = 2.0
"""Nuisance is reported if it is more than this many of its standard deviations from 0."""


def grades(item: Explanation, explained: Explained, tolerances: Array) -> Graded:
    """Numbers that a verdict depends on.

    Args:
        item: an explanation.
        explained: all of them.
        tolerances: tolerance of each output, shape (n_y,).
    """
    lead = 2.0 * (item.log_evidence - explained.none.log_evidence)
    left, effect = (float(np.max(each / tolerances)) for each in (item.left, item.effect_size))
    return Graded(lead, item.share, left, effect, CONSTANT if item.effect is None else item.fitted.hypothesis.kind)


def causes_of(item: Explanation, explained: Explained) -> list[Cause]:
    """The cause of an explanation; then under their own names those that do the same in this record."""
    if item.effect is None:
        return []
    knots, result = explained.courses.knots, list[Cause]()
    for fitted in (item, *item.same):
        effect = fitted.effect
        assert effect is not None  # it is no nuisance alone
        hypothesis, of_own = fitted.fitted.hypothesis, _own_factor(fitted, explained)
        parameters = {"size": Estimate(hypothesis.size / of_own, fitted.size_sd / of_own, effect.unit)}
        if hypothesis.kind in (STEP, RAMP):
            sd = float(np.hypot(fitted.fitted.onset_sd, _sensor_time_sd(fitted, explained)))
            parameters["onset"] = Estimate(hypothesis.onset, sd, "min")
        if hypothesis.kind == RAMP:
            parameters["end"] = Estimate(float(explained.courses.time_min[-1]), 0.0, "min")
        if hypothesis.kind == CURVE:
            shares = fitted.fitted.curve / hypothesis.size if hypothesis.size else np.zeros(knots.size)
            parameters |= {f"time_{i}": Estimate(float(t), 0.0, "min") for i, t in enumerate(knots, start=1)}
            parameters |= {f"value_{i}": Estimate(float(v), 0.0, "1") for i, v in enumerate(shares, start=1)}
        cause = make_cause(effect, hypothesis.kind, parameters)
        result.append(structs.replace(cause, share=item.share, probability=item.probability))
    return result


def _sensor_time_sd(item: Explanation, explained: Explained) -> float:
    """Standard deviation of the time at which a sensor's error set in, beyond that of the fit; 0 for other causes.

    No row tells when between two of them it did, and it is stamped as early or late as all that the sensor shows.
    """
    if not isinstance(item.effect, SensorEffect):
        return 0.0
    nuisance = explained.nuisance
    delay = nuisance.output_delays.start + nuisance.simulation.model.output_names.index(item.effect.output)
    return float(np.hypot(explained.courses.period_min / 12.0**0.5, item.fitted.theta_sd[delay]))


def _own_factor(item: Explanation, explained: Explained) -> float:
    """Value that nuisance gives to the parameter of a cause, over its nominal one: a size is a share of that value."""
    hypothesis, nuisance = item.fitted.hypothesis, explained.nuisance
    if hypothesis.kind == CONSTANT or not isinstance(item.effect, ParameterEffect):
        return 1.0
    return float(item.effect.deviate(1.0, float(item.fitted.theta[nuisance.effects.start + hypothesis.effect])))


def nuisance_of(item: Explanation, explained: Explained) -> tuple[Nuisance, ...]:
    """Nuisance that differs from 0, but for initial states and the times of single moves."""
    nuisance, fitted = explained.nuisance, item.fitted
    sds = nuisance.sds(fitted.hypothesis.prior)
    result = []
    for index in range(nuisance.effects.start, nuisance.output_lags.stop):
        if fitted.hypothesis.kind == CONSTANT and index == fitted.hypothesis.effect:
            continue
        value, sd = float(fitted.theta[index]), float(fitted.theta_sd[index])
        if abs(value) <= WORTH * sd:
            continue
        is_effect = index < nuisance.effects.stop
        unit = nuisance.simulation.effects[index - nuisance.effects.start].unit if is_effect else "min"
        result.append(Nuisance(nuisance.names[index], Estimate(value, sd, unit), float(sds[index])))
    return tuple(result)


def relative_delays(item: Explanation, explained: Explained) -> tuple[Nuisance, ...]:
    """Delays of inputs against the mean of the outputs that differ from 0, where none of these does alone.

    Times are known only against each other: a later input and earlier outputs are the same to a simulation.
    """
    nuisance, fitted, result = explained.nuisance, item.fitted, list[Nuisance]()
    sds, n_y = nuisance.sds(fitted.hypothesis.prior), len(nuisance.simulation.model.outputs)
    for index in range(nuisance.input_delays.start, nuisance.input_delays.stop):
        weights = np.zeros(len(fitted.information))
        weights[nuisance.output_delays], weights[index] = 1.0 / n_y, 1.0
        own, used = weights[: nuisance.size], np.flatnonzero(weights)
        value, sd = float(own @ fitted.theta), float(np.sqrt(weights @ np.linalg.solve(fitted.information, weights)))
        if abs(value) > WORTH * sd and np.all(np.abs(fitted.theta[used]) <= WORTH * fitted.theta_sd[used]):
            prior_sd = float(np.linalg.norm(own * sds))
            result.append(Nuisance(nuisance.names[index], Estimate(value, sd, "min"), prior_sd))
    return tuple(result)


def adjusted_model(item: Explanation, explained: Explained, model: ProcessModel) -> ProcessModel:
    """The model with the nuisance of its parameters in their values."""
    nuisance, values = explained.nuisance, dict[str, float]()
    for effect, eta in zip(nuisance.simulation.effects, item.fitted.theta[nuisance.effects].tolist(), strict=True):
        if not isinstance(effect, (ParameterEffect, ParameterShift)):
            continue
        if effect is item.effect and item.fitted.hypothesis.kind == CONSTANT:  # that is the cause
            continue
        proportional = effect.proportional if isinstance(effect, ParameterEffect) else ()
        for name in (effect.parameter, *proportional):
            known = model.parameter(name)
            value = float(effect.deviate(values.get(name, known.value), eta))
            values[name] = min(max(value, known.lower), known.upper)
    return model.with_values(values)


def curves_with(item: Explanation, explained: Explained, curves: Curves) -> Curves:
    """Curves of an explanation in the place of those without nuisance."""
    nuisance, fitted = explained.nuisance, item.fitted
    names = nuisance.simulation.model.output_names
    after = nuisance.read(fitted.simulated, fitted.theta)
    residual = np.column_stack([curves.measured[name] for name in names]) - after
    deviation = dict[str, Array]()
    if item.effect is not None:
        if fitted.hypothesis.kind == CONSTANT:
            deviation[item.effect.name] = np.full(len(after), fitted.hypothesis.size)
        else:
            course = fitted.simulated.deviation.sample_value[:, fitted.hypothesis.effect]
            deviation[item.effect.name] = course - fitted.theta[nuisance.effects][fitted.hypothesis.effect]
    known = {name: item.size_sd * np.abs(m) / max(np.max(np.abs(m)), 1e-300) for name, m in deviation.items()}
    return replace(
        curves,
        simulated_after=dict(zip(names, after.T, strict=True)),
        residual_after=dict(zip(names, (residual / explained.noise_sd).T, strict=True)),
        deviation=deviation,
        deviation_sd=known,
        unknown=None,
    )


def onset_of(causes: Sequence[Cause]) -> Estimate | None:
    """Onset of the first cause that has one."""
    return next((cause.parameters["onset"] for cause in causes if "onset" in cause.parameters), None)
