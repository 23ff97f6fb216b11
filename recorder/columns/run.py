"""Data of a run as columns, for drawing: the full run or a segment of it. Pure.

Segments allow to draw a recording larger than memory and a run that has not ended. A segment therefore carries the
context of earlier segments that panels need.

Signals have meanings and roles from their process, or from the catalogue of processes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.description.process import Process
from reactorwatch.process import MODELS
from reactorwatch.process.model import ProcessModel

Times = NDArray[np.int64]
Values = NDArray[np.float64]


class SampleColumns(NamedTuple):
    """Samples of a signal, each array of shape (samples,), in order of time; NaN where not measured."""

    time_ns: Times
    value: Values


class EstimateColumns(NamedTuple):
    """Predictions of a signal, each array of shape (estimates,); limits are NaN during training."""

    time_ns: Times
    prediction: Values
    residual: Values
    lower_limit: Values
    upper_limit: Values

    @property
    def residual_limits(self) -> tuple[Values, Values]:
        """Lower and upper limit of the residual."""
        return self.lower_limit - self.prediction, self.upper_limit - self.prediction


class ChartColumns(NamedTuple):
    """Points of a control chart, each array of shape (points,); `out` is 1 outside the limits, else 0."""

    time_ns: Times
    statistic: Values
    centre: Values
    lower_limit: Values
    upper_limit: Values
    out: Values


class ReconstructionColumns(NamedTuple):
    """Reconstructed signal while its sensor is suspected, each array of shape (points,)."""

    time_ns: Times
    value: Values
    sd: Values


ADAPTIVE, FROZEN, REFERENCE, EQUATIONS = "adaptive", "frozen", "reference", "equations"
"""Purposes of a model: adaptive; frozen since the training and compared with the adaptive one; reference of the charts;
equations as the reference, with noise levels as parameters."""


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
        onset_ns: onset of the first fault; None if there was none.
        reference: reference by which rows are judged; empty if unknown.
        levels: mean of each signal in the first segment that has it: the steady states of a run are computed there.
    """

    first_ns: int | None = None
    last_samples: Mapping[str, SampleColumns] = field(default_factory=dict)
    alarm_states: Mapping[str, int] = field(default_factory=dict)
    onset_ns: int | None = None
    reference: str = ""
    levels: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class RunColumns:
    """Run of one plant, or a segment of it.

    Messages that are drawn one by one have the time of the run as `time_ns`. That of a health report is the time of the
    newest sample when it was received: reports carry clock time, which is unrelated to sample time for an accelerated
    plant.

    Attributes:
        plant: name of the plant; empty without messages.
        units: units by signal.
        samples: samples by signal.
        estimates: predictions by signal, of the reference that judges.
        estimates_beside: predictions by the recursive ARX model beside it, by signal.
        charts: chart points by chart and signal, such as `ewma/T`.
        alarms: changes of alarms in order of time.
        incidents: incidents with new suspects in order of time.
        faults: changes of faults in order of time.
        reconstructions: reconstructed signals.
        models: snapshots in order of time, by signal and purpose of the model, such as `ADAPTIVE`.
        health: health reports in order of time, by node.
        promises: promises of false alarms in order of time.
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
    alarms: tuple[messages.Alarm, ...]
    faults: tuple[messages.Fault, ...]
    incidents: tuple[messages.Incident, ...] = ()
    reconstructions: dict[str, ReconstructionColumns] = field(default_factory=dict)
    models: dict[tuple[str, str], tuple[messages.ModelSnapshot, ...]] = field(default_factory=dict)
    health: dict[str, tuple[messages.Health, ...]] = field(default_factory=dict)
    promises: tuple[messages.Promise, ...] = ()
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


def signal_title(name: str, unit: str, process: Process | None = None) -> str:
    """Name of a signal, with its meaning if its process has a variable of that name.

    Args:
        name: name of the signal.
        unit: unit of the signal.
        process: process of the signal; None: any of the catalogue whose variable has this unit, too.
    """
    variables = [
        item
        for model in _models_of(process)
        for item in (*model.inputs, *model.states)
        if item.name == name and (item.unit == unit or process is not None)
    ]
    meaning = variables[0].meaning if variables else ""
    return f"{name}: {meaning}" if meaning else name


def signal_roles(units: Mapping[str, str], process: Process | None = None) -> dict[str, str]:
    """Roles of signals by name: those of the process in its order, then all others as outputs.

    Args:
        units: units of the signals, by name; empty: unknown.
        process: process of the signals; None: the one of the catalogue that has all of them, or all of whose signals
            are there.
    """
    if process is not None:
        roles = {signal.name: signal.role for signal in process.signals}
    else:
        model = find_model(units) or _find_model_with(units)
        roles = {} if model is None else {name: _role(model, name) for name in model.units}
    return {
        **{name: role for name, role in roles.items() if name in units},
        **{name: "output" for name in units if name not in roles},
    }


def find_model(units: Mapping[str, str], process: Process | None = None) -> ProcessModel | None:
    """Equations whose inputs and outputs are all present, with the same units; None if there are none.

    Args:
        units: units of the present signals, by name.
        process: process of the signals; None: any of the catalogue.
    """
    return next((model for model in _models_of(process) if model.units.items() <= units.items()), None)


def _find_model_with(units: Mapping[str, str]) -> ProcessModel | None:
    """Model of the catalogue that has all of the signals, none of them in another unit."""
    for model in _models():
        if all(name in model.units and unit in ("", model.units[name]) for name, unit in units.items()):
            return model
    return None


def _role(model: ProcessModel, name: str) -> str:
    return "input" if name in model.input_names else "output"


def _models_of(process: Process | None) -> tuple[ProcessModel, ...]:
    """Equations of a process; without its own, those of the catalogue under its name."""
    if process is None:
        return _models()
    if process.model is not None:
        return (process.model,)
    return tuple(model for model in _models() if model.name == process.name)


@cache
def _models() -> tuple[ProcessModel, ...]:
    return tuple(build() for build in MODELS)
