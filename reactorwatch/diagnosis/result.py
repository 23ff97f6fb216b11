"""What a diagnosis says."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.difference import Difference

NOMINAL, NAMED, AMBIGUOUS, UNKNOWN = "nominal", "named", "ambiguous", "unknown"

SD_95 = 1.959964
"""Standard deviations to either side that hold 95 % of a normal distribution."""

LISTED = 10.0
"""In BIC: explanations that are worse by less are listed."""


@dataclass(frozen=True)
class Estimate:
    """A number with its standard deviation, in a unit."""

    value: float
    sd: float
    unit: str


@dataclass(frozen=True)
class Cause:
    """A cause that is part of an explanation.

    Attributes:
        cause: name in the catalogue.
        profile: how it goes in time.
        label: what a person calls it.
        location: where it acts.
        parameters: `size` first, then those of the profile; times in minutes of the run in which it sets in.
        run: of the record, in which it sets in, counted from 1.
        run_shift_min: what `Record.continuous_min` adds to the minutes of that run.
    """

    cause: str
    profile: str
    label: str
    location: str
    parameters: dict[str, Estimate]
    run: int = 1
    run_shift_min: float = 0.0


@dataclass(frozen=True)
class Adjusted:
    """A parameter that was stated to be known but roughly, and what the record says of it.

    Attributes:
        nominal: its value in the simulation.
        stated_sd: standard deviation that it was stated to be known to.
        estimate: of it, from what was stated and the record together.
    """

    nominal: float
    stated_sd: float
    estimate: Estimate

    @property
    def off(self) -> bool:
        """Whether the record says that it is not the nominal value: that is out of its 95 % interval."""
        return abs(self.estimate.value - self.nominal) > SD_95 * self.estimate.sd


@dataclass(frozen=True)
class Alternative:
    """Another explanation.

    Attributes:
        explanation: its causes.
        delta_bic: by how much it is worse than the one that is named.
    """

    explanation: tuple[Cause, ...]
    delta_bic: float

    @property
    def causes(self) -> tuple[tuple[str, str], ...]:
        """(cause, profile) of each of its causes."""
        return tuple((item.cause, item.profile) for item in self.explanation)


@dataclass(frozen=True)
class HeldOut:
    """Errors of one output on rows that the fit did not see, in its unit.

    Attributes:
        rmse_before: of the free run of the nominal model.
        rmse_after: of the extended one.
        one_step_before: of the nominal model's prediction of the next row.
        one_step_after: of the extended one's.
        noise_sd: of the sensor: no model comes below.
        unit: of all of them.
    """

    rmse_before: float
    rmse_after: float
    one_step_before: float
    one_step_after: float
    noise_sd: float
    unit: str


@dataclass(frozen=True)
class Gain:
    """What the extended model is better by.

    Attributes:
        delta_bic: of the nominal model over that of the extended one.
        held_out: by output.
    """

    delta_bic: float
    held_out: dict[str, HeldOut]


@dataclass(frozen=True)
class Apart:
    """How well an experiment tells two explanations apart.

    Attributes:
        between: their names, each its causes joined by a plus.
        expected_delta_bic: by how much the wrong one is expected to be worse.
        probability: the probability that it is worse by more than `LISTED`.
    """

    between: tuple[str, str]
    expected_delta_bic: float
    probability: float


@dataclass(frozen=True, eq=False)
class ExperimentCurves:
    """What the pictures of an experiment are drawn from; all over its rows.

    Attributes:
        time_min: from its start, shape (rows,).
        level: of the input that is moved.
        outputs: that each explanation predicts without noise, by its name and the output's.
    """

    time_min: Array
    level: Array
    outputs: dict[str, dict[str, Array]]


@dataclass(frozen=True)
class Experiment:
    """An input that would tell rivals apart.

    Attributes:
        why: in a sentence.
        input: (minute, value) of each change.
        separates: the explanations that it tells apart, each its causes joined by a plus.
        expected_delta_bic: what it is expected to bring between the two nearest of them.
        probability: the probability that it brings more than `LISTED`.
        signal: the input that is moved; the others stay as they were.
        span_min: how long it takes.
        limits: that it keeps under every explanation, by signal.
        apart: of every pair of explanations.
        predicted: the lowest and highest value of each output without noise, by explanation and output.
        curves: for pictures; of several runs, over `Record.continuous_min`.
        runs: of the record.
    """

    why: str
    input: tuple[tuple[float, float], ...]
    separates: tuple[str, ...]
    expected_delta_bic: float
    probability: float
    signal: str
    span_min: float
    limits: dict[str, tuple[float, float]]
    apart: tuple[Apart, ...]
    predicted: dict[str, dict[str, tuple[float, float]]]
    curves: ExperimentCurves | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True, eq=False)
class UnknownCourse:
    """How something that has no name goes in time, told as the size of an effect that pushes at the same place.

    Attributes:
        label: what a person calls that effect.
        unit: of its size.
        size: m(t), shape (rows,).
    """

    label: str
    unit: str
    size: Array


@dataclass(frozen=True, eq=False)
class Curves:
    """What the pictures of a diagnosis are drawn from; all over the rows of the record.

    Attributes:
        time_min: shape (rows,).
        inputs: by name.
        measured: by output; NaN where missing.
        free_before: free run of the nominal model, by output.
        free_after: that of the extended model.
        residual_before: innovations of the nominal model's filter in standard deviations, by output.
        residual_after: those of the extended one's.
        deviation: m(t) of each cause, by its name.
        deviation_sd: its standard deviation.
        unknown: what acts where nothing has a name; None: no such.
        held_out: which values the errors before and after are of, by output.
    """

    time_min: Array
    inputs: dict[str, Array]
    measured: dict[str, Array]
    free_before: dict[str, Array]
    free_after: dict[str, Array]
    residual_before: dict[str, Array]
    residual_after: dict[str, Array]
    deviation: dict[str, Array]
    deviation_sd: dict[str, Array]
    unknown: UnknownCourse | None = None
    held_out: dict[str, NDArray[np.bool_]] = field(default_factory=dict)


@dataclass(frozen=True)
class Diagnosis:
    """What is wrong with a simulation, as far as a record tells.

    Attributes:
        samples: rows of the record.
        span_min: from its first row to its last, summed over its runs.
        verdict: `nominal`, `named`, `ambiguous` or `unknown`.
        causes: that explain the record together; empty if nominal or unknown.
        alternatives: every other explanation within 10 BIC, the best first.
        location: where the deviation acts; empty if nominal.
        significant: whether the nominal model is refuted statistically.
        practical: whether the difference is larger than the user's tolerance.
        differences: of the simulation and the record, by output: where, when, and how much of them is noise.
        gain: what the extended model is better by.
        adequacy: minus the decimal logarithm of the p-value that what is left is white, by output.
        experiment: that would tell the alternatives apart; None where there is nothing to tell.
        extended_model: as in its file (`diagnosis.extended_model`).
        remarks: what else people should know, in sentences.
        parameters: that were stated to be uncertain, by name.
        curves: for pictures; of several runs, over `Record.continuous_min`.
        runs: of the record.
    """

    samples: int
    span_min: float
    verdict: str
    causes: tuple[Cause, ...]
    alternatives: tuple[Alternative, ...]
    location: str
    significant: bool
    practical: bool
    differences: dict[str, Difference]
    gain: Gain
    adequacy: dict[str, float]
    experiment: Experiment | None
    extended_model: dict[str, Any]
    remarks: tuple[str, ...] = ()
    parameters: dict[str, Adjusted] = field(default_factory=dict)
    curves: Curves | None = field(default=None, repr=False, compare=False)
    runs: int = 1
