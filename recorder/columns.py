"""Messages of a run as columns of numbers, for drawing: the full run, or segment by segment. Pure.

Segments allow to draw a recording larger than memory and a run that has not ended. A segment therefore carries the
context of earlier segments that panels need. After the plant's clock stepped back, times are shifted to follow the
earlier run (`RunSplitter.continuous_ns`). Numbers are collected in arrays, which take a few bytes a number instead of
an object, and are cleared after each segment.
"""

import sys
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import Message
from numpy.typing import NDArray

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Encoded
from reactorwatch.contract.suspects import NewSuspects
from reactorwatch.description.process import Process
from reactorwatch.errors import InputError
from reactorwatch.units import conversion
from recorder import RecordedMessage
from recorder.samples import RunSplitter, content_of, measured_value

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


SEGMENT_MESSAGES = 100_000
"""Messages in a segment, which take about 20 MB while they are drawn."""

SUSPECTED = "suspected"
"""Event of alarms with new suspects, of monitors before 0.3, which published no incidents."""
LISTED = "listed"
"""Event of alarms from a list of active alarms; the time of the last change is unknown."""
_CHANGE = ("time_ns", "state", "priority", "text", "event")
"""Fields that, with the suspects, tell one change of an alarm from another."""
BESIDE = "/arx"
"""End of the names of predictions by the recursive ARX model beside another reference."""


def read_run(recording: Iterable[RecordedMessage | Encoded]) -> RunColumns:
    """Full run of a recording.

    Args:
        recording: messages of one plant, in any order; other kinds and undecodable messages are skipped.

    Raises:
        InputError: the messages are of several plants.
    """
    (run,) = read_segments(recording, sys.maxsize)
    return run


def read_segments(
    recording: Iterable[RecordedMessage | Encoded],
    segment_messages: int = SEGMENT_MESSAGES,
    given_zero_ns: int | None = None,
    process: Process | None = None,
) -> Iterator[RunColumns]:
    """Segments of the run of a recording, at least one.

    Args:
        recording: messages as in `read_run`, of any number.
        segment_messages: number of messages in a segment.
        given_zero_ns: see `RunColumns`.
        process: see `RunColumns`.

    Raises:
        InputError: see `read_run`.
    """
    reader = RunReader(given_zero_ns, process)
    for count, entry in enumerate(recording, 1):
        reader.add(entry)
        if count % segment_messages == 0:
            yield reader.next_segment()
    yield reader.next_segment()


class RunReader:
    """Collects messages and returns them as segments, with the zero and the process of `RunColumns`."""

    def __init__(self, given_zero_ns: int | None = None, process: Process | None = None) -> None:
        self._given_zero_ns, self._process = given_zero_ns, process
        self._plant = ""
        self._keys: dict[str, _Key | None] = {}
        self._newest_changes: dict[str, tuple[object, ...]] = {}
        self._suspects = NewSuspects()
        self._newest_ns: int | None = None
        self._clock = RunSplitter()
        self._statistics: dict[str, SignalStatistics] = {}
        self._context = SegmentContext()

    def add(self, entry: RecordedMessage | Encoded) -> None:
        """Add a message.

        Raises:
            InputError: it is of another plant than earlier messages.
        """
        key = entry.key
        if key not in self._keys:
            topic = keys.parse(key)
            self._keys[key] = _Key(topic, _KINDS[topic.kind]) if topic is not None and topic.kind in _KINDS else None
        into = self._keys[key]
        if into is None:
            return
        kind = into.topic.kind
        content = content_of(entry)
        if type(content) is not into.kind.message:
            return
        message: Any = content
        if into.topic.plant != self._plant:
            if self._plant:
                raise InputError(
                    f"a run is of one plant; name one of {', '.join(sorted((self._plant, into.topic.plant)))}"
                )
            self._plant = into.topic.plant
        if kind == keys.HEALTH:
            if self._newest_ns is None:
                return  # without a sample it has no time in the run
            time_ns = self._newest_ns
        else:
            time_ns = self._clock.continuous_ns(key, message)
        if kind == keys.ALARM and message.event == SUSPECTED:
            kind, message = keys.INCIDENT, messages.Incident(number=message.incident, suspects=message.suspects)
            topic = keys.Topic(self._plant, kind, str(message.number))
            into = self._keys[keys.key(*topic)] = self._keys.get(keys.key(*topic)) or _Key(topic, _KINDS[kind])
        if kind == keys.SAMPLE:
            self._newest_ns = time_ns if self._newest_ns is None else max(self._newest_ns, time_ns)
        elif kind == keys.INCIDENT:
            if not self._suspects.update(message.number, message.suspects):
                return
        elif kind == keys.ALARM:
            change = (*(getattr(message, name) for name in _CHANGE), list(message.suspects))
            if self._newest_changes.get(message.alarm) == change:
                return  # a restarted monitor publishes its newest again
            self._newest_changes[message.alarm] = change
        elif kind == keys.FAULT:
            message.onset_ns += time_ns - message.time_ns
        into.add(message, time_ns)

    def set_zero(self, time_ns: int) -> None:
        """Set the time that minutes count from, before the first segment."""
        self._given_zero_ns = time_ns

    @property
    def has_samples(self) -> bool:
        """True once a sample was added."""
        return self._newest_ns is not None

    def next_segment(self) -> RunColumns:
        """Return the messages since the last call as a segment."""
        found = [item for item in self._keys.values() if item is not None]
        # a signal is drawn in the unit of its samples; the monitor may publish in that of the equations
        published = {(item.topic.kind, item.topic.name): item.unit for item in found if item.unit}
        sampled = {name: unit for (kind, name), unit in published.items() if kind == keys.SAMPLE}

        def columns(kind: str) -> dict[str, Any]:
            return {
                item.topic.name: item.columns(sampled.get(item.topic.name.partition("/")[0], item.unit))
                for item in found
                if item.topic.kind == kind and item.times
            }

        def messages_of(kind: str) -> list[Any]:
            items = (message for item in found if item.topic.kind == kind for message in item.messages)
            return sorted(items, key=attrgetter("time_ns"))

        samples = columns(keys.SAMPLE)
        self._statistics |= {
            name: _update_statistics(self._statistics.get(name), item) for name, item in samples.items()
        }
        estimates = columns(keys.ESTIMATE)
        beside = {name: name.removesuffix(BESIDE) for name in estimates if name.endswith(BESIDE)}
        models = {
            (item.topic.name, purpose): _last_of_each_time([m for m in item.messages if _purpose(m) == purpose])
            for item in found
            if item.topic.kind == keys.MODEL
            for purpose in dict.fromkeys(map(_purpose, item.messages))
        }
        reports = [item.messages for item in found if item.topic.kind == keys.HEALTH and item.messages]
        run = RunColumns(
            plant=self._plant,
            units={**{name: unit for (_, name), unit in published.items()}, **sampled},
            samples=samples,
            estimates={name: item for name, item in estimates.items() if name not in beside},
            estimates_beside={signal: estimates[name] for name, signal in beside.items()},
            charts=columns(keys.CHART),
            alarms=tuple(messages_of(keys.ALARM)),
            incidents=tuple(messages_of(keys.INCIDENT)),
            faults=tuple(messages_of(keys.FAULT)),
            reconstructions=columns(keys.RECONSTRUCTION),
            models=models,
            health={of_node[-1].node: _last_of_each_time(of_node) for of_node in reports},
            promises=_last_of_each_time(messages_of(keys.PROMISE)),
            statistics=dict(self._statistics),
            context=self._context,
            given_zero_ns=self._given_zero_ns,
            process=self._process,
        )
        self._context = _next_context(run)
        for item in found:
            item.clear()
        return run


def _next_context(run: RunColumns) -> SegmentContext:
    """Context of the next segment."""
    before = run.context
    newest = {name: _newest(before.last_samples.get(name), item) for name, item in run.samples.items()}
    onsets = (change.onset_ns for change in run.faults if change.active)
    return SegmentContext(
        first_ns=run.first_ns if run.samples or before.first_ns is not None else None,
        last_samples={**before.last_samples, **newest},
        alarm_states={**before.alarm_states, **{change.alarm: change.state for change in run.alarms}},
        onset_ns=next(onsets, None) if before.onset_ns is None else before.onset_ns,
        reference=run.reference,
        levels={**{name: item.mean for name, item in run.statistics.items() if item.rows}, **before.levels},
    )


def _newest(before: SampleColumns | None, item: SampleColumns) -> SampleColumns:
    """Newest two samples, in order of time."""
    time_ns, value = item.time_ns[-2:], item.value[-2:]
    if before is not None and time_ns.size < 2:
        time_ns, value = np.append(before.time_ns, time_ns)[-2:], np.append(before.value, value)[-2:]
    return SampleColumns(time_ns.copy(), value.copy())


def _update_statistics(before: SignalStatistics | None, item: SampleColumns) -> SignalStatistics:
    values = item.value[np.isfinite(item.value)]
    before = before or SignalStatistics(0, float("nan"), float("inf"), -float("inf"))
    if not values.size:
        return before
    rows = before.rows + values.size
    mean = float(values.mean())
    if before.rows:
        mean = before.mean + (mean - before.mean) * values.size / rows
    return SignalStatistics(
        rows, mean, min(before.lowest, float(values.min())), max(before.highest, float(values.max()))
    )


def times_of(items: Iterable[Any]) -> Times:
    """Times of messages."""
    return np.array([item.time_ns for item in items], np.int64)


def _last_of_each_time(items: list[Any]) -> tuple[Any, ...]:
    """Items in order of time; the last one of equal times counts."""
    newest = {item.time_ns: item for item in items}
    return tuple(newest[time_ns] for time_ns in sorted(newest))


def _purpose(message: messages.ModelSnapshot) -> str:
    """Purpose of a model."""
    if message.structure == EQUATIONS:
        return EQUATIONS
    if message.reference and (message.held or message.structure != "arx"):  # the recursive ARX model adapts
        return REFERENCE
    return FROZEN if message.held else ADAPTIVE


class _Kind(NamedTuple):
    """Kind of messages that are drawn.

    Attributes:
        message: type of the messages.
        numbers: returns the numbers of a message, in the order of the columns; None: messages are kept.
        columns: type of the columns.
        is_level: for each column, 1 if the offset between two units applies, 0 if not, as for a difference.
    """

    message: type[Message]
    numbers: Callable[[Any], tuple[float, ...]] | None = None
    columns: type[SampleColumns | EstimateColumns | ChartColumns | ReconstructionColumns] = SampleColumns
    is_level: tuple[int, ...] = ()


_KINDS = {
    keys.SAMPLE: _Kind(messages.Sample, lambda m: () if (value := measured_value(m)) is None else (value,)),
    keys.ESTIMATE: _Kind(messages.Estimate, attrgetter(*EstimateColumns._fields[1:]), EstimateColumns, (1, 0, 1, 1)),
    keys.CHART: _Kind(messages.ChartPoint, attrgetter(*ChartColumns._fields[1:]), ChartColumns),
    keys.RECONSTRUCTION: _Kind(messages.Reconstruction, attrgetter("value", "sd"), ReconstructionColumns, (1, 0)),
    keys.ALARM: _Kind(messages.Alarm),
    keys.INCIDENT: _Kind(messages.Incident),
    keys.FAULT: _Kind(messages.Fault),
    keys.MODEL: _Kind(messages.ModelSnapshot),
    keys.HEALTH: _Kind(messages.Health),
    keys.PROMISE: _Kind(messages.Promise),
}


class _Key:
    """Numbers or messages of one key, in the order of receipt."""

    def __init__(self, topic: keys.Topic, kind: _Kind) -> None:
        self.topic, self.kind = topic, kind
        self.unit = ""
        self.clear()

    def clear(self) -> None:
        """Clear the numbers and messages."""
        self.times, self._numbers = array("q"), array("d")  # numbers are row by row
        self.messages: list[Any] = []

    def add(self, message: Any, time_ns: int) -> None:
        """Add a message, or its numbers if it has any, at a time."""
        if self.kind.numbers is None:
            message.time_ns = time_ns
            self.messages.append(message)
        elif numbers := self.kind.numbers(message):
            self.unit = self.unit or getattr(message, "unit", "")
            self.times.append(time_ns)
            self._numbers.extend(numbers)

    def columns(self, unit: str) -> Any:
        """Columns in order of time, in a unit where it measures the same quantity."""
        times = np.array(self.times, np.int64)
        numbers = np.array(self._numbers).reshape(times.size, -1).T.copy()
        if (np.diff(times) < 0).any():
            order = np.argsort(times, kind="stable")
            times, numbers = times[order], numbers[:, order]
        if self.kind.is_level and unit != self.unit:
            try:
                scale, offset = conversion(self.unit, unit, "signal")
            except InputError:
                pass
            else:
                numbers = scale * numbers + offset * np.array(self.kind.is_level)[:, None]
        return self.kind.columns(times, *numbers)
