"""Plays stored messages back at a pace. Pure: no file, no bus, no clock of its own.

The pace is that of the sample times, not of the times of receipt: a record from elsewhere has only those, and a
recording of a plant that ran sixty times faster than the clock is the same plant. Messages go out in the order in
which they were received; one whose sample is older than what went before goes out at once.
"""

import math
from collections.abc import Iterable, Iterator
from typing import cast

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Body, DecodeError, Encoded, Publication, decode
from reactorwatch.contract.messages_pb2 import CommandReply
from reactorwatch.records.record import UNITS, Record, to_time_ns
from recorder.entry import Entry

BATCH = 256
"""Messages that go out before the loop looks for a stop again."""

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
        is not lost. Each signal is counted from 0.
    """
    sequences = dict.fromkeys(record.columns, 0)
    columns = {signal: values.tolist() for signal, values in record.columns.items()}
    names = {signal: keys.key(plant, keys.SAMPLE, signal) for signal in columns}
    for row, minutes in enumerate(record.time_min.tolist()):
        time_ns = to_time_ns(minutes, zero_ns)
        measured = [signal for signal, values in columns.items() if not math.isnan(values[row])]
        for signal in measured or list(columns)[:1]:
            sample = messages.Sample(
                time_ns=time_ns,
                sequence=sequences[signal],
                value=columns[signal][row],
                unit=UNITS[signal],
                quality=messages.QUALITY_GOOD if measured else messages.QUALITY_BAD,
            )
            sequences[signal] += 1
            yield Publication(names[signal], sample)


def playable(entries: Iterable[Entry], plant: str = "", kinds: frozenset[str] = SAMPLES) -> Iterator[Publication]:
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


class Player:
    """Hands out publications when they are due; see `reactorwatch.runtime.serve.Node`.

    Args:
        publications: what is to be played.
        rate: plant time over clock time; infinite: without waiting.
    """

    def __init__(self, publications: Iterator[Publication], rate: float) -> None:
        self._publications = publications
        self._rate = rate
        self._next = next(publications, None)
        self._first_ns = self._next.message.time_ns if self._next is not None else 0
        self._start_ns: int | None = None
        self.published = 0

    def on_tick(self, now_ns: int) -> list[Publication]:
        """What is due; the first call starts the play."""
        if self._start_ns is None:
            self._start_ns = now_ns
        due: list[Publication] = []
        while self._next is not None and len(due) < BATCH and self.next_tick_ns() <= now_ns:
            due.append(self._next)
            self._next = next(self._publications, None)
        self.published += len(due)
        return due

    def next_tick_ns(self) -> int:
        """When the next message is due."""
        if self._start_ns is None or self._next is None:
            return 0
        return self._start_ns + round((self._next.message.time_ns - self._first_ns) / self._rate)

    @property
    def finished(self) -> bool:
        """Whether all was played."""
        return self._next is None

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """It listens to nothing."""
        return []

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        """It takes none."""
        return CommandReply(accepted=False, text="the replay takes no commands"), []

    def on_stop(self, now_ns: int) -> list[Publication]:
        """It has no last words."""
        return []
