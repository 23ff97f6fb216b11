"""A monitor that is fed from Python."""

from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime
from math import isfinite
from typing import Any, TypeAlias

import msgspec
from google.protobuf.message import Message

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor as MonitorCore
from monitor_node.diagnosis_worker import find_deviations
from monitor_node.watched_process import load_process, watch_process
from reactorwatch.api.records import ProcessLike
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication, encode
from reactorwatch.contract.messages_pb2 import Alarm, Incident, Quality, Sample
from reactorwatch.contract.messages_pb2 import Suspect as SuspectMessage
from reactorwatch.contract.suspects import NewSuspects
from reactorwatch.description.process import Process
from reactorwatch.description.read import find_process
from reactorwatch.errors import InputError
from reactorwatch.records.record import Record, to_minutes, to_time_ns
from reactorwatch.results.alarms import Suspect
from reactorwatch.runtime.config import section
from reactorwatch.sentences.alarm import priority_word


class AlarmChange(msgspec.Struct, frozen=True):
    """A change of an alarm.

    Attributes:
        time_min: time of the row that caused it, in minutes.
        alarm: name of the alarm, `chart/signal`.
        event: `raised`, `cleared`, `suspected` (new suspects of the incident of this alarm) and others, see
            `docs/alarms.md`.
        priority: `low`, `medium`, `high` or `critical`.
        text: a sentence for people.
        suspect: likely causes, the likeliest first.
    """

    time_min: float
    alarm: str
    event: str
    priority: str
    text: str
    suspect: list[Suspect]


class Monitor:
    """A monitor that is fed row by row, without a bus.

    The first row after the training takes some tenths of a second, in which the training is diagnosed.

    Args:
        process: name, path of a file that describes it, description or model; None: as the settings say.
        settings: settings of the monitor, as for `backtest`.

    >>> monitor = Monitor(outputs=("T",), reference="arx", training_min=10.0)
    >>> monitor.update(0.0, {"qc": 100.0, "T": 440.0})
    []
    >>> monitor.phase
    'training'
    """

    def __init__(self, process: ProcessLike | None = None, **settings: Any) -> None:
        described = None if process is None else find_process(process, on_bus=True)
        config = monitor_settings(settings, described)
        self._config, model = load_process(config) if described is None else watch_process(config, described)
        self._core = MonitorCore(self._config, 0, points=False, model=model, diagnose=find_deviations)
        self._rows = 0
        self._suspects = self._known_suspects()

    @property
    def phase(self) -> str:
        """`training` or `watching`."""
        return self._core.phase

    def update(
        self, time_min: float, values: Mapping[str, float], units: Mapping[str, str] | None = None
    ) -> list[AlarmChange]:
        """Process one row.

        Args:
            time_min: time of the row, at least 0.
            values: values by signal; a missing signal was not measured.
            units: units of the signals, by name; None: not known.

        Returns:
            The changes of alarms that the row causes.
        """
        time_ns, changes = to_time_ns(time_min), []
        for signal, value in values.items():
            sample = Sample(
                time_ns=time_ns,
                sequence=self._rows,
                value=value,
                unit=(units or {}).get(signal, ""),
                quality=Quality.QUALITY_GOOD,
            )
            message = encode(Publication(keys.key(self._config.plant, keys.SAMPLE, signal), sample))
            published = (item.message for item in self._core.on_message(message, time_ns))
            changes += [change for item in published if (change := self._change(item)) is not None]
        self._rows += 1
        return changes

    def feed(self, rows: Any, time: str = "time_min") -> Iterator[AlarmChange]:
        """Process rows from anywhere, and yield the changes of alarms as they come.

        Args:
            rows: a record, a data frame (pandas or polars), or an iterable of mappings of names to values, such as a
                `csv.DictReader` or a generator; an empty or missing value was not measured.
            time: name of the time: minutes, or clock times (`datetime`), which are counted from the first row.

        Raises:
            InputError: a row has no time, or a cell is no number.
        """
        for minute, values in iterate_rows(rows, time):
            yield from self.update(minute, {name: value for name, value in values.items() if isfinite(value)})

    def to_bytes(self) -> bytes:
        """The state; a monitor of the same settings that it is restored into goes on with bit-identical output."""
        return msgspec.msgpack.encode((self._rows, self._core.to_bytes()))

    def from_bytes(self, state: bytes) -> None:
        """Restore the state of a monitor of the same settings.

        Raises:
            InputError: the bytes are no such state.
        """
        try:
            rows, core = msgspec.msgpack.decode(state, type=tuple[int, bytes])
        except msgspec.DecodeError as error:
            raise InputError(f"the state of a monitor cannot be read: {error}") from error
        self._core.from_bytes(core)
        self._rows = rows
        self._suspects = self._known_suspects()

    def _known_suspects(self) -> NewSuspects:
        incidents = self._core.alarms.memory.incidents
        return NewSuspects({item.number: [cause.message for cause in item.suspects] for item in incidents})

    def _change(self, message: Message) -> AlarmChange | None:
        """Change of an alarm, or new suspects of an incident at its first-out alarm; None for another message."""
        if isinstance(message, Alarm):
            return _alarm_change(message, message.event, message.suspects)
        if not isinstance(message, Incident) or not self._suspects.update(message.number, message.suspects):
            return None
        return _alarm_change(self._core.alarms.alarm(message.alarms[0]), "suspected", message.suspects)


def _alarm_change(alarm: Alarm, event: str, suspects: Iterable[SuspectMessage]) -> AlarmChange:
    causes = [Suspect.of(item) for item in suspects]
    return AlarmChange(to_minutes(alarm.time_ns), alarm.alarm, event, priority_word(alarm.priority), alarm.text, causes)


def monitor_settings(settings: Mapping[str, Any], process: Process | None = None) -> MonitorConfig:
    """The monitor's settings.

    Args:
        settings: values by key.
        process: process whose signals they are about; None: as the settings say.

    Raises:
        InputError: an unknown name or a value outside its range.
    """
    about = {"plant": keys.DEFAULT_PLANT, **settings} | ({} if process is None else {"process": process.name})
    return section(MonitorConfig, "monitor", {}, about)


Row: TypeAlias = tuple[float, dict[str, float]]
"""Minute, and values by signal; NaN: not measured."""


def iterate_rows(source: Any, time: str = "time_min") -> Iterator[Row]:
    """Iterate over rows.

    Args:
        source: a record; a data frame (pandas or polars); or an iterable of mappings, such as a `csv.DictReader`, a
            generator that reads a socket, or a database cursor with rows by name.
        time: name of the column with the time: minutes, or clock times (`datetime`), which are counted from the first.

    Raises:
        InputError: a row has no time, or a cell is no number.
    """
    if isinstance(source, Record):
        for row, minute in enumerate(source.time_min.tolist()):
            yield minute, {name: float(values[row]) for name, values in source.columns.items()}
        return
    zero: datetime | None = None
    for number, row in enumerate(_mappings(source)):
        if not isinstance(row, Mapping):
            raise InputError(f"row {number}: must be a mapping of names to values, got {type(row).__name__}")
        if time not in row:
            raise InputError(f"row {number}: has no {time!r}, only {', '.join(map(str, row))}; name it with time=")
        moment = row[time]
        if isinstance(moment, datetime):
            zero = zero or moment
            minute = (moment - zero).total_seconds() / 60
        else:
            minute = _number(moment, time, number)
        yield minute, {str(name): _number(value, str(name), number) for name, value in row.items() if name != time}


def _mappings(source: Any) -> Iterator[Any]:
    """Rows of a data frame by name; another iterable as it is."""
    if hasattr(source, "iter_rows"):  # polars
        yield from source.iter_rows(named=True)
    elif hasattr(source, "itertuples"):  # pandas
        flat = source if source.index.name is None else source.reset_index()
        names = list(flat.columns)
        yield from (dict(zip(names, row, strict=True)) for row in flat.itertuples(index=False, name=None))
    else:
        yield from source


def _number(value: Any, name: str, number: int) -> float:
    if value is None or value == "":
        return float("nan")
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"row {number}: {name} must be a number, got {value!r}") from error
