"""Data of a run as columns, for drawing: the full run or a segment of it. Pure.

Segments allow to draw a recording larger than memory and a run that has not ended. A segment therefore carries the
context of earlier segments that panels need.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.description.process import Process

Times = NDArray[np.int64]
Values = NDArray[np.float64]


@dataclass(frozen=True)
class SampleColumns:
    """Samples of a signal, each array of shape (samples,), in order of time; NaN where not measured."""

    time_ns: Times
    value: Values


@dataclass(frozen=True)
class EstimateColumns:
    """Predictions of a signal, each array of shape (estimates,); limits are NaN during training."""

    time_ns: Times
    prediction: Values
    residual: Values
    lower_limit: Values
    upper_limit: Values

    def convert(self, scale: float, offset: float) -> "EstimateColumns":
        """Columns in another unit, in which a value is `scale * value + offset`."""
        levels = (scale * item + offset for item in (self.prediction, self.lower_limit, self.upper_limit))
        prediction, lower, upper = levels
        return EstimateColumns(self.time_ns, prediction, scale * self.residual, lower, upper)

    @property
    def residual_lower_limit(self) -> Values:
        """Lower limit of the residual."""
        return self.lower_limit - self.prediction

    @property
    def residual_upper_limit(self) -> Values:
        """Upper limit of the residual."""
        return self.upper_limit - self.prediction


@dataclass(frozen=True)
class ChartColumns:
    """Points of a control chart, each array of shape (points,); `out` is 1 outside the limits, else 0."""

    time_ns: Times
    statistic: Values
    centre: Values
    lower_limit: Values
    upper_limit: Values
    out: Values


@dataclass(frozen=True)
class ReconstructionColumns:
    """Reconstructed signal while its sensor is suspected, each array of shape (points,)."""

    time_ns: Times
    value: Values
    sd: Values

    def convert(self, scale: float, offset: float) -> "ReconstructionColumns":
        """Columns in another unit, in which a value is `scale * value + offset`."""
        return ReconstructionColumns(self.time_ns, scale * self.value + offset, scale * self.sd)


class AlarmChange(NamedTuple):
    """Change of an alarm; `state` is a `messages.AlarmState`, `event` its cause."""

    time_ns: int
    alarm: str
    state: int
    priority: int
    text: str
    event: str
    suspects: Sequence[messages.Suspect]


ADAPTIVE, FROZEN, REFERENCE, EQUATIONS = "adaptive", "frozen", "reference", "equations"
"""Purposes of a model: adaptive; frozen since the training and compared with the adaptive one; reference of the charts;
equations as the reference, with noise levels as parameters."""


class Snapshot(NamedTuple):
    """Model of a signal; `parameters` maps a name to (value, standard deviation)."""

    time_ns: int
    parameters: Mapping[str, tuple[float, float]]
    excitation: float
    condition: float


class HealthReport(NamedTuple):
    """Health report of a node.

    Attributes:
        time_ns: time of the newest sample when the report was received. Reports carry clock time, the axis of a run is
            sample time, and the two are unrelated for an accelerated plant.
        phase: phase of the node, in a word.
        lag_ms: time from receipt to the end of processing, in milliseconds.
        counts: number of problems, by kind.
        reference: reference by which a monitor judges rows; empty for other nodes.
    """

    time_ns: int
    phase: str
    lag_ms: float
    counts: Mapping[str, int]
    reference: str = ""


class PromiseReport(NamedTuple):
    """Promise of false alarms: as stated, and as the alarms so far bear it out.

    Attributes:
        time_ns: time of the newest row.
        found: number of alarms so far that chance can raise.
        expected: number promised so far.
        holds: False if the training or the alarms show that it is not kept.
        text: one sentence.
        power: deviations with the sizes that are seen, one line each.
    """

    time_ns: int
    found: int
    expected: float
    holds: bool
    text: str
    power: tuple[str, ...]


class SignalStatistics(NamedTuple):
    """Number, mean and range of a signal's values so far."""

    rows: int
    mean: float
    lowest: float
    highest: float


@dataclass(frozen=True)
class SegmentContext:
    """Data of earlier segments.

    Attributes:
        first_ns: time of the first sample; None if there was none.
        last_samples: newest two samples by signal, as samples of one time may be in two segments.
        alarm_states: state of each alarm that was published.
        suspects_ns: time of the last suspects.
        onset_ns: onset of the first fault; None if there was none.
        reference: reference by which rows are judged; empty if unknown.
    """

    first_ns: int | None = None
    last_samples: Mapping[str, SampleColumns] = field(default_factory=dict)
    alarm_states: Mapping[str, int] = field(default_factory=dict)
    suspects_ns: int | None = None
    onset_ns: int | None = None
    reference: str = ""


@dataclass(frozen=True)
class RunColumns:
    """Run of one plant, or a segment of it.

    Attributes:
        plant: name of the plant; empty without messages.
        units: units by signal.
        samples: samples by signal.
        estimates: predictions by signal, of the reference that judges.
        estimates_beside: predictions by the recursive ARX model beside it, by signal.
        charts: chart points by chart and signal, such as `ewma/T`.
        alarms: changes of alarms in order of time.
        faults: changes of faults in order of time.
        reconstructions: reconstructed signals.
        models: snapshots in order of time, by signal and purpose of the model, such as `ADAPTIVE`.
        health: health reports in order of time, by node.
        promises: reports on the promise of false alarms in order of time.
        statistics: statistics of each signal up to the end of the segment.
        context: data of earlier segments.
        given_zero_ns: time that minutes count from; None for the first sample.
        process: process of the plant, with the roles of its signals; None: unknown.
    """

    plant: str
    units: dict[str, str]
    samples: dict[str, SampleColumns]
    estimates: dict[str, EstimateColumns]
    charts: dict[str, ChartColumns]
    alarms: tuple[AlarmChange, ...]
    faults: tuple[messages.Fault, ...]
    reconstructions: dict[str, ReconstructionColumns] = field(default_factory=dict)
    models: dict[tuple[str, str], tuple[Snapshot, ...]] = field(default_factory=dict)
    health: dict[str, tuple[HealthReport, ...]] = field(default_factory=dict)
    promises: tuple[PromiseReport, ...] = ()
    statistics: dict[str, SignalStatistics] = field(default_factory=dict)
    context: SegmentContext = SegmentContext()
    given_zero_ns: int | None = None
    process: Process | None = None
    estimates_beside: dict[str, EstimateColumns] = field(default_factory=dict)

    @property
    def reference(self) -> str:
        """Reference by which the newest rows are judged: `equations`, `black-box` or `arx`; empty if unknown."""
        named = [item.reference for item in self.health.get("monitor", ()) if item.reference]
        return named[-1] if named else self.context.reference

    @property
    def span_ns(self) -> tuple[int, int]:
        """Times of the first and the last sample of the segment; (0, 0) if there is none."""
        series = [item.time_ns for item in self.samples.values()]
        return (min(int(t[0]) for t in series), max(int(t[-1]) for t in series)) if series else (0, 0)

    @property
    def first_ns(self) -> int:
        """Time of the first sample of the run, earlier segments included; 0 if there is none."""
        return self.span_ns[0] if self.context.first_ns is None else self.context.first_ns

    @property
    def zero_ns(self) -> int:
        """Time that minutes count from."""
        return self.first_ns if self.given_zero_ns is None else self.given_zero_ns
