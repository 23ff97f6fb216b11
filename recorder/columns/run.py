"""A run as columns, for drawing: the whole of it, or a stretch. Pure.

It is drawn stretch by stretch, so that a recording larger than memory can be, and a run that has not ended. A stretch
therefore says of what was before it what panels need to go on where they were.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.contract import messages_pb2 as messages

Times = NDArray[np.int64]
Values = NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """The samples of a signal, shape (samples,), in order of time; NaN where the value is unusable."""

    time_ns: Times
    value: Values


@dataclass(frozen=True)
class Estimated:
    """What the model expected of a signal, shape (estimates,); limits are NaN while they are being learned."""

    time_ns: Times
    prediction: Values
    residual: Values
    lower_limit: Values
    upper_limit: Values

    @property
    def residual_lower_limit(self) -> Values:
        """The lower limit as one of the residual."""
        return self.lower_limit - self.prediction

    @property
    def residual_upper_limit(self) -> Values:
        """The upper limit as one of the residual."""
        return self.upper_limit - self.prediction


@dataclass(frozen=True)
class Charted:
    """The points of a control chart, shape (points,); `out` is 1 where the point is out of its limits, else 0."""

    time_ns: Times
    statistic: Values
    centre: Values
    lower_limit: Values
    upper_limit: Values
    out: Values


@dataclass(frozen=True)
class Reconstructed:
    """What a signal would read if its sensor were right, shape (points,), while its sensor is suspected."""

    time_ns: Times
    value: Values
    sd: Values


class AlarmChange(NamedTuple):
    """A change of an alarm: its state is a `messages.AlarmState`, `event` says what made it."""

    time_ns: int
    alarm: str
    state: int
    priority: int
    text: str
    event: str
    suspects: Sequence[messages.Suspect]


class FaultChange(NamedTuple):
    """A fault that was injected into the plant, or taken away again."""

    time_ns: int
    cause: str
    specification: str
    active: bool
    onset_ns: int


ADAPTS, HELD, JUDGES, EQUATIONS = "adapts", "held", "judges", "equations"
"""Purposes of a model: it adapts; it is held since the training and compared with that one; rows are judged by it; or
rows are judged by equations, whose noise levels are its parameters."""


class Snapshot(NamedTuple):
    """A model of a signal; parameters by name: (value, standard deviation)."""

    time_ns: int
    parameters: Mapping[str, tuple[float, float]]
    excitation: float
    condition: float


class Report(NamedTuple):
    """How a node does.

    Attributes:
        time_ns: of the newest sample when the report was received: a node speaks by the clock, a run goes by the time
            of its samples, and at an accelerated plant the two have nothing in common.
        phase: a word.
        lag_ms: between receipt and the end of the work on it.
        counts: what went wrong, by its name.
    """

    time_ns: int
    phase: str
    lag_ms: float
    counts: Mapping[str, int]


class Seen(NamedTuple):
    """What there has been of a signal so far: how many values, their mean, and between what they were."""

    rows: int
    mean: float
    lowest: float
    highest: float


@dataclass(frozen=True)
class Earlier:
    """What was before a stretch.

    Attributes:
        first_ns: time of the first sample; None: there was none.
        last: the newest two samples of each signal: what is measured together may be cut apart.
        states: of alarms that have spoken.
        suspected_ns: when suspects were told last.
        onset_ns: when the first fault sets in, or has.
    """

    first_ns: int | None = None
    last: Mapping[str, Measured] = field(default_factory=dict)
    states: Mapping[str, int] = field(default_factory=dict)
    suspected_ns: int | None = None
    onset_ns: int | None = None


@dataclass(frozen=True)
class Run:
    """One plant's run, or a stretch of it.

    Attributes:
        plant: its name; empty if there is nothing of it.
        units: by signal.
        measured: by signal.
        estimated: by signal.
        charts: by the name of the chart and the signal, `ewma/T`.
        alarms: in order of time.
        faults: in order of time.
        reconstructed: by signal.
        models: snapshots in order of time, by the signal and the purpose of the model, such as `ADAPTS`.
        health: reports in order of time, by node.
        seen: of each signal, up to the end of the stretch.
        earlier: what was before it.
        counted_from_ns: the time that its minutes count from; None: its first sample.
    """

    plant: str
    units: dict[str, str]
    measured: dict[str, Measured]
    estimated: dict[str, Estimated]
    charts: dict[str, Charted]
    alarms: tuple[AlarmChange, ...]
    faults: tuple[FaultChange, ...]
    reconstructed: dict[str, Reconstructed] = field(default_factory=dict)
    models: dict[tuple[str, str], tuple[Snapshot, ...]] = field(default_factory=dict)
    health: dict[str, tuple[Report, ...]] = field(default_factory=dict)
    seen: dict[str, Seen] = field(default_factory=dict)
    earlier: Earlier = Earlier()
    counted_from_ns: int | None = None

    @property
    def span_ns(self) -> tuple[int, int]:
        """The times of the first and of the last sample; both 0 if there is none."""
        series = [item.time_ns for item in self.measured.values()]
        return (min(int(t[0]) for t in series), max(int(t[-1]) for t in series)) if series else (0, 0)

    @property
    def first_ns(self) -> int:
        """The time of the run's first sample, which may have been in an earlier stretch; 0 if there is none."""
        return self.span_ns[0] if self.earlier.first_ns is None else self.earlier.first_ns

    @property
    def zero_ns(self) -> int:
        """The time that its minutes count from."""
        return self.first_ns if self.counted_from_ns is None else self.counted_from_ns
