"""The runs of a recording: samples of one plant, in order of receipt, cut where a new run starts. Pure.

A new run starts where the publisher was restarted or its clock was set back, as the numbers and times of the samples
tell (`sequences`). The first signal that shows it starts the run, and each other signal joins it with its own next
sample that belongs there.
"""

from typing import Any, NamedTuple

from reactorwatch.contract.messages_pb2 import Sample
from recorder.columns.sequences import Place, SequenceCheck


class RunSpan(NamedTuple):
    """The times of the first and the last sample of a run."""

    first_ns: int
    last_ns: int


class _Run:
    """A run, and the signals that have samples in it."""

    def __init__(self, time_ns: int) -> None:
        self.first_ns, self.last_ns, self.period_ns = time_ns, time_ns, 0
        self.samples = 0

    def add(self, time_ns: int) -> None:
        self.samples += 1
        self.first_ns = min(self.first_ns, time_ns)
        if time_ns > self.last_ns:
            self.period_ns = time_ns - self.last_ns
            self.last_ns = time_ns

    def reaches(self, time_ns: int) -> bool:
        """Whether the run has come to a time, to a row."""
        return self.first_ns <= time_ns <= self.last_ns + self.period_ns


class RunSplitter:
    """Numbers the runs of one plant's samples.

    Attributes:
        checks: of the sequence numbers, by signal.
        current: number of the run that new samples are of, counted from 1; 0 before the first.
    """

    def __init__(self) -> None:
        self.checks: dict[str, SequenceCheck] = {}
        self.current = 0
        self._runs: list[_Run] = []
        self._last: dict[str, list[tuple[int, int]]] = {}  # by signal, run and time of its newest two samples

    @property
    def runs(self) -> list[RunSpan]:
        """The runs that have samples, in the order in which they started."""
        return [RunSpan(run.first_ns, run.last_ns) for run in self._runs if run.samples]

    @property
    def strays(self) -> int:
        """Samples that were out of place, and are of no run."""
        return sum(check.out_of_place for check in self.checks.values())

    def update(self, signal: str, sequence: int, time_ns: int) -> int:
        """The run that a sample is of, counted from 1; a run of strays alone has a number, too."""
        check = self.checks.get(signal)
        if check is None:
            check, number = self.checks.setdefault(signal, SequenceCheck()), max(self.current, 1)
            last = self._last.setdefault(signal, [])
        else:
            last = self._last[signal]
            number = last[-1][0]
        place = check.update(sequence, time_ns)
        if place is Place.AFTER_STRAY:
            number = self._drop_stray(last)
        elif place is Place.STARTS_RUN:
            number = self.current if number < self.current else len(self._runs) + 1
        elif number < self.current and not self._runs[number - 1].reaches(time_ns):
            number = self.current if self._runs[self.current - 1].reaches(time_ns) else number
        if number > len(self._runs):
            self._runs.append(_Run(time_ns))
        self.current = max(self.current, number)
        self._runs[number - 1].add(time_ns)
        last.append((number, time_ns))
        del last[:-2]
        return number

    def span(self, number: int) -> RunSpan:
        """The times of a run."""
        run = self._runs[number - 1]
        return RunSpan(run.first_ns, run.last_ns)

    def _drop_stray(self, last: list[tuple[int, int]]) -> int:
        """Take the newest sample of a signal out of its run; returns the run of the one before."""
        stray, time_ns = last.pop()
        run = self._runs[stray - 1]
        run.samples -= 1
        number = last[-1][0] if last else stray
        if not run.samples and self.current == stray:
            self.current = number
        if time_ns == run.last_ns and number == stray:
            newest = [check.newest_ns for name, check in self.checks.items() if self._last[name]]
            run.last_ns = max(time for time in newest if time != time_ns)
        return number


class ContinuousTime:
    """Times of one plant's messages that increase over all of its runs, for what has one axis of time or one pace.

    A run that starts before the one before it has ended is moved to follow it, one sampling period later.
    """

    def __init__(self) -> None:
        self._splitter = RunSplitter()
        self._shifts_ns: list[int] = []
        self._newest_ns: int | None = None
        self._period_ns = 0

    def of(self, key: str, message: Any) -> int:
        """The time of a message; messages are handed in in the order of receipt."""
        if isinstance(message, Sample):
            return self._of_sample(key, message.sequence, message.time_ns)
        time_ns: int = message.time_ns
        return time_ns + self.shift_ns(time_ns)

    def _of_sample(self, signal: str, sequence: int, time_ns: int) -> int:
        number, newest_ns = self._splitter.update(signal, sequence, time_ns), self._newest_ns
        starts = number > len(self._shifts_ns)
        if starts:
            shift_ns = self._shifts_ns[self._splitter.current - 2] if self._shifts_ns else 0
            if newest_ns is not None and time_ns + shift_ns <= newest_ns:
                shift_ns = newest_ns + self._period_ns - time_ns
            self._shifts_ns.append(shift_ns)
        moved_ns = time_ns + self._shifts_ns[number - 1]
        if newest_ns is None or moved_ns > newest_ns:
            if newest_ns is not None and not starts:
                self._period_ns = moved_ns - newest_ns
            self._newest_ns = moved_ns
        return moved_ns

    def shift_ns(self, time_ns: int) -> int:
        """What is added to the time of a message that speaks of samples that came before it."""
        number = self._splitter.current
        if not number:
            return 0
        if number > 1 and self._splitter.span(number).last_ns < time_ns <= self._splitter.span(number - 1).last_ns:
            return self._shifts_ns[number - 2]  # it is said of the run before
        return self._shifts_ns[number - 1]
