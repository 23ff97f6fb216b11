"""Plays stored messages back at a pace. Pure: no file, no bus, no clock of its own.

The pace is that of the sample times, not of the times of receipt: a record from elsewhere has only those, and a
recording of a plant that ran sixty times faster than the clock is the same plant. Messages go out in the order in
which they were received; one whose sample is older than what went before goes out at once. Where the plant's clock
stepped back, the run that follows is played at its pace, one row after the run before it (`ContinuousTime`).
"""

import math
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, cast

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Body, DecodeError, Encoded, Publication, decode
from reactorwatch.contract.commands import decode_command
from reactorwatch.contract.messages_pb2 import CommandReply
from reactorwatch.errors import InputError
from reactorwatch.records.record import Record, to_time_ns
from recorder.columns.run_splitter import ContinuousTime
from recorder.message import RecordedMessage

BATCH = 256
"""Messages that go out before the loop looks for a stop again."""

NEVER_NS = 2**62

COMMANDS = dict.fromkeys(("pause", "resume", "step", "set_rate"), messages.ReplayCommand)
"""The commands and what they carry."""

SAMPLES = frozenset({keys.SAMPLE})
EVERYTHING = frozenset(
    {
        keys.SAMPLE,
        keys.ESTIMATE,
        keys.MODEL,
        keys.CHART,
        keys.ALARM,
        keys.ALARM_KPIS,
        keys.RECONSTRUCTION,
        keys.FAULT,
    }
)
"""What a plant and a monitor publish. Health speaks of nodes that are not there, commands were heard once."""


def samples_of(record: Record, plant: str, zero_ns: int = 0) -> Iterator[Publication]:
    """A record as the plant would have published it: row by row, the input first.

    Args:
        record: the record.
        plant: its name on the bus.
        zero_ns: the time that the record's minutes count from.

    Yields:
        The samples; none for what was not measured, but one of bad quality where nothing at all was, so that the row
        is not lost. Each signal is counted from 0, and again from 0 where a run starts after the one before it, as a
        plant counts that was restarted. Where the clock steps back the count goes on, as of a plant whose clock was
        set.
    """
    sequences = dict.fromkeys(record.columns, 0)
    columns = {signal: values.tolist() for signal, values in record.columns.items()}
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


def playable(
    entries: Iterable[RecordedMessage], plant: str = "", kinds: frozenset[str] = SAMPLES
) -> Iterator[Publication]:
    """The messages of a recording that can be played back.

    Args:
        entries: the recording, in order of receipt.
        plant: the name to publish them under; empty for that of the recording.
        kinds: what is played.

    Yields:
        The publications; what no node of ours has published, or what cannot be decoded, is left out.
    """
    for entry in entries:
        topic = keys.parse(entry.key)
        if topic is None or topic.kind not in kinds:
            continue
        try:
            message = decode(entry.payload, entry.encoding)
        except DecodeError:
            continue  # it was refused when it was recorded, and counted
        if hasattr(message, "time_ns"):
            yield Publication(keys.key(plant or topic.plant, topic.kind, topic.name), cast(Body, message))


def between(publications: Iterable[Publication], from_ns: int, to_ns: int) -> Iterator[Publication]:
    """Those that speak of samples from one time to another, both included."""
    return (publication for publication in publications if from_ns <= publication.message.time_ns <= to_ns)


class _Due(NamedTuple):
    """A publication, and the time by which it is paced."""

    publication: Publication
    time_ns: int


def _paced(tape: Iterable[Publication]) -> Iterator[_Due]:
    """The publications with times that increase from run to run of each plant."""
    clocks: dict[str, ContinuousTime] = {}
    for publication in tape:
        plant = publication.key.split("/", 2)[1]
        clock = clocks.get(plant)
        if clock is None:
            clock = clocks[plant] = ContinuousTime()
        yield _Due(publication, clock.of(*publication))


class Player:
    """Hands out publications when they are due; see `reactorwatch.runtime.event_loop.Node`.

    Args:
        open_tape: gives what is to be played, from its beginning each time it is called.
        rate: plant time over clock time; infinite: without waiting.
        loop: whether it begins anew at the end, one row's time after the last row.

    Attributes:
        published: messages so far.
    """

    def __init__(self, open_tape: Callable[[], Iterator[Publication]], rate: float, *, loop: bool = False) -> None:
        self._open_tape = open_tape
        self._tape = _paced(open_tape())
        self._rate = rate
        self._loop = loop
        self._paused = False
        self._next = next(self._tape, None)
        self._spacing_ns = 0  # of the last two rows
        self._anchor: tuple[int, int] | None = None  # a moment of the clock, and the plant's time then
        self.published = 0

    # --- what the loop calls ---------------------------------------------------------------------------------

    def on_tick(self, now_ns: int) -> list[Publication]:
        """What is due; the first call starts the play."""
        if self._next is not None and self._anchor is None:
            self._anchor = now_ns, self._next.time_ns
        due: list[Publication] = []
        while self._next is not None and len(due) < BATCH and self.next_tick_ns() <= now_ns:
            due.append(self._take(self._next))
        self.published += len(due)
        return due

    def next_tick_ns(self) -> int:
        """When the next message is due."""
        if self._paused:
            return NEVER_NS
        if self._anchor is None or self._next is None:
            return 0
        clock_ns, plant_ns = self._anchor
        return clock_ns + round((self._next.time_ns - plant_ns) / self._rate)

    @property
    def finished(self) -> bool:
        """Whether all was played."""
        return self._next is None

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """It listens to nothing."""
        return []

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        """Pause, go on, go a step, or change the rate; or say why not."""
        try:
            text, publications = self._obey(question, now_ns)
        except (InputError, DecodeError) as error:
            return CommandReply(accepted=False, text=str(error)), []
        self.published += len(publications)
        return CommandReply(accepted=True, text=text), publications

    def on_stop(self, now_ns: int) -> list[Publication]:
        """It has no last words."""
        return []

    # --- within ----------------------------------------------------------------------------------------------

    def _obey(self, question: Encoded, now_ns: int) -> tuple[str, list[Publication]]:
        name, command = decode_command(question, COMMANDS)
        assert isinstance(command, messages.ReplayCommand), "the catalogue holds no others"
        if name == "set_rate" and not command.rate > 0.0:
            raise InputError(f"rate must be positive, got {command.rate:g}")
        if name == "step" and not self._paused:
            raise InputError("the replay is not paused; pause it before a step")
        plant_ns = self._plant_time_ns(now_ns)
        if plant_ns is not None:
            self._anchor = now_ns, plant_ns
        stepped: list[Publication] = []
        if name == "step":
            for _ in range(command.rows or 1):
                stepped += self._row(now_ns)
        elif name == "set_rate":
            self._rate = command.rate
        else:
            self._paused = name == "pause"
        return f"{self._doing} at {self._rate:g} times the plant's pace", stepped

    @property
    def _doing(self) -> str:
        if self._next is None:
            return "at the end"
        return "paused" if self._paused else "playing"

    def _plant_time_ns(self, now_ns: int) -> int | None:
        """How far the play has come; None before its start. It is never beyond what is due next."""
        if self._anchor is None or self._next is None:
            return None
        clock_ns, plant_ns = self._anchor
        next_ns = self._next.time_ns
        if self._paused or math.isinf(self._rate):
            return plant_ns if self._paused else next_ns
        return min(next_ns, plant_ns + round((now_ns - clock_ns) * self._rate))

    def _row(self, now_ns: int) -> list[Publication]:
        """All messages of the next time, which the play has then come to."""
        row: list[Publication] = []
        first_ns = self._next.time_ns if self._next is not None else 0
        while self._next is not None and self._next.time_ns == first_ns:
            self._anchor = now_ns, first_ns
            row.append(self._take(self._next))
        return row

    def _take(self, due: _Due) -> Publication:
        """Move on behind a message, at the end to the beginning."""
        self._next = next(self._tape, None)
        if self._next is not None:
            self._spacing_ns = self._next.time_ns - due.time_ns or self._spacing_ns
        elif self._loop:
            self._tape = _paced(self._open_tape())
            self._next = next(self._tape, None)
            if self._next is not None and self._anchor is not None:
                clock_ns, plant_ns = self._anchor
                self._anchor = clock_ns, plant_ns - (due.time_ns + max(self._spacing_ns, 0) - self._next.time_ns)
        return due.publication
