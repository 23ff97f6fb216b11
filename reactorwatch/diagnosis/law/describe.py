"""The law of an unknown as a result: intervals, correlations, rivals, curves and the gain on held-out rows."""

from collections.abc import Mapping, Sequence
from math import log

import msgspec
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Fit, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant
from reactorwatch.diagnosis.fitting.signatures import inverse
from reactorwatch.diagnosis.law.fit import ShapeFit
from reactorwatch.diagnosis.law.shapes import coefficient_effect, variables_along
from reactorwatch.diagnosis.law.unknown import FittedLaw, Unknown
from reactorwatch.diagnosis.parameter_priors import add_priors
from reactorwatch.diagnosis.result import LISTED, Correlation, Estimate, HeldOut, Law, LawCurve, RivalLaw
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis
from reactorwatch.process.law import CAPACITY, FACTOR, INPUT, SOURCE, ExtendedLaw, find_form, unit_of, unit_of_variable
from reactorwatch.process.model import Place, ProcessModel

BINS = 30
"""Number of points of a curve, each the mean of as many rows."""

LEAST_CORRELATION = 0.5


def law_hypothesis(
    law: FittedLaw, run: Run, model: ProcessModel, uncertain: Mapping[str, float]
) -> tuple[ExtendedLaw, FittedHypothesis]:
    """The law, and a hypothesis whose parameters shift those with which its fit began.

    A law is found with the uncertain parameters as the nominal filter estimates them, and that filter takes part of the
    law for their offsets. So here they are states again, from the stated values, and the law is fitted with them.

    Args:
        law: the law as it was found.
        run: the record.
        model: process model with the stated values.
        uncertain: standard deviations of its uncertain parameters, by name.
    """
    shape, fit = law.fit.shape, law.fit
    stated = {name: model.parameter(name).value for name in uncertain}
    plant = add_priors(shape.model.with_values(stated), uncertain)
    ekf = FaultFilter(plant, [coefficient_effect(name) for name in shape.parameters], fit.noise, run.period_min)
    hypothesis = Hypothesis(ekf, [Constant(run.time_min)] * fit.coefficients.size)
    parameters = tuple(np.array([value]) for value in fit.coefficients)
    if not uncertain:
        return law.law, FittedHypothesis(hypothesis, Fit(parameters, *fit.evaluation), law.bic)
    refitted = hypothesis.fit(run, parameters)
    moved = zip(law.law.parameters.items(), parameters, refitted.parameters, strict=True)
    values = {name: value + float((now - before)[0]) for (name, value), before, now in moved}
    bic = 2.0 * refitted.loss + len(values) * log(run.values)
    return msgspec.structs.replace(law.law, parameters=values), FittedHypothesis(hypothesis, refitted, bic)


def describe_law(
    model: ProcessModel,
    run: Run,
    found: Unknown,
    law: ExtendedLaw,
    covariances: Sequence[Array],
    held_out: dict[str, HeldOut],
) -> Law:
    """Describe the best law.

    Args:
        model: process model without the law.
        run: the record.
        found: evidence with at least one law.
        law: the best law as it is reported, see `law_hypothesis`.
        covariances: covariance of each of its parameters, marginal over the others.
        held_out: errors on held-out rows, by output.
    """
    best, units = found.laws[0], law.units(model)
    parameters = {
        name: Estimate(value, float(np.sqrt(max(part[0, 0], 0.0))), units[name])
        for (name, value), part in zip(law.parameters.items(), covariances, strict=True)
    }
    rivals = tuple(
        RivalLaw(item.place.location, find_form(item.law.form).form, item.law.formula(), item.bic - best.bic)
        for item in found.laws[1:]
        if item.bic < best.bic + LISTED
    )
    smooth = next(item for item in found.places if item.place.name == best.place.name)
    return Law(
        location=best.place.location,
        form=find_form(law.form).form,
        formula=law.formula(),
        term=describe_term(best.place),
        unit=unit_of(model, best.place),
        variables=law.variables,
        parameters=parameters,
        rivals=rivals,
        range=dict(law.range),
        held_out=held_out,
        correlations=_correlations(model, run, best),
        extended=law,
        curves=_curves(model, run, law, smooth),
    )


def describe_term(place: Place) -> str:
    """Describe the term that a correction in a place changes."""
    if place.kind == SOURCE:
        return f"added to d{place.of}/dt"
    if place.kind == FACTOR:
        return f"factor 1 + ... of {' and '.join(place.flows.values())}"
    if place.kind == CAPACITY:
        return f"d{place.of}/dt is divided by 1 + ..."
    return f"added to the {'input' if place.kind == INPUT else 'reading of'} {place.of}"


def _curves(model: ProcessModel, run: Run, law: ExtendedLaw, smooth: ShapeFit) -> tuple[LawCurve, ...]:
    """Smooth correction and formula over each variable of the law."""
    x = smooth.evaluation.innovations.x
    variables = variables_along(model, run, x, smooth.place, smooth.lag_min)
    formula = find_form(law.form).expression(
        [variables[name] for name in law.variables], list(law.parameters.values()), law.references
    )
    basis = smooth.shape.basis(x, run.inputs)[:, : len(smooth.shape.terms)]
    active = np.flatnonzero(smooth.coefficients[: basis.shape[1]])
    information, _ = smooth.fitter.normal_equations(smooth)
    covariance = inverse(information[np.ix_(active, active)])
    known = np.all(np.isfinite(basis), axis=1)
    result = []
    for name in law.variables:
        order = np.flatnonzero(known)[np.argsort(variables[name][known], kind="stable")]
        groups = np.array_split(order, BINS)
        mean = np.array([basis[rows][:, active].mean(axis=0) for rows in groups])
        result.append(
            LawCurve(
                name,
                unit_of_variable(model, name),
                _means(variables[name], groups),
                mean @ smooth.coefficients[active],
                np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", mean, covariance, mean), 0.0)),
                _means(formula, groups),
            )
        )
    return tuple(result)


def _means(values: Array, groups: Sequence[NDArray[np.intp]]) -> Array:
    return np.array([float(np.mean(values[rows])) for rows in groups])


def _correlations(model: ProcessModel, run: Run, best: FittedLaw) -> dict[str, Correlation]:
    """The model's parameter that each parameter of the law is correlated with most, if it were uncertain."""
    names = [item.name for item in model.parameters if item.value != 0.0]
    n_law = best.fit.coefficients.size
    dynamics = best.fit.fitter.dynamics(best.fit, names)
    g = signatures.constant_signatures(dynamics, n_law + len(names))
    result = {}
    for index, name in enumerate(best.law.parameters):
        largest = ("", 0.0)
        for other, parameter in enumerate(names, start=n_law):
            chosen = [*range(n_law), other]
            part = inverse(g[:, chosen].T @ g[:, chosen])
            scale = float(np.sqrt(part[index, index] * part[-1, -1]))
            value = float(part[index, -1]) / scale if scale > 0.0 else 0.0
            largest = max(largest, (parameter, value), key=lambda item: abs(item[1]))
        if abs(largest[1]) >= LEAST_CORRELATION:
            result[name] = Correlation(*largest)
    return result
