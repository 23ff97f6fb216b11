"""Messages into a run, as columns: all of them, or stretch by stretch. Pure.

Where the plant's clock stepped back, what follows is drawn after what was before (`ContinuousTime`).

The numbers go into growing arrays, so that a stretch of a million samples costs a few bytes a number and not an object
each; with the stretch that they are cut into they are gone.
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
from reactorwatch.errors import InputError
from recorder.columns.measurement import measured
from recorder.columns.run import (
    ADAPTS,
    EQUATIONS,
    HELD,
    JUDGES,
    AlarmChange,
    Charted,
    Earlier,
    Estimated,
    FaultChange,
    Measured,
    Reconstructed,
    Report,
    Run,
    Seen,
    Snapshot,
)
from recorder.columns.run_splitter import ContinuousTime
from recorder.message import RecordedMessage

STRETCH = 100_000
"""Messages; drawn they take some 20 MB for a moment."""

SUSPECTED = "suspected"
"""The event of alarms whose suspects are new."""
LISTED = "listed"
"""The event of alarms that were in their state when a list of alarms was asked for; since when is not known."""


def read_run(recording: Iterable[RecordedMessage | Encoded]) -> Run:
    """The run that a recording tells of, in one piece.

    Args:
        recording: the messages of one plant, in any order; those of other kinds, and what cannot be decoded, are
            passed over.

    Raises:
        InputError: the messages are of several plants.
    """
    reader = RunReader()
    for entry in recording:
        reader.take(entry)
    return reader.cut()


def stretches(
    recording: Iterable[RecordedMessage | Encoded], messages_each: int = STRETCH, counted_from_ns: int | None = None
) -> Iterator[Run]:
    """The run that a recording tells of, in stretches; one at least.

    Args:
        recording: as in `read_run`, of any size.
        messages_each: how many messages a stretch is made of.
        counted_from_ns: see `Run`.

    Raises:
        InputError: as in `read_run`.
    """
    reader, taken = RunReader(counted_from_ns), 0
    for entry in recording:
        reader.take(entry)
        taken += 1
        if taken == messages_each:
            yield reader.cut()
            taken = 0
    yield reader.cut()


class RunReader:
    """Takes messages as they come, and hands out what has come since it was last asked.

    Args:
        counted_from_ns: see `Run`.
    """

    def __init__(self, counted_from_ns: int | None = None) -> None:
        self._counted_from_ns = counted_from_ns
        self._plant = ""
        self._series: dict[str, _Series | None] = {}
        self._alarms: list[AlarmChange] = []
        self._faults: list[FaultChange] = []
        self._models: dict[tuple[str, str], list[Snapshot]] = {}
        self._health: dict[str, list[Report]] = {}
        self._newest_ns: int | None = None
        self._clock = ContinuousTime()
        self._seen: dict[str, Seen] = {}
        self._earlier = Earlier()

    def take(self, entry: RecordedMessage | Encoded) -> None:
        """Take a message.

        Raises:
            InputError: it is of another plant than those before.
        """
        key = entry.key
        if key not in self._series:
            self._series[key] = _Series.of(key)
        into = self._series[key]
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
        if kind == keys.HEALTH:  # of before the first sample it has no place in the run
            if self._newest_ns is not None:
                self._health.setdefault(message.node, []).append(_report(message, self._newest_ns))
            return
        time_ns = self._clock.of(key, message)
        if _KINDS[kind].numbers is not None:
            into.append(message, time_ns)
            if kind == keys.SAMPLE and (self._newest_ns is None or time_ns > self._newest_ns):
                self._newest_ns = time_ns
        elif kind == keys.ALARM:
            change = AlarmChange(*(getattr(message, name) for name in AlarmChange._fields))
            self._alarms.append(change._replace(time_ns=time_ns))
        elif kind == keys.FAULT:
            fault = FaultChange(*(getattr(message, name) for name in FaultChange._fields))
            onset_ns = fault.onset_ns + time_ns - fault.time_ns
            self._faults.append(fault._replace(time_ns=time_ns, onset_ns=onset_ns))
        elif kind == keys.MODEL:
            self._models.setdefault((into.topic.name, _use(message)), []).append(_snapshot(message, time_ns))

    def count_from(self, time_ns: int) -> None:
        """Set the time that the run's minutes count from, before anything of it was cut."""
        self._counted_from_ns = time_ns

    @property
    def has_samples(self) -> bool:
        """True once there was a sample, before the last cut or since."""
        return self._newest_ns is not None

    def cut(self) -> Run:
        """What has come since the last cut."""
        found = [item for item in self._series.values() if item is not None]

        def of_kind(kind: str) -> Iterator[tuple[str, list[Any]]]:
            return ((item.topic.name, item.in_order()) for item in found if item.topic.kind == kind and item.times)

        samples = {name: Measured(*columns) for name, columns in of_kind(keys.SAMPLE)}
        self._seen |= {name: _seen(self._seen.get(name), item) for name, item in samples.items()}
        run = Run(
            plant=self._plant,
            units={item.topic.name: item.unit for item in found if item.unit},
            measured=samples,
            estimated={name: Estimated(*columns) for name, columns in of_kind(keys.ESTIMATE)},
            charts={name: Charted(*columns) for name, columns in of_kind(keys.CHART)},
            alarms=tuple(sorted(self._alarms, key=lambda change: change.time_ns)),
            faults=tuple(sorted(self._faults, key=lambda change: change.time_ns)),
            reconstructed={name: Reconstructed(*columns) for name, columns in of_kind(keys.RECONSTRUCTION)},
            models={name: _last_of_each_time(items) for name, items in self._models.items()},
            health={node: _last_of_each_time(items) for node, items in self._health.items()},
            seen=dict(self._seen),
            earlier=self._earlier,
            counted_from_ns=self._counted_from_ns,
        )
        self._earlier = _after(run)
        for item in found:
            item.clear()
        self._alarms, self._faults, self._models, self._health = [], [], {}, {}
        return run


def _after(run: Run) -> Earlier:
    """What a stretch leaves to the next."""
    earlier = run.earlier
    newest = {name: _newest(earlier.last.get(name), item) for name, item in run.measured.items()}
    onsets = (change.onset_ns for change in run.faults if change.active)
    return replace(
        earlier,
        first_ns=run.first_ns if run.measured or earlier.first_ns is not None else None,
        last={**earlier.last, **newest},
        states={**earlier.states, **{change.alarm: change.state for change in run.alarms}},
        suspected_ns=max(
            (change.time_ns for change in run.alarms if change.event == SUSPECTED), default=earlier.suspected_ns
        ),
        onset_ns=next(onsets, None) if earlier.onset_ns is None else earlier.onset_ns,
    )


def _newest(before: Measured | None, item: Measured) -> Measured:
    """The newest two samples, in order of time."""
    time_ns, value = item.time_ns[-2:], item.value[-2:]
    if before is not None and time_ns.size < 2:
        time_ns, value = np.append(before.time_ns, time_ns)[-2:], np.append(before.value, value)[-2:]
    return Measured(time_ns.copy(), value.copy())


def _seen(before: Seen | None, item: Measured) -> Seen:
    values = item.value[np.isfinite(item.value)]
    now = Seen(values.size, float(values.mean()), float(values.min()), float(values.max())) if values.size else _NOTHING
    if before is None or not before.rows or not now.rows:
        return now if now.rows or before is None else before
    rows = before.rows + now.rows
    mean = before.mean + (now.mean - before.mean) * now.rows / rows
    return Seen(rows, mean, min(before.lowest, now.lowest), max(before.highest, now.highest))


_NOTHING = Seen(0, float("nan"), float("inf"), -float("inf"))


_Dated = TypeVar("_Dated", Snapshot, Report)


def _last_of_each_time(items: list[_Dated]) -> tuple[_Dated, ...]:
    """In order of time; of several at one time the last counts."""
    newest = {item.time_ns: item for item in items}
    return tuple(newest[time_ns] for time_ns in sorted(newest))


def _use(message: messages.ModelSnapshot) -> str:
    """The purpose of a model."""
    if message.structure == EQUATIONS:
        return EQUATIONS
    if message.reference:
        return JUDGES
    return HELD if message.held else ADAPTS


def _snapshot(message: messages.ModelSnapshot, time_ns: int) -> Snapshot:
    parameters = {item.name: (item.value, item.sd) for item in message.parameters}
    return Snapshot(time_ns, parameters, message.excitation, message.condition)


def _report(message: messages.Health, time_ns: int) -> Report:
    counts = {name: getattr(message, name) for name in ("lost", "late", "refused", "duplicated", "out_of_order")}
    return Report(time_ns, message.phase, message.lag_ms, counts)


class _Kind(NamedTuple):
    message: type[Message]
    numbers: Callable[[Any], tuple[float, ...]] | None = None  # in the order of the columns; None: no column of numbers


_KINDS = {
    keys.SAMPLE: _Kind(messages.Sample, lambda m: () if (value := measured(m)) is None else (value,)),
    keys.ESTIMATE: _Kind(messages.Estimate, lambda m: (m.prediction, m.residual, m.lower_limit, m.upper_limit)),
    keys.CHART: _Kind(
        messages.ChartPoint, lambda m: (m.statistic, m.centre, m.lower_limit, m.upper_limit, float(m.out))
    ),
    keys.RECONSTRUCTION: _Kind(messages.Reconstruction, lambda m: (m.value, m.sd)),
    keys.ALARM: _Kind(messages.Alarm),
    keys.FAULT: _Kind(messages.Fault),
    keys.MODEL: _Kind(messages.ModelSnapshot),
    keys.HEALTH: _Kind(messages.Health),
}


class _Series:
    """The numbers of one key, as they come."""

    def __init__(self, topic: keys.Topic) -> None:
        self.topic = topic
        self.unit = ""
        self.times = array("q")
        self._numbers = array("d")  # those of a message side by side
        self._of = _KINDS[topic.kind].numbers or (lambda message: ())

    @classmethod
    def of(cls, key: str) -> "_Series | None":
        """The series of a key; None if there is nothing to draw of it."""
        topic = keys.parse(key)
        return cls(topic) if topic is not None and topic.kind in _KINDS else None

    def append(self, message: Any, time_ns: int) -> None:
        """Add a message's numbers, if it has any, at a time."""
        numbers = self._of(message)
        if not numbers:
            return
        if not self.unit:
            self.unit = getattr(message, "unit", "")
        self.times.append(time_ns)
        self._numbers.extend(numbers)

    def in_order(self) -> list[NDArray[Any]]:
        """The times and the columns, in order of time."""
        times = np.array(self.times, np.int64)
        columns = list(np.array(self._numbers).reshape(times.size, -1).T.copy())
        if (np.diff(times) < 0).any():
            order = np.argsort(times, kind="stable")
            return [times[order], *(column[order] for column in columns)]
        return [times, *columns]

    def clear(self) -> None:
        """Forget the numbers."""
        self.times, self._numbers = array("q"), array("d")
