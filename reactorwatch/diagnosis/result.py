"""Result of a diagnosis: its fields are those of `diagnose --json`, but for what only texts and figures need."""

from dataclasses import dataclass, field
from math import nan
from typing import Any, ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.difference import Difference
from reactorwatch.process.effect import Effect
from reactorwatch.process.law import ExtendedLaw
from reactorwatch.results.base import Result

NOMINAL, NAMED, AMBIGUOUS, UNKNOWN = "nominal", "named", "ambiguous", "unknown"

RIGHT, EXPLAINED, MOSTLY, NEAREST, UNEXPLAINED = "right", "explained", "mostly", "nearest", "unknown"
"""Grades of a verdict, see `diagnosis.decide`."""

SD_95 = 1.959964
"""Half width of the 95 % interval of a normal distribution, in standard deviations."""

LISTED = 10.0
"""Threshold in BIC: alternatives that are worse by less are listed."""


class Estimate(Result, frozen=True):
    """A number with its standard deviation, in a unit."""

    value: float
    sd: float
    unit: str

    @property
    def half_width(self) -> float:
        """Half width of the 95 % interval."""
        return SD_95 * self.sd


class Cause(Result, frozen=True, kw_only=True):
    """A cause that is part of an explanation.

    Attributes:
        cause: name in the catalogue.
        profile: name of its profile in time.
        label: label for users.
        location: location where it acts.
        run: number of the run of the record in which it sets in, from 1; None: the record has one.
        parameters: `size` first, then those of the profile; times in minutes of that run.
        run_shift_min: shift from minutes of that run to `Record.continuous_min`.
        share: share of the squared simulation error beyond noise and nuisance that its explanation removes on held-out
            rows.
        probability: probability of that explanation.
        beside: names of the other causes of that explanation.
        from_beginning: true if its onset is within two standard deviations of the beginning of its run.
    """

    cause: str
    profile: str
    label: str
    location: str
    run: int | None = None
    parameters: dict[str, Estimate]
    run_shift_min: float = 0.0
    share: float = nan
    probability: float = nan
    beside: tuple[str, ...] = ()
    from_beginning: bool = False

    python_only: ClassVar = ("run_shift_min", "from_beginning")


def make_cause(effect: Effect, profile: str, parameters: dict[str, Estimate]) -> Cause:
    """Cause by an effect with a profile, under the name and the label that the effect has then."""
    label = effect.labels.get(profile, effect.label)
    return Cause(cause=effect.name, profile=profile, label=label, location=effect.location, parameters=parameters)


class AdjustedParameter(Result, frozen=True):
    """An uncertain parameter with its estimate, the posterior of prior and record.

    Attributes:
        nominal: value of the parameter in the nominal model.
        stated_sd: standard deviation of its prior.
        value: value of the estimate.
        sd: standard deviation of the estimate.
        unit: unit of all of them.
    """

    nominal: float
    stated_sd: float
    value: float
    sd: float
    unit: str

    @property
    def prior(self) -> Estimate:
        """The prior."""
        return Estimate(self.nominal, self.stated_sd, self.unit)

    @property
    def estimate(self) -> Estimate:
        """The posterior."""
        return Estimate(self.value, self.sd, self.unit)

    @property
    def differs(self) -> bool:
        """True if the nominal value is outside the 95 % interval."""
        return abs(self.value - self.nominal) > self.estimate.half_width


class Alternative(Result, frozen=True):
    """An alternative explanation.

    Attributes:
        explanation: causes of the alternative; `causes` in JSON.
        delta_bic: BIC of the alternative minus that of the named explanation.
        share: see `Cause`.
        probability: see `Cause`.
    """

    explanation: tuple[Cause, ...] = msgspec.field(name="causes")
    delta_bic: float
    share: float = nan
    probability: float = nan

    @property
    def causes(self) -> tuple[tuple[str, str], ...]:
        """(cause, profile) of each of its causes."""
        return tuple((item.cause, item.profile) for item in self.explanation)


class Nuisance(Result, frozen=True):
    """A small difference between plant and model beside the causes.

    Attributes:
        name: an effect of the catalogue, or `<signal>.lag` or `<signal>.delay` (negative: an output is measured
            after its stamp, an input acts before it).
        value: estimate of it.
        prior_sd: standard deviation of its prior; None: it is a small correction that was found without one.
    """

    name: str
    value: Estimate
    prior_sd: float | None


class Remaining(Result, frozen=True):
    """Simulation error of an output that is left.

    Attributes:
        rmse: root mean square error on held-out rows.
        noise_sd: standard deviation of the sensor's noise.
        unit: unit of both.
        location: location where what is left acts; None: unknown.
    """

    rmse: float
    noise_sd: float
    unit: str
    location: str | None


class LocationEvidence(Result, frozen=True):
    """BIC of a location over that of the best."""

    location: str
    delta_bic: float


class HeldOut(Result, frozen=True):
    """Errors of one output on rows that were not fitted, in its unit.

    Attributes:
        rmse_before: error of the nominal model's simulation.
        rmse_after: error of the extended model's simulation.
        one_step_before: error of the nominal model's one-step-ahead prediction.
        one_step_after: error of the extended model's one-step-ahead prediction.
        noise_sd: standard deviation of the sensor's noise, below which no model comes.
        unit: unit of all of them.
    """

    rmse_before: float
    rmse_after: float
    one_step_before: float
    one_step_after: float
    noise_sd: float
    unit: str

    python_only: ClassVar = ("one_step_before", "one_step_after")


class Gain(Result, frozen=True):
    """Gain of the extended model.

    Attributes:
        delta_bic: BIC of the nominal model minus that of the extended one.
        held_out: errors on held-out rows, by output.
    """

    delta_bic: float
    held_out: dict[str, HeldOut]


class Adequacy(Result, frozen=True):
    """Whiteness of the innovations of an output: minus the decimal logarithm of its p-value."""

    minus_log10_p: float


class Separation(Result, frozen=True):
    """Separation of two explanations by an experiment.

    Attributes:
        between: names of the explanations, the causes of each joined by a plus.
        expected_delta_bic: expected BIC of the wrong one minus that of the true one; `delta_bic` in JSON.
        probability: probability that this difference exceeds `LISTED`.
    """

    between: tuple[str, str]
    expected_delta_bic: float = msgspec.field(name="delta_bic")
    probability: float


@dataclass(frozen=True, eq=False)
class ExperimentCurves:
    """Curves for the figures of an experiment, all over its rows.

    Attributes:
        time_min: time from its start, shape (rows,).
        level: level of the input that is moved.
        outputs: noise-free outputs by explanation and output.
    """

    time_min: Array
    level: Array
    outputs: dict[str, dict[str, Array]]


class Experiment(Result, frozen=True, kw_only=True):
    """An input that separates alternatives.

    Attributes:
        why: the expected result, in a sentence.
        input: (minute, value) of each change; with several inputs by input, those at rest with one level.
        separates: explanations that it separates, each its causes joined by a plus.
        signal: input that is moved; the others rest.
        span_min: duration.
        expected_delta_bic: expected difference in BIC between the two nearest of them.
        probability: probability that this difference exceeds `LISTED`.
        limits: limits by signal that it keeps under every explanation.
        separations: separation of every pair of explanations; `expected` in JSON.
        predicted: lowest and highest noise-free value, by explanation and output.
        curves: curves for figures.
    """

    why: str
    input: tuple[tuple[float, float], ...] | dict[str, tuple[tuple[float, float], ...]]
    separates: tuple[str, ...]
    signal: str
    span_min: float
    expected_delta_bic: float
    probability: float
    limits: dict[str, tuple[float, float]]
    separations: tuple[Separation, ...] = msgspec.field(name="expected")
    predicted: dict[str, dict[str, tuple[float, float]]]
    curves: ExperimentCurves | None = None

    python_only: ClassVar = ("curves",)


@dataclass(frozen=True, eq=False)
class UnknownInputCurve:
    """Course of an unknown input in time, as the magnitude of an effect that acts in the same way.

    Attributes:
        label: label of that effect.
        unit: unit of its magnitude.
        size: m(t), shape (rows,).
    """

    label: str
    unit: str
    size: Array


@dataclass(frozen=True, eq=False)
class LawCurve:
    """A missing term over one variable, averaged over the record's rows with nearly the same value of it.

    Attributes:
        variable: name of the variable.
        unit: unit of the variable.
        values: values of the variable, shape (n,).
        smooth: smooth correction, shape (n,).
        smooth_sd: standard deviation of the smooth correction, shape (n,).
        formula: formula, shape (n,).
    """

    variable: str
    unit: str
    values: Array
    smooth: Array
    smooth_sd: Array
    formula: Array


class RivalLaw(Result, frozen=True):
    """A formula that the record cannot tell from the law, worse by `delta_bic`."""

    location: str
    form: str
    formula: str
    delta_bic: float


class Correlation(Result, frozen=True):
    """Correlation with an estimate, if a parameter of the model were uncertain.

    Attributes:
        parameter: name of the parameter.
        correlation: the correlation.
    """

    parameter: str
    correlation: float


class Law(Result, frozen=True, kw_only=True):
    """Law of an unknown: the missing term as a formula.

    Attributes:
        location: location in which it acts.
        form: family of the formula.
        formula: formula with the names of variables and parameters.
        term: what the formula is added to, in words.
        unit: unit of the formula's value.
        variables: names of its variables.
        parameters: parameters by name.
        rivals: formulas within `LISTED` BIC, the best first.
        range: smallest and largest value of each variable with which it was seen.
        held_out: errors on held-out rows, by output.
        correlations: for each parameter, the model's parameter with which its estimate would be correlated most if
            that were uncertain.
        extended: law for the extended model.
        curves: curves for figures, one for each variable.
    """

    location: str
    form: str
    formula: str
    term: str
    unit: str
    variables: tuple[str, ...]
    parameters: dict[str, Estimate]
    rivals: tuple[RivalLaw, ...]
    range: dict[str, tuple[float, float]]
    held_out: dict[str, HeldOut]
    correlations: dict[str, Correlation]
    extended: ExtendedLaw
    curves: tuple[LawCurve, ...] = ()

    python_only: ClassVar = ("extended", "curves")


@dataclass(frozen=True, eq=False)
class Curves:
    """Curves for the figures of a diagnosis, all over the rows of the record.

    Attributes:
        time_min: shape (rows,).
        inputs: inputs by name.
        measured: measurements by output; NaN where missing.
        simulated_before: simulation by the nominal model, by output.
        simulated_after: simulation by the extended model, by output.
        residual_before: innovations of the nominal model's filter in standard deviations, by output.
        residual_after: innovations of the extended model's filter in standard deviations, by output.
        deviation: m(t) of each cause, by its name.
        deviation_sd: standard deviation of m(t), by name.
        unknown: course of an unknown input; None without one.
        held_out: mask of the values on which errors before and after are evaluated, by output.
    """

    time_min: Array
    inputs: dict[str, Array]
    measured: dict[str, Array]
    simulated_before: dict[str, Array]
    simulated_after: dict[str, Array]
    residual_before: dict[str, Array]
    residual_after: dict[str, Array]
    deviation: dict[str, Array]
    deviation_sd: dict[str, Array]
    unknown: UnknownInputCurve | None = None
    held_out: dict[str, NDArray[np.bool_]] = field(default_factory=dict)


class Diagnosis(Result, frozen=True, kw_only=True):
    """Result of a diagnosis.

    Attributes:
        file: name of the record.
        zero: clock time from which the minutes count, ISO 8601; None: unknown.
        samples: number of rows of the record.
        runs: number of runs in the record.
        span_min: duration from its first row to its last, summed over its runs.
        seconds: duration of the diagnosis; 0: not measured.
        verdict: `nominal`, `named`, `ambiguous` or `unknown`.
        grade: `right`, `explained`, `mostly`, `nearest` or `unknown`, see `diagnosis.decide`.
        causes: causes that explain the record together; empty if nominal or unknown.
        alternatives: every other explanation within 10 BIC, the best first.
        nearest: causes of the best five explanations, whatever the verdict.
        onset: onset of the best explanation that has one.
        nuisance: what was fitted beside the causes.
        remaining: what is left, by output.
        location: location of the deviation; None if nominal.
        locations: BIC of each location within `LISTED` over that of the best; empty where causes explain the record.
        law: law of an unknown; None without one.
        significant: true if the nominal model is refuted statistically.
        practical: true if the difference exceeds the user's tolerance.
        gain: gain of the extended model.
        adequacy: whiteness of the innovations, by output.
        experiment: experiment that would separate the alternatives; None if there is none.
        extended_model: extended model as in its file (`diagnosis.extended_model`).
        parameters: uncertain parameters, by name.
        differences: differences between simulation and record, by output; in JSON only in a report.
        remarks: further remarks, in sentences.
        curves: curves for figures; with several runs, over `Record.continuous_min`.
        with_nuisance: true if the explanations are those with nuisance: simulated, not filtered.
        relative_delays: delays of inputs against the outputs, where neither delay alone differs from 0.
    """

    file: str
    zero: str | None
    samples: int
    runs: int
    span_min: float
    seconds: float
    verdict: str
    grade: str
    causes: tuple[Cause, ...]
    alternatives: tuple[Alternative, ...]
    nearest: tuple[Cause, ...]
    onset: Estimate | None
    nuisance: tuple[Nuisance, ...]
    remaining: dict[str, Remaining]
    location: str | None
    locations: tuple[LocationEvidence, ...]
    law: Law | None
    significant: bool
    practical: bool
    gain: Gain
    adequacy: dict[str, Adequacy]
    experiment: Experiment | None
    extended_model: dict[str, Any]
    parameters: dict[str, AdjustedParameter] = msgspec.field(default_factory=dict)
    differences: dict[str, Difference]
    remarks: tuple[str, ...] = ()
    curves: Curves | None = None
    with_nuisance: bool = False
    relative_delays: tuple[Nuisance, ...] = ()

    python_only: ClassVar = ("differences", "remarks", "curves", "with_nuisance", "relative_delays")

    @property
    def is_extended(self) -> bool:
        """True if causes or a law extend the model."""
        return bool(self.causes) or self.law is not None
