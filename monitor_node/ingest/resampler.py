"""Rows of one period from a bus on which signals have times of their own, or are sent when they move. Pure.

Rows are at whole periods since 1970-01-01 UTC. They are made of sample times alone, so that a replay has the same rows,
as soon as a sample a period later has come: only then is the input known that acts until the next row. Methods are
those of records (`reactorwatch.records.resampling`): an input is the mean over the period that begins at its row, held
until it is sent again, an output the mean around its row; one with fewer values than rows has them in its own rows
only, unless a method is stated; if that needs the next value (`mean`, `interpolated`), its last one is held. Rows
without any value, as in a gap, are left out.
"""

from math import isnan

import numpy as np
from msgspec import field

from monitor_node.ingest.alignment import Row
from reactorwatch.records.file_format import INTERPOLATED, LAST, MEAN, SPARSE, ResampleRule
from reactorwatch.records.resampling import DIGITS, LONGEST_HOLD, SLOW, SignalPlan, values_in_rows
from reactorwatch.stored_state import Memory

REMEMBERED = 8
"""Values of a signal whose median spacing decides whether it is slower than the rows: more would follow a change later,
and of fewer one lost value would be a change."""


class Series(Memory):
    """Newest values of a signal, oldest first."""

    times_ns: list[int] = field(default_factory=list)
    values: list[float] = field(default_factory=list)


class ResamplerMemory(Memory):
    """Memory of a resampler.

    Attributes:
        series: newest values of each signal.
        next_row: number of the next row, counted in periods since 1970; None before the first sample of a run.
        newest_ns: time of the newest row that came.
        restarted: True if the next row is the first of a run.
    """

    series: list[Series] = field(default_factory=list)
    next_row: int | None = None
    newest_ns: int = 0
    restarted: bool = True


class Resampler:
    """Makes rows of one period.

    Args:
        rule: period and methods; the period must be stated.
        inputs: names of the inputs, which are the first values of a row.
        outputs: names of the outputs.
    """

    def __init__(self, rule: ResampleRule, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> None:
        assert rule.period_s is not None
        self._period_ns, self._inputs, self._signals = round(rule.period_s * 1e9), len(inputs), (*inputs, *outputs)
        self._stated = [rule.methods.get(name, rule.method) for name in self._signals]
        self.memory = ResamplerMemory()

    def update(self, row: Row) -> list[Row]:
        """Add a row of the bus; returns the rows that are ready, oldest first."""
        memory, time_ns, period_ns = self.memory, row.time_ns, self._period_ns
        ready = self.flush() if row.restarted or time_ns - memory.newest_ns > LONGEST_HOLD * period_ns else []
        if row.restarted:
            memory.series, memory.restarted = [], True
        if memory.next_row is None:
            memory.next_row = -(-time_ns // period_ns)
        memory.newest_ns = time_ns
        series = memory.series = memory.series or [Series() for _ in self._signals]
        for item, value in zip(series, row.values, strict=True):
            if value == value:
                item.times_ns.append(time_ns)
                item.values.append(value)
        return ready + self._rows_before(time_ns // period_ns)

    def flush(self) -> list[Row]:
        """Rows up to the last sample, as before a gap or at the end of a run; inputs are held beyond it."""
        memory = self.memory
        rows = self._rows_before(memory.newest_ns // self._period_ns + 1)
        memory.next_row = None
        return rows

    def _rows_before(self, end: int) -> list[Row]:
        """Rows from the next one up to that before a number, without those that have no value."""
        memory, rows = self.memory, list[Row]()
        if memory.next_row is None:
            return rows
        for number in range(memory.next_row, end):
            time_ns = number * self._period_ns
            values = tuple(self._value(index, time_ns) for index in range(len(self._signals)))
            if not all(map(isnan, values)):
                rows.append(Row(time_ns, values, memory.restarted))
                memory.restarted = False
        memory.next_row = max(memory.next_row, end)
        return rows

    def _value(self, index: int, time_ns: int) -> float:
        """Value of a signal in the row of a time."""
        series, period_ns, is_input = self.memory.series[index], self._period_ns, index < self._inputs
        times, values = series.times_ns, series.values
        while len(times) > REMEMBERED and times[1] < time_ns - 2 * period_ns:
            del times[0], values[0]
        periods = np.round((np.array(times) - time_ns) / period_ns, DIGITS)
        spacing = float(np.median(np.diff(periods))) if len(times) > 1 else 1.0
        is_slow = len(times) < 2 or spacing > SLOW
        method = self._stated[index] or (SPARSE if is_slow and not is_input else MEAN)
        if is_slow and (method == INTERPOLATED or (method == MEAN and not is_input)):
            method = LAST  # the next value has not come, and is not known to come
        longest = np.inf if is_input or method == LAST else LONGEST_HOLD * max(1.0, spacing)
        plan = SignalPlan(method, is_input, is_slow, spacing, longest)
        return float(values_in_rows(periods, np.array(values), np.zeros(1, dtype=np.int64), plan)[0])
