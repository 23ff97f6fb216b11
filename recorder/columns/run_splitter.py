"""Split the samples of one plant, in order of receipt, into runs. Pure.

A new run starts where the publisher was restarted or its clock was set back, according to sequence numbers and times
(`sequence_counter`). The first signal that shows it starts the run. Each other signal joins with its first sample that
belongs to the new run.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.contract.messages_pb2 import Sample
from recorder.columns.sequence_counter import RunTransition, SequenceCounter


class RunSpan(NamedTuple):
    """Times of the first and the last sample of a run."""

    first_ns: int
    last_ns: int


class _Run:
    """Time span, sampling period and number of samples of a run."""

    def __init__(self, time_ns: int) -> None:
        self.first_ns, self.last_ns, self.period_ns = time_ns, time_ns, 0
        self.samples = 0

    def add(self, time_ns: int) -> None:
        self.samples += 1
        if time_ns > self.last_ns:
            self.period_ns = time_ns - self.last_ns
            self.last_ns = time_ns
        elif time_ns < self.first_ns:
            self.first_ns = time_ns

    def add_all(self, times_ns: NDArray[np.int64]) -> None:
        """Call `add` for each time, at once; at least one."""
        self.samples += times_ns.size
        self.first_ns = min(self.first_ns, int(times_ns.min()))
        newest_ns = np.maximum.accumulate(np.concatenate(([self.last_ns], times_ns)))
        periods_ns = np.diff(newest_ns)
        if periods_ns.any():
            self.period_ns = int(periods_ns[periods_ns > 0][-1])
            self.last_ns = int(newest_ns[-1])

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
        self._runs: list[_Run] = []
        self._last: dict[str, list[tuple[int, int]]] = {}  # run and time of the newest two samples, by signal

    @property
    def runs(self) -> list[RunSpan]:
        """Runs with samples, in the order of their starts."""
        return [RunSpan(run.first_ns, run.last_ns) for run in self._runs if run.samples]

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
            self._runs.append(_Run(time_ns))
        self.current = max(self.current, number)
        self._runs[number - 1].add(time_ns)
        last.append((number, time_ns))
        if len(last) > 2:
            del last[0]
        return number

    def continue_run(
        self, stamps: Mapping[str, tuple[NDArray[np.int64], NDArray[np.int64]]], times_ns: NDArray[np.int64]
    ) -> bool:
        """Process samples that all continue the current run, as `update` would; False: some do not, nothing changes.

        Args:
            stamps: sequence numbers and times of the samples of each signal; at least one of each.
            times_ns: times of all samples, in the order of receipt.
        """
        for signal, (numbers, own_times) in stamps.items():
            counter = self.counters.get(signal)
            if counter is None or self._last[signal][-1][0] != self.current:
                return False
            if not counter.continues(numbers, own_times):
                return False
        for signal, (numbers, own_times) in stamps.items():
            self.counters[signal].update_all(numbers, own_times)
            last = self._last[signal]
            last += ((self.current, time_ns) for time_ns in own_times[-2:].tolist())
            del last[:-2]
        self._runs[self.current - 1].add_all(times_ns)
        return True

    def span(self, number: int) -> RunSpan:
        """Time span of a run."""
        run = self._runs[number - 1]
        return RunSpan(run.first_ns, run.last_ns)

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


class ContinuousTime:
    """Times of one plant's messages that increase over all runs, for one time axis.

    A run that starts before the end of the run before is shifted to start one sampling period after it.
    """

    def __init__(self) -> None:
        self._splitter = RunSplitter()
        self._shifts_ns: list[int] = []
        self._newest_ns: int | None = None
        self._period_ns = 0

    def continuous_ns(self, key: str, message: Any) -> int:
        """Continuous time of a message; messages must be passed in the order of receipt."""
        if isinstance(message, Sample):
            return self._sample_ns(key, message.sequence, message.time_ns)
        time_ns: int = message.time_ns
        return time_ns + self.shift_ns(time_ns)

    def _sample_ns(self, signal: str, sequence: int, time_ns: int) -> int:
        number, newest_ns = self._splitter.update(signal, sequence, time_ns), self._newest_ns
        starts = number > len(self._shifts_ns)
        if starts:
            shift_ns = self._shifts_ns[self._splitter.current - 2] if self._shifts_ns else 0
            if newest_ns is not None and time_ns + shift_ns <= newest_ns:
                shift_ns = newest_ns + self._period_ns - time_ns
            self._shifts_ns.append(shift_ns)
        shifted_ns = time_ns + self._shifts_ns[number - 1]
        if newest_ns is None or shifted_ns > newest_ns:
            if newest_ns is not None and not starts:
                self._period_ns = shifted_ns - newest_ns
            self._newest_ns = shifted_ns
        return shifted_ns

    def shift_ns(self, time_ns: int) -> int:
        """Shift of a message about an earlier sample."""
        number = self._splitter.current
        if not number:
            return 0
        if number > 1 and self._splitter.span(number).last_ns < time_ns <= self._splitter.span(number - 1).last_ns:
            return self._shifts_ns[number - 2]  # it concerns the run before
        return self._shifts_ns[number - 1]
