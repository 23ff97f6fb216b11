"""Free run of a filter: what the equations predict without the rows since before an alarm.

While an alarm is active the filter may follow a fault, as a state that wanders takes it over. The free run follows
nothing: it starts at a copy of the filter's state that is `COPY_ROWS` to twice as many rows old, and takes the inputs
as they come. An alarm soon after another one goes on with its run, since the filter's state may be that of the fault.
The run's covariance grows to what the plant does by itself, so a row is away where its outputs together are farther
from the prediction than in all but `AWAY` of sound rows, by the chi-square distribution. Where the covariance is so
large that nothing is, or the run diverges, alarms end with their charts.

Where half of `RETURN_ROWS` rows were away and later none is, a fault is over. What the filter has taken over of it
would be a fault to the charts now, for as long as the fault has lasted; so the filter goes on from the free run.
"""

from array import array
from functools import partial
from math import isfinite, nan

import msgspec
from scipy.special import chdtri

from monitor_node.learn.references import COPY_ROWS
from reactorwatch.kalman.ekf import Filter, FilterState
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process.model import ProcessModel
from reactorwatch.stored_state import Memory

AWAY = 0.01
"""Share of sound rows that count as away, as for levels (`spc.charts.level.AWAY`)."""

RETURN_ROWS = 20
"""Rows by which a fault is over: as many as end an alarm by default. By chance half of them are away once in 1e14 rows,
and once in 1e5 where the model is so far off that a tenth of all rows is."""


class FreeRunMemory(Memory):
    """Memory of a free run.

    Attributes:
        is_open: False while an alarm is active, and rows are not added.
        copies: older and newer copy of the filter's state; fewer at first.
        rows: the rows after the older one: time in minutes and inputs, one row after the other.
        state: state of the run; None: there is none.
        recent: last `RETURN_ROWS` rows, the newest in the lowest bit (1: away).
        has_left: True if half of such rows were away, and some of all later ones.
    """

    is_open: bool = True
    copies: list[FilterState] = msgspec.field(default_factory=list)
    rows: array = msgspec.field(default_factory=partial(array, "d"))  # type: ignore[type-arg] # none before Python 3.12
    state: FilterState | None = None
    recent: int = 0
    has_left: bool = False


class FreeRun:
    """Free run of a filter of a model.

    Attributes:
        memory: memory of the run, which it updates.
        is_away: True if the newest row is away.
    """

    def __init__(self, model: ProcessModel, noise: NoiseLevels, memory: FreeRunMemory) -> None:
        self._filter, self.memory, self.is_away = Filter(model, noise), memory, False
        self._columns, self._nothing = 1 + len(model.inputs), [nan] * len(model.outputs)

    def add(self, followed: Filter, time_min: float, inputs: tuple[float, ...]) -> None:
        """Add a row that the filter has followed, if no alarm is active."""
        memory, most = self.memory, COPY_ROWS * self._columns
        if not memory.is_open:
            return
        if memory.copies:
            memory.rows.extend((time_min, *inputs))
            if len(memory.rows) % most:
                return
        memory.copies = [*memory.copies[-1:], followed.state]
        del memory.rows[:-most]

    def start(self) -> None:
        """Run up to the newest row, if the alarm is new."""
        memory, columns = self.memory, self._columns
        if memory.is_open and memory.copies:
            self._filter.state, rows = memory.copies[0], memory.rows.tolist()
            for first in range(0, len(rows), columns):
                self._filter.update(rows[first], rows[first + 1 : first + columns], self._nothing)
            memory.state = self._filter.state
        memory.is_open = False

    def stop(self) -> None:
        """End the run, if there is one; the next one goes on from it."""
        memory, state = self.memory, self.memory.state
        if not memory.is_open:
            self.forget()
            memory.copies, memory.is_open = [] if state is None or state.time_min is None else [state], True

    def forget(self) -> None:
        """Forget the rows, as after a gap; there is no run until the next alarm."""
        memory = self.memory
        memory.copies, memory.state, memory.recent, memory.has_left = [], None, 0, False
        del memory.rows[:]

    def update(self, time_min: float, inputs: tuple[float, ...], measured: list[float]) -> FilterState | None:
        """Judge a row; returns the state from which the filter goes on if a fault is over."""
        memory, run = self.memory, self._filter
        assert memory.state is not None
        run.state = memory.state
        normalized = [z for z in run.update(time_min, inputs, measured, gate=-1.0).normalized if isfinite(z)]
        memory.state = run.state
        if not normalized:  # it has started again, from rows of the fault
            memory.has_left = False
            return None
        self.is_away = sum(z * z for z in normalized) > float(chdtri(len(normalized), AWAY))
        memory.recent = ((memory.recent << 1) | self.is_away) & ((1 << RETURN_ROWS) - 1)
        has_returned = memory.has_left and not memory.recent
        memory.has_left = not has_returned and (memory.has_left or 2 * memory.recent.bit_count() >= RETURN_ROWS)
        return memory.state if has_returned else None
