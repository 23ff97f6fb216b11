"""A recording as columns, for drawing. Pure.

One pass over the messages; the numbers go into growing arrays, so that a run of millions of samples costs a few bytes
a number and not an object each.
"""

from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import Message
from numpy.typing import NDArray

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import DecodeError, Encoded, decode
from reactorwatch.errors import InputError
from reactorwatch.records.record import UNITS
from recorder.entry import Entry
from recorder.measurement import measured

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


@dataclass(frozen=True)
class Run:
    """One plant's run.

    Attributes:
        plant: its name; empty if there is nothing of it.
        units: by signal.
        measured: by signal.
        estimated: by signal.
        charts: by the name of the chart and the signal, `ewma/T`.
        alarms: in order of time.
        faults: in order of time.
    """

    plant: str
    units: dict[str, str]
    measured: dict[str, Measured]
    estimated: dict[str, Estimated]
    charts: dict[str, Charted]
    alarms: tuple[AlarmChange, ...]
    faults: tuple[FaultChange, ...]

    @property
    def span_ns(self) -> tuple[int, int]:
        """The times of the first and of the last sample; both 0 if there is none."""
        series = [item.time_ns for item in self.measured.values()]
        return (min(int(t[0]) for t in series), max(int(t[-1]) for t in series)) if series else (0, 0)


def read_run(recording: Iterable[Entry | Encoded]) -> Run:
    """The run that a recording tells of.

    Args:
        recording: the messages of one plant, in any order; those of other kinds, and what cannot be decoded, are
            passed over.

    Raises:
        InputError: the messages are of several plants.
    """
    series: dict[str, _Series | None] = {}
    plants: set[str] = set()
    alarms: list[AlarmChange] = []
    faults: list[FaultChange] = []
    for entry in recording:
        if entry.key not in series:
            series[entry.key] = _Series.of(entry.key)
        into = series[entry.key]
        if into is None:
            continue
        try:
            message: Any = decode(entry.payload, entry.encoding)
        except DecodeError:
            continue
        if type(message) is not _KINDS[into.topic.kind].message:
            continue
        plants.add(into.topic.plant)
        if into.topic.kind == keys.ALARM:
            alarms.append(AlarmChange(*(getattr(message, name) for name in AlarmChange._fields)))
        elif into.topic.kind == keys.FAULT:
            faults.append(FaultChange(*(getattr(message, name) for name in FaultChange._fields)))
        else:
            into.append(message)
    if len(plants) > 1:
        raise InputError(f"a run is of one plant; name one of {', '.join(sorted(plants))}")
    found = [item for item in series.values() if item is not None]

    def of_kind(kind: str) -> Iterator[tuple[str, list[Any]]]:
        return ((item.topic.name, item.in_order()) for item in found if item.topic.kind == kind and item.times)

    return Run(
        plant=next(iter(plants), ""),
        units=UNITS | {item.topic.name: item.unit for item in found if item.unit},
        measured={name: Measured(*columns) for name, columns in of_kind(keys.SAMPLE)},
        estimated={name: Estimated(*columns) for name, columns in of_kind(keys.ESTIMATE)},
        charts={name: Charted(*columns) for name, columns in of_kind(keys.CHART)},
        alarms=tuple(sorted(alarms, key=lambda change: change.time_ns)),
        faults=tuple(sorted(faults, key=lambda change: change.time_ns)),
    )


class _Kind(NamedTuple):
    message: type[Message]
    numbers: Callable[[Any], tuple[float, ...]] = lambda message: ()  # in the order of the fields above


_KINDS = {
    keys.SAMPLE: _Kind(messages.Sample, lambda m: () if (value := measured(m)) is None else (value,)),
    keys.ESTIMATE: _Kind(messages.Estimate, lambda m: (m.prediction, m.residual, m.lower_limit, m.upper_limit)),
    keys.CHART: _Kind(
        messages.ChartPoint, lambda m: (m.statistic, m.centre, m.lower_limit, m.upper_limit, float(m.out))
    ),
    keys.ALARM: _Kind(messages.Alarm),
    keys.FAULT: _Kind(messages.Fault),
}


class _Series:
    """The numbers of one key, as they come."""

    def __init__(self, topic: keys.Topic) -> None:
        self.topic = topic
        self.unit = ""
        self.times = array("q")
        self._numbers = array("d")  # those of a message side by side
        self._of = _KINDS[topic.kind].numbers

    @classmethod
    def of(cls, key: str) -> "_Series | None":
        """The series of a key; None if there is nothing to draw of it."""
        topic = keys.parse(key)
        return cls(topic) if topic is not None and topic.kind in _KINDS else None

    def append(self, message: Any) -> None:
        """Add a message's numbers, if it has any."""
        numbers = self._of(message)
        if not numbers:
            return
        if not self.times:
            self.unit = getattr(message, "unit", "")
        self.times.append(message.time_ns)
        self._numbers.extend(numbers)

    def in_order(self) -> list[NDArray[Any]]:
        """The times and the columns, in order of time."""
        times = np.array(self.times, np.int64)
        columns = list(np.array(self._numbers).reshape(times.size, -1).T.copy())
        if (np.diff(times) < 0).any():
            order = np.argsort(times, kind="stable")
            return [times[order], *(column[order] for column in columns)]
        return [times, *columns]
