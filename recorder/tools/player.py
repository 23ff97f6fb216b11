"""Replay of recorded messages at a given rate. Pure: no file, no bus, no clock.

The rate refers to sample times, not to times of receipt: CSV records have only those, and a recording of an accelerated
plant is that of the same plant. Messages are published in the order of receipt; one with an older sample than the one
before is published at once. After the plant's clock stepped back, the next run follows one row after the run before
(`RunSplitter.continuous_ns`).
"""

import math
from collections import defaultdict
from collections.abc import Callable, Container, Iterable, Iterator
from typing import cast

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Body, Publication
from reactorwatch.records.record import MINUTE_NS, NEVER_NS, Record, to_time_ns
from reactorwatch.runtime.bus import Node
from recorder import RecordedMessage
from recorder.keep import STATES
from recorder.samples import RunSplitter, decode_messages

BATCH = 256
"""Largest number of messages published in one tick, so that the loop notices a stop."""

SAMPLES = frozenset({keys.SAMPLE})
EVERYTHING = frozenset(
    {
        keys.SAMPLE,
        keys.ESTIMATE,
        keys.MODEL,
        keys.CHART,
        keys.ALARM,
        keys.INCIDENT,
        keys.ALARM_KPIS,
        keys.RECONSTRUCTION,
        keys.BASELINE,
        keys.PROMISE,
        keys.FAULT,
    }
)
"""Kinds that a plant and a monitor publish, without health, which concerns nodes of the recorded time."""


def samples_of(record: Record, plant: str, zero_ns: int = 0) -> Iterator[Publication]:
    """Samples of a record as a plant would publish them: row by row, the input first.

    Args:
        record: the record.
        plant: name of the plant on the bus.
        zero_ns: time that the record's minutes count from.

    Yields:
        The samples, also those out of their signal's bounds, which a monitor checks; for a row without any, one sample
        of bad quality, so that the row is not lost. Sequence numbers count from 0 for each signal. They restart where a
        run starts at a later time, as after a restart of the plant, and continue where the clock steps back, as after a
        change of the clock.
    """
    sequences = dict.fromkeys(record.columns, 0)
    columns = {signal: values.tolist() for signal, values in record.raw_columns.items()}
    names = {signal: keys.key(plant, keys.SAMPLE, signal) for signal in columns}
    times_min = record.time_min.tolist()
    restarts = {row for row in record.run_starts[1:] if times_min[row] > times_min[row - 1]}
    for row, minutes in enumerate(times_min):
        if row in restarts:
            sequences = dict.fromkeys(sequences, 0)
        time_ns = to_time_ns(minutes, zero_ns)
        measured = [signal for signal, values in columns.items() if not math.isnan(values[row])]
        for signal in measured or list(columns)[:1]:
            sample = messages.Sample(
                time_ns=time_ns,
                sequence=sequences[signal],
                value=columns[signal][row],
                unit=record.units.get(signal, ""),
                quality=messages.QUALITY_GOOD if measured else messages.QUALITY_BAD,
            )
            sequences[signal] += 1
            yield Publication(names[signal], sample)


def filter_playable(
    recording: Iterable[RecordedMessage],
    plant: str = "",
    kinds: frozenset[str] = SAMPLES,
    signals: Container[str] | None = None,
) -> Iterator[Publication]:
    """Messages of a recording that can be replayed.

    Args:
        recording: messages in the order of receipt.
        plant: name of the plant to publish under; empty keeps the recorded name.
        kinds: kinds of messages to replay.
        signals: signals whose samples are replayed; None: all.

    Yields:
        The publications, without undecodable messages and keys of other programs.
    """
    for topic, message in decode_messages(recording):
        if topic.kind not in kinds:
            continue
        if signals is not None and topic.kind == keys.SAMPLE and topic.name not in signals:
            continue
        if hasattr(message, "time_ns"):
            yield Publication(keys.key(plant or topic.plant, topic.kind, topic.name), cast(Body, message))


def filter_time(publications: Iterable[Publication], from_ns: int, to_ns: int) -> Iterator[Publication]:
    """Publications about samples within a time, both ends included, after the alarms that are standing at its start."""
    standing: dict[str, Publication] | None = {}
    for publication in publications:
        message, time_ns = publication.message, publication.message.time_ns
        if time_ns < from_ns and isinstance(message, messages.Alarm) and standing is not None:
            standing.pop(publication.key, None)
            if message.state != messages.ALARM_STATE_NORMAL:
                standing[publication.key] = publication
        elif from_ns <= time_ns <= to_ns:
            yield from (standing or {}).values()
            standing = None
            yield publication


def _schedule(tape: Iterable[Publication]) -> Iterator[tuple[Publication, int]]:
    """Add to each publication its time, continuous over the runs of its plant."""
    clocks = defaultdict[str, RunSplitter](RunSplitter)
    first: list[Publication] | None = []  # latched messages before all else: they are due with what follows them
    for publication in tape:
        if first is not None and type(publication.message) in STATES:
            first.append(publication)
            continue
        time_ns = clocks[publication.key.split("/", 2)[1]].continuous_ns(*publication)
        yield from ((latched, time_ns) for latched in first or ())
        first = None
        yield publication, time_ns
    yield from ((latched, latched.message.time_ns) for latched in first or ())


class Player(Node):
    """Publishes messages when they are due.

    Args:
        open_tape: returns the publications from the start, each time it is called.
        rate: plant time over clock time; inf does not wait.
        loop: True to restart at the end, one row after the last row.
        on_wait: called with a wait in seconds that is long and much longer than those between the rows before.

    Attributes:
        paused: True while it waits to be resumed or stepped.
        rate: plant time over clock time.
        published: number of published messages.
    """

    def __init__(
        self,
        open_tape: Callable[[], Iterator[Publication]],
        rate: float,
        *,
        loop: bool = False,
        on_wait: Callable[[float], None] = lambda _wait_s: None,
    ) -> None:
        self._open_tape, self._on_wait, self._loop = open_tape, on_wait, loop
        self.rate, self.paused, self.published = rate, False, 0
        self._tape = _schedule(open_tape())
        self._next = next(self._tape, None)
        self._first_ns = 0 if self._next is None else self._next[1]
        self._spacing_ns, self._is_jump = 0, False  # between the last two rows
        self._anchor: tuple[int, int] | None = None  # (clock time, plant time) of one moment

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Publish due messages; the first call starts the replay."""
        if self._next is not None and self._anchor is None:
            self._anchor = now_ns, self._next[1]
        due: list[Publication] = []
        while self._next is not None and len(due) < BATCH and self.next_tick_ns() <= now_ns:
            due.append(self._take(*self._next))
        if due and self._next is not None and self._is_jump and not self.paused:
            wait_ns = self.next_tick_ns() - now_ns
            if wait_ns > MINUTE_NS:
                self._on_wait(wait_ns / 1e9)
        return due

    def next_tick_ns(self) -> int:
        """Time at which the next message is due."""
        if self.paused:
            return NEVER_NS
        if self._anchor is None or self._next is None:
            return 0
        clock_ns, plant_ns = self._anchor
        return clock_ns + round((self._next[1] - plant_ns) / self.rate)

    @property
    def finished(self) -> bool:
        """True if every message was published."""
        return self._next is None

    def set_pace(self, now_ns: int, *, rate: float | None = None, paused: bool | None = None) -> None:
        """Change the rate, pause, or resume after the rest of the time to the next message."""
        plant_ns = self._plant_time_ns(now_ns)
        if plant_ns is not None:
            self._anchor = now_ns, plant_ns
        self.rate = self.rate if rate is None else rate
        self.paused = self.paused if paused is None else paused

    def step(self, now_ns: int) -> list[Publication]:
        """Publish the next row of a paused replay: all messages of the next time."""
        row: list[Publication] = []
        at_ns = self._next[1] if self._next is not None and self.paused else None
        while self._next is not None and self._next[1] == at_ns:
            self._anchor = now_ns, self._next[1]
            row.append(self._take(*self._next))
        return row

    @property
    def status(self) -> str:
        """State and rate, for people."""
        state = "at the end" if self._next is None else "paused" if self.paused else "playing"
        return f"{state} at {self.rate:g} times the plant's pace"

    def position_min(self, now_ns: int) -> float | None:
        """Plant time since the first message (min); None before the start and at the end."""
        plant_ns = self._plant_time_ns(now_ns)
        return None if plant_ns is None else (plant_ns - self._first_ns) / MINUTE_NS

    def _plant_time_ns(self, now_ns: int) -> int | None:
        """Current plant time, at most that of the next message; None before the start."""
        if self._anchor is None or self._next is None:
            return None
        clock_ns, plant_ns = self._anchor
        if self.paused:
            return plant_ns
        next_ns = self._next[1]
        return next_ns if math.isinf(self.rate) else min(next_ns, plant_ns + round((now_ns - clock_ns) * self.rate))

    def _take(self, publication: Publication, time_ns: int) -> Publication:
        """Advance to the next message, at the end of a loop to the first."""
        self.published += 1
        self._next = next(self._tape, None)
        if self._next is not None:
            spacing_ns = self._next[1] - time_ns
            self._is_jump = spacing_ns > 2 * self._spacing_ns  # the recorded clock was set, or the plant stood still
            self._spacing_ns = spacing_ns or self._spacing_ns
        elif self._loop:
            self._tape = _schedule(self._open_tape())
            self._next = next(self._tape, None)
            if self._next is not None and self._anchor is not None:
                clock_ns, plant_ns = self._anchor
                self._anchor = clock_ns, plant_ns - (time_ns + max(self._spacing_ns, 0) - self._next[1])
        return publication
