"""Convert messages into the columns of a run, at once or segment by segment. Pure.

After the plant's clock stepped back, times are shifted to follow the earlier run (`ContinuousTime`).

Numbers are collected in arrays, which take a few bytes a number instead of an object, and are cleared after each
segment.
"""

from array import array
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
from google.protobuf.message import Message
from numpy.typing import NDArray

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import DecodeError, Encoded, decode
from reactorwatch.contract.promise_text import describe_sizes, promise_fields
from reactorwatch.description.process import Process
from reactorwatch.errors import InputError
from reactorwatch.units import conversion
from recorder.columns.measurement import measured_value
from recorder.columns.run import (
    ADAPTIVE,
    EQUATIONS,
    FROZEN,
    REFERENCE,
    AlarmChange,
    ChartColumns,
    EstimateColumns,
    HealthReport,
    PromiseReport,
    ReconstructionColumns,
    RunColumns,
    SampleColumns,
    SegmentContext,
    SignalStatistics,
    Snapshot,
)
from recorder.columns.run_splitter import ContinuousTime
from recorder.message import RecordedMessage

SEGMENT_MESSAGES = 100_000
"""Messages in a segment, which take about 20 MB while they are drawn."""

SUSPECTED = "suspected"
"""Event of alarms with new suspects."""
LISTED = "listed"
"""Event of alarms from a list of active alarms; the time of the last change is unknown."""


def read_run(recording: Iterable[RecordedMessage | Encoded]) -> RunColumns:
    """Full run of a recording.

    Args:
        recording: messages of one plant, in any order; other kinds and undecodable messages are skipped.

    Raises:
        InputError: the messages are of several plants.
    """
    reader = RunReader()
    for entry in recording:
        reader.add(entry)
    return reader.next_segment()


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
    reader, taken = RunReader(given_zero_ns, process), 0
    for entry in recording:
        reader.add(entry)
        taken += 1
        if taken == segment_messages:
            yield reader.next_segment()
            taken = 0
    yield reader.next_segment()


class RunReader:
    """Collects messages and returns them as segments.

    Args:
        given_zero_ns: see `RunColumns`.
        process: see `RunColumns`.
    """

    def __init__(self, given_zero_ns: int | None = None, process: Process | None = None) -> None:
        self._given_zero_ns, self._process = given_zero_ns, process
        self._plant = ""
        self._columns: dict[str, _KeyColumns | None] = {}
        self._alarms: list[AlarmChange] = []
        self._newest_changes: dict[str, AlarmChange] = {}
        self._faults: list[messages.Fault] = []
        self._models: dict[tuple[str, str], list[Snapshot]] = {}
        self._health: dict[str, list[HealthReport]] = {}
        self._promises: list[PromiseReport] = []
        self._newest_ns: int | None = None
        self._clock = ContinuousTime()
        self._statistics: dict[str, SignalStatistics] = {}
        self._context = SegmentContext()

    def add(self, entry: RecordedMessage | Encoded) -> None:
        """Add a message.

        Raises:
            InputError: it is of another plant than earlier messages.
        """
        key = entry.key
        if key not in self._columns:
            self._columns[key] = _KeyColumns.of(key)
        into = self._columns[key]
        if into is None:
            return
        try:
            decoded = decode(entry.payload, entry.encoding)
        except DecodeError:
            return
        kind = into.topic.kind
        if type(decoded) is not _KINDS[kind].message:
            return
        message: Any = decoded
        if into.topic.plant != self._plant:
            if self._plant:
                raise InputError(
                    f"a run is of one plant; name one of {', '.join(sorted((self._plant, into.topic.plant)))}"
                )
            self._plant = into.topic.plant
        if kind == keys.HEALTH:  # without a sample it has no time in the run
            if self._newest_ns is not None:
                self._health.setdefault(message.node, []).append(_report(message, self._newest_ns))
            return
        time_ns = self._clock.continuous_ns(key, message)
        if _KINDS[kind].numbers is not None:
            into.append(message, time_ns)
            if kind == keys.SAMPLE and (self._newest_ns is None or time_ns > self._newest_ns):
                self._newest_ns = time_ns
        elif kind == keys.ALARM:
            change = AlarmChange(*(getattr(message, name) for name in AlarmChange._fields))
            if self._newest_changes.get(change.alarm) != change:  # a restarted monitor publishes its newest again
                self._newest_changes[change.alarm] = change
                self._alarms.append(change._replace(time_ns=time_ns))
        elif kind == keys.FAULT:
            message.onset_ns += time_ns - message.time_ns
            message.time_ns = time_ns
            self._faults.append(message)
        elif kind == keys.MODEL:
            self._models.setdefault((into.topic.name, _purpose(message)), []).append(_snapshot(message, time_ns))
        elif kind == keys.PROMISE:
            self._promises.append(_promise(message, time_ns))

    def set_zero(self, time_ns: int) -> None:
        """Set the time that minutes count from, before the first segment."""
        self._given_zero_ns = time_ns

    @property
    def has_samples(self) -> bool:
        """True once a sample was added."""
        return self._newest_ns is not None

    def next_segment(self) -> RunColumns:
        """Return the messages since the last call as a segment."""
        found = [item for item in self._columns.values() if item is not None]

        def of_kind(kind: str) -> Iterator[tuple[str, list[Any]]]:
            return ((item.topic.name, item.in_order()) for item in found if item.topic.kind == kind and item.times)

        samples = {name: SampleColumns(*columns) for name, columns in of_kind(keys.SAMPLE)}
        self._statistics |= {
            name: _update_statistics(self._statistics.get(name), item) for name, item in samples.items()
        }
        # a signal is drawn in the unit of its samples; the monitor may publish in that of the equations
        published = {(item.topic.kind, item.topic.name): item.unit for item in found if item.unit}
        sampled = {name: unit for (kind, name), unit in published.items() if kind == keys.SAMPLE}

        def in_unit(columns: _Convertible, kind: str, name: str) -> _Convertible:
            unit = published.get((kind, name), "")
            return _convert(columns, unit, sampled.get(name.partition("/")[0]) or unit)

        estimates = {
            name: in_unit(EstimateColumns(*columns), keys.ESTIMATE, name) for name, columns in of_kind(keys.ESTIMATE)
        }
        beside = {name: name.removesuffix(BESIDE) for name in estimates if name.endswith(BESIDE)}
        run = RunColumns(
            plant=self._plant,
            units={**{name: unit for (_, name), unit in published.items()}, **sampled},
            samples=samples,
            estimates={name: columns for name, columns in estimates.items() if name not in beside},
            estimates_beside={signal: estimates[name] for name, signal in beside.items()},
            charts={name: ChartColumns(*columns) for name, columns in of_kind(keys.CHART)},
            alarms=tuple(sorted(self._alarms, key=lambda change: change.time_ns)),
            faults=tuple(sorted(self._faults, key=lambda change: change.time_ns)),
            reconstructions={
                name: in_unit(ReconstructionColumns(*columns), keys.RECONSTRUCTION, name)
                for name, columns in of_kind(keys.RECONSTRUCTION)
            },
            models={name: _last_of_each_time(items) for name, items in self._models.items()},
            health={node: _last_of_each_time(items) for node, items in self._health.items()},
            promises=_last_of_each_time(self._promises),
            statistics=dict(self._statistics),
            context=self._context,
            given_zero_ns=self._given_zero_ns,
            process=self._process,
        )
        self._context = _next_context(run)
        for item in found:
            item.clear()
        self._alarms, self._faults, self._models, self._health, self._promises = [], [], {}, {}, []
        return run


_Convertible = TypeVar("_Convertible", EstimateColumns, ReconstructionColumns)


def _convert(columns: _Convertible, unit: str, wanted: str) -> _Convertible:
    """Columns in another unit; unchanged where the units are equal or measure different quantities."""
    if unit == wanted:
        return columns
    try:
        return columns.convert(*conversion(unit, wanted, "signal"))
    except InputError:
        return columns


def _next_context(run: RunColumns) -> SegmentContext:
    """Context of the next segment."""
    before = run.context
    newest = {name: _newest(before.last_samples.get(name), item) for name, item in run.samples.items()}
    onsets = (change.onset_ns for change in run.faults if change.active)
    return replace(
        before,
        first_ns=run.first_ns if run.samples or before.first_ns is not None else None,
        last_samples={**before.last_samples, **newest},
        alarm_states={**before.alarm_states, **{change.alarm: change.state for change in run.alarms}},
        suspects_ns=max(
            (change.time_ns for change in run.alarms if change.event == SUSPECTED), default=before.suspects_ns
        ),
        onset_ns=next(onsets, None) if before.onset_ns is None else before.onset_ns,
        reference=run.reference,
    )


def _newest(before: SampleColumns | None, item: SampleColumns) -> SampleColumns:
    """Newest two samples, in order of time."""
    time_ns, value = item.time_ns[-2:], item.value[-2:]
    if before is not None and time_ns.size < 2:
        time_ns, value = np.append(before.time_ns, time_ns)[-2:], np.append(before.value, value)[-2:]
    return SampleColumns(time_ns.copy(), value.copy())


def _update_statistics(before: SignalStatistics | None, item: SampleColumns) -> SignalStatistics:
    values = item.value[np.isfinite(item.value)]
    now = (
        SignalStatistics(values.size, float(values.mean()), float(values.min()), float(values.max()))
        if values.size
        else _NOTHING
    )
    if before is None or not before.rows or not now.rows:
        return now if now.rows or before is None else before
    rows = before.rows + now.rows
    mean = before.mean + (now.mean - before.mean) * now.rows / rows
    return SignalStatistics(rows, mean, min(before.lowest, now.lowest), max(before.highest, now.highest))


_NOTHING = SignalStatistics(0, float("nan"), float("inf"), -float("inf"))

BESIDE = "/arx"
"""End of the names of predictions by the recursive ARX model beside another reference."""


_Dated = TypeVar("_Dated", Snapshot, HealthReport, PromiseReport)


def _last_of_each_time(items: list[_Dated]) -> tuple[_Dated, ...]:
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


def _snapshot(message: messages.ModelSnapshot, time_ns: int) -> Snapshot:
    parameters = {item.name: (item.value, item.sd) for item in message.parameters}
    return Snapshot(time_ns, parameters, message.excitation, message.condition)


def _report(message: messages.Health, time_ns: int) -> HealthReport:
    counts = {name: getattr(message, name) for name in ("lost", "late", "refused", "duplicated", "out_of_order")}
    return HealthReport(time_ns, message.phase, message.lag_ms, counts, message.reference)


def _promise(message: messages.Promise, time_ns: int) -> PromiseReport:
    holds = message.kept and not message.drifted
    power = tuple(describe_sizes(item) for item in promise_fields(message)["power"])
    return PromiseReport(time_ns, message.found, message.expected_so_far, holds, message.text, power)


class _Kind(NamedTuple):
    message: type[Message]
    numbers: Callable[[Any], tuple[float, ...]] | None = (
        None  # in the order of the columns; None without numeric columns
    )


_KINDS = {
    keys.SAMPLE: _Kind(messages.Sample, lambda m: () if (value := measured_value(m)) is None else (value,)),
    keys.ESTIMATE: _Kind(messages.Estimate, lambda m: (m.prediction, m.residual, m.lower_limit, m.upper_limit)),
    keys.CHART: _Kind(
        messages.ChartPoint, lambda m: (m.statistic, m.centre, m.lower_limit, m.upper_limit, float(m.out))
    ),
    keys.RECONSTRUCTION: _Kind(messages.Reconstruction, lambda m: (m.value, m.sd)),
    keys.ALARM: _Kind(messages.Alarm),
    keys.FAULT: _Kind(messages.Fault),
    keys.MODEL: _Kind(messages.ModelSnapshot),
    keys.HEALTH: _Kind(messages.Health),
    keys.PROMISE: _Kind(messages.Promise),
}


class _KeyColumns:
    """Numbers of one key, in the order of receipt."""

    def __init__(self, topic: keys.Topic) -> None:
        self.topic = topic
        self.unit = ""
        self.times = array("q")
        self._numbers = array("d")  # row by row
        self._of = _KINDS[topic.kind].numbers or (lambda message: ())

    @classmethod
    def of(cls, key: str) -> "_KeyColumns | None":
        """Columns of a key; None if it is not drawn."""
        topic = keys.parse(key)
        return cls(topic) if topic is not None and topic.kind in _KINDS else None

    def append(self, message: Any, time_ns: int) -> None:
        """Add the numbers of a message, if any, at a time."""
        numbers = self._of(message)
        if not numbers:
            return
        if not self.unit:
            self.unit = getattr(message, "unit", "")
        self.times.append(time_ns)
        self._numbers.extend(numbers)

    def in_order(self) -> list[NDArray[Any]]:
        """Times and columns, in order of time."""
        times = np.array(self.times, np.int64)
        columns = list(np.array(self._numbers).reshape(times.size, -1).T.copy())
        if (np.diff(times) < 0).any():
            order = np.argsort(times, kind="stable")
            return [times[order], *(column[order] for column in columns)]
        return [times, *columns]

    def clear(self) -> None:
        """Clear the numbers."""
        self.times, self._numbers = array("q"), array("d")
