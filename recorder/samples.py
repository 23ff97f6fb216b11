"""Samples of one plant, in order of receipt: counted by sequence number, split into runs, collected in columns. Pure.

A new run starts where the publisher was restarted or its clock was set back, according to sequence numbers and times.
The first signal that shows it starts the run. Each other signal joins with its first sample that belongs to the new
run.
"""

import math
from array import array
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple

from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, decode
from reactorwatch.contract.messages_pb2 import QUALITY_BAD, QUALITY_UNSPECIFIED, Sample
from reactorwatch.records.record import LARGEST_VALUE
from reactorwatch.runtime.gap_tracker import GapTracker
from recorder import RecordedMessage


def content_of(message: RecordedMessage | Encoded) -> Message | None:
    """Decoded content of a message; None if its payload is not what its encoding names."""
    try:
        return decode(message.payload, message.encoding)
    except DecodeError:
        return None  # the recorder counted it as refused


def decode_messages(recording: Iterable[RecordedMessage]) -> Iterator[tuple[keys.Topic, Message]]:
    """Topic and content of each message of this software; others are skipped, and undecodable ones."""
    topics: dict[str, keys.Topic | None] = {}
    for entry in recording:
        key = entry.key
        if key not in topics:
            topics[key] = keys.parse(key)
        topic = topics[key]
        if topic is not None and (content := content_of(entry)) is not None:
            yield topic, content


def measured_value(sample: Sample) -> float | None:
    """Measured value of a sample.

    Returns:
        The value; NaN, which counts as not measured, if it is of bad quality, not finite or impossibly large; None if
        the message is no sample, because it lacks the quality that every publisher of this software sets.
    """
    quality = sample.quality
    if quality == QUALITY_UNSPECIFIED:
        return None
    value: float = sample.value
    return value if quality != QUALITY_BAD and abs(value) < LARGEST_VALUE else math.nan


class RunTransition(Enum):
    """Relation of a sample to the run before it."""

    SAME_RUN = "continues the run"
    NEW_RUN = "first of a new run"
    AFTER_STRAY = "continues the run before the last sample, which was a stray"


SAME_RUN = RunTransition.SAME_RUN  # looking it up in the class takes a third of the usual update


class _Checkpoint(NamedTuple):
    """State of a counter before its newest sample, restored if that was a stray; `gaps` is a number of gaps."""

    expected: int
    newest_ns: int
    lost: int
    gaps: int
    lowest: int
    all_gaps: list[tuple[int, int]]
    points: list[tuple[int, int]]


@dataclass(slots=True)
class SequenceCounter(GapTracker):
    """Lost, duplicated and reordered samples of one signal, and new runs of its publisher.

    A publisher counts its samples from 0, and within a run the sample times increase with the sequence numbers. A
    skipped number is lost until its sample arrives late: then it is out of order. A repeated number and time are a
    duplicate. A sample whose number and time contradict earlier ones starts a new run: the publisher was restarted and
    counts from 0 again, or its clock was set back and it continues to count. If the sample after it continues the
    earlier run instead, the contradicting sample was a stray with a damaged stamp. Numbers before the first received
    sample are not lost.

    Attributes:
        lost: samples that were never received.
        duplicated: samples that were received again.
        out_of_order: samples that were received after a later one.
        out_of_place: strays: samples whose number and time fit neither those before nor those after.
        lowest: lowest possible number of the run.
        points: increasing (number, time) of samples of the run.
    """

    max_gaps = 256  # stored gaps; a late sample of an older gap is counted as a duplicate

    lost: int = 0
    duplicated: int = 0
    out_of_order: int = 0
    out_of_place: int = 0
    lowest: int = 0
    points: list[tuple[int, int]] = field(default_factory=list)
    _checkpoint: _Checkpoint | None = None

    def update(self, sequence: int, time_ns: int) -> RunTransition:
        """Count one sample."""
        points, expected = self.points, self.expected
        count = len(points)
        if sequence == expected and time_ns > self.newest_ns and count > 1:  # as nearly always, so written out
            self.expected, self.newest_ns, self._checkpoint = sequence + 1, time_ns, None
            points.append((sequence, time_ns))
            if count >= self.max_gaps:
                self._thin_out()
            return SAME_RUN
        if expected is None:
            self.advance(sequence, time_ns)
            return SAME_RUN
        if self._checkpoint is None and count > 1:
            number, then_ns = points[-2]
            self._checkpoint = self._checkpoint_at(number + 1, then_ns)
        if not self._continues(sequence, time_ns, expected) and self._follows_checkpoint(sequence, time_ns):
            self._roll_back(expected - 1)
            self.update(sequence, time_ns)
            return RunTransition.AFTER_STRAY
        return self._classify(sequence, time_ns, expected)

    def advance(self, number: int, time_ns: int = 0) -> int:
        """Add the newest sample; returns how many were skipped."""
        self.points.append((number, time_ns))
        if len(self.points) > self.max_gaps:
            self._thin_out()
        return GapTracker.advance(self, number, time_ns)

    def _thin_out(self) -> None:
        """Drop every second point of the older half, so that their number is bounded."""
        del self.points[1 : self.max_gaps // 2 : 2]

    def _checkpoint_at(self, expected: int, newest_ns: int) -> _Checkpoint:
        return _Checkpoint(expected, newest_ns, self.lost, len(self.gaps), self.lowest, self.gaps, self.points)

    def _continues(self, sequence: int, time_ns: int, expected: int) -> bool:
        """True if a sample fits the run, unless the run consists of a single sample after another run."""
        if self._checkpoint is not None and self._checkpoint.points is not self.points:
            return False
        return time_ns > self.newest_ns if sequence >= expected else self._is_consistent(sequence, time_ns)

    def _is_consistent(self, sequence: int, time_ns: int) -> bool:
        """True if an older number can have this time in this run."""
        if sequence < self.lowest:
            return False
        after = bisect_left(self.points, (sequence, time_ns))
        if after < len(self.points) and self.points[after][0] == sequence:
            return self.points[after][1] == time_ns
        if after > 0 and not (self.points[after - 1][0] < sequence and self.points[after - 1][1] < time_ns):
            return False
        return after == len(self.points) or time_ns < self.points[after][1]

    def _classify(self, sequence: int, time_ns: int, expected: int) -> RunTransition:
        before, transition = self._checkpoint_at(expected, self.newest_ns), RunTransition.SAME_RUN
        if sequence == 0 and expected == 1 and time_ns > self.newest_ns:  # the publisher does not count its samples
            self.points.clear()
        elif sequence < expected and self._is_consistent(sequence, time_ns):
            filled = self.fill(sequence)
            self.out_of_order += filled
            self.lost -= filled
            self.duplicated += not filled
            return transition
        elif sequence < expected or time_ns <= self.newest_ns:
            self.expected = self.lowest = expected if sequence >= expected else 0
            self.gaps, self.points = [], []
            transition = RunTransition.NEW_RUN
        self._checkpoint = before
        self.lost += self.advance(sequence, time_ns)
        return transition

    def _follows_checkpoint(self, sequence: int, time_ns: int) -> bool:
        """True if a sample continues the run as if the newest sample had not been received.

        Its spacing is then 0.75 to 4 times the usual one: less would be the stray's own run, more a run after a stop.
        """
        before = self._checkpoint
        if before is None or sequence < before.expected or time_ns <= before.newest_ns:
            return False
        points = before.points[:-1] if before.points is self.points else before.points
        if len(points) < 2:
            return False
        (number, then_ns), (last, last_ns) = points[-2:]
        usual_ns = (last_ns - then_ns) / (last - number)
        spacing_ns = (time_ns - before.newest_ns) / (sequence - before.expected + 1)
        return 0.75 * usual_ns <= spacing_ns <= 4.0 * usual_ns

    def _roll_back(self, stray: int) -> None:
        """Restore the state before the newest sample, a stray; one with the expected number is not lost."""
        before = self._checkpoint
        assert before is not None, "it follows the checkpoint"
        if before.points is self.points:
            self.points.pop()
        self.points, self.gaps, self.lowest = before.points, before.all_gaps[: before.gaps], before.lowest
        self.expected, self.newest_ns = before.expected + (stray == before.expected), before.newest_ns
        self.lost, self._checkpoint = before.lost, None
        self.out_of_place += 1


@dataclass
class Run:
    """Run of a plant, between two starts of its publisher or settings of its clock.

    Attributes:
        first_ns: time of the first sample.
        last_ns: time of the last sample.
        period_ns: latest sampling period.
        samples: number of samples, strays excluded.
        shift_ns: shift of its times in `RunSplitter.continuous_ns`.
    """

    first_ns: int
    last_ns: int
    period_ns: int = 0
    samples: int = 0
    shift_ns: int = 0

    def add(self, time_ns: int) -> None:
        """Add a sample."""
        self.samples += 1
        if time_ns > self.last_ns:
            self.period_ns = time_ns - self.last_ns
            self.last_ns = time_ns
        elif time_ns < self.first_ns:
            self.first_ns = time_ns

    def covers(self, time_ns: int) -> bool:
        """True if a time is within the run or one sampling period after it."""
        return self.first_ns <= time_ns <= self.last_ns + self.period_ns


class RunSplitter:
    """Assigns the samples of one plant to runs.

    Attributes:
        counters: sequence counters by signal.
        current: index of the current run, from 1; 0 before the first sample.
        strays: number of stray samples, which belong to no run.
    """

    def __init__(self) -> None:
        self.counters: dict[str, SequenceCounter] = {}
        self.current = self.strays = 0
        self._runs: list[Run] = []
        self._last: dict[str, list[tuple[int, int]]] = {}  # run and time of the newest two samples, by signal
        self._newest_ns, self._period_ns = -(2**63), 0  # newest continuous time, and from the one before to it

    @property
    def runs(self) -> list[Run]:
        """Runs with samples, in the order of their starts."""
        return [run for run in self._runs if run.samples]

    def update(self, signal: str, sequence: int, time_ns: int) -> int:
        """Index of the run of a sample, from 1; a run of strays alone has an index too."""
        counter = self.counters.get(signal)
        if counter is None:
            counter, number = self.counters.setdefault(signal, SequenceCounter()), max(self.current, 1)
            last = self._last.setdefault(signal, [])
        else:
            last = self._last[signal]
            number = last[-1][0]
        transition = counter.update(sequence, time_ns)
        if transition is RunTransition.SAME_RUN and number == self.current:  # as nearly always
            pass
        elif transition is RunTransition.AFTER_STRAY:
            number = self._drop_stray(last)
            self.strays += 1
        elif transition is RunTransition.NEW_RUN:
            number = self.current if number < self.current else len(self._runs) + 1
        elif number < self.current and not self._runs[number - 1].covers(time_ns):
            number = self.current if self._runs[self.current - 1].covers(time_ns) else number
        if number > len(self._runs):
            self._runs.append(Run(time_ns, time_ns))
        self.current = max(self.current, number)
        self._runs[number - 1].add(time_ns)
        last.append((number, time_ns))
        if len(last) > 2:
            del last[0]
        return number

    def continuous_ns(self, signal: str, message: Any) -> int:
        """Time of the next message on one axis over all runs.

        A run that starts before the end of the run before is shifted to start one sampling period after it. Samples
        are assigned to runs by `update`; other messages are about an earlier sample.
        """
        time_ns: int = message.time_ns
        if not isinstance(message, Sample):
            return time_ns + self._shift_ns(time_ns)
        runs = len(self._runs)
        run = self._runs[self.update(signal, message.sequence, time_ns) - 1]
        starts = len(self._runs) > runs
        if starts and runs:
            run.shift_ns = self._runs[-2].shift_ns
            if time_ns + run.shift_ns <= self._newest_ns:
                run.shift_ns = self._newest_ns + self._period_ns - time_ns
        shifted_ns = time_ns + run.shift_ns
        if shifted_ns > self._newest_ns:
            if not starts:
                self._period_ns = shifted_ns - self._newest_ns
            self._newest_ns = shifted_ns
        return shifted_ns

    def _shift_ns(self, time_ns: int) -> int:
        """Shift of a message about an earlier sample."""
        if not self.current:
            return 0
        run = self._runs[self.current - 1]
        if self.current > 1 and run.last_ns < time_ns <= self._runs[self.current - 2].last_ns:
            run = self._runs[self.current - 2]  # it concerns the run before
        return run.shift_ns

    def _drop_stray(self, last: list[tuple[int, int]]) -> int:
        """Remove the newest sample of a signal from its run; returns the run of the sample before."""
        stray, time_ns = last.pop()
        run = self._runs[stray - 1]
        run.samples -= 1
        number = last[-1][0] if last else stray
        if not run.samples and self.current == stray:
            self.current = number
        if time_ns == run.last_ns and number == stray:
            newest = (counter.newest_ns for name, counter in self.counters.items() if self._last[name])
            run.last_ns = max(newest, default=run.first_ns)
        return number


class SampleSeries:
    """Collects the samples of one plant, in the order of receipt.

    Attributes:
        runs: times and values by signal, for each run; strays are left out.
        units: first unit of each signal that has one.
        splitter: the splitter into runs.
    """

    def __init__(self) -> None:
        self.runs: list[defaultdict[str, tuple[array[int], array[float]]]] = []
        self.units: dict[str, str] = {}
        self.splitter = RunSplitter()
        self._newest: dict[str, tuple[array[int], array[float]]] = {}  # columns of the newest sample, by signal

    def add(self, signal: str, sample: Sample) -> None:
        """Add a sample."""
        value = measured_value(sample)
        if value is None:
            return
        strays = self.splitter.strays
        number = self.splitter.update(signal, sample.sequence, sample.time_ns)
        if self.splitter.strays > strays:
            for column in self._newest[signal]:
                column.pop()
        if sample.unit:
            self.units.setdefault(signal, sample.unit)
        if number > len(self.runs):
            self.runs.append(defaultdict(lambda: (array("q"), array("d"))))
        times, values = self._newest[signal] = self.runs[number - 1][signal]
        times.append(sample.time_ns)
        values.append(value)
