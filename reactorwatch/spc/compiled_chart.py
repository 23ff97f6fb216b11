"""Charts of one signal by a compiled kernel, alone or one an output of a plant.

A chart is a column of numbers, the charts of a plant's outputs are an array (number, output), and one kernel a kind of
chart serves both: its inner loop runs over the columns, each goes through the same operations, so the bits are the
same. (Branches of a column are written as selections, so that the compiler can turn the loop into vector instructions.)
"""

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from functools import cache
from struct import Struct
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import Entry, inline
from reactorwatch.spc.charts.base import Judgement, Shown, SignalChart, finite
from reactorwatch.stored_state import Memory

# The first rows of a chart's column: what comes in and what goes out. After them come its settings, where its memory
# starts, and its memory.
X, PRESENT, STATISTIC, CENTRE, LOWER, UPPER, OUT, SETTINGS = range(8)


@inline
def write_point(
    columns: Array, p: int, statistic: float, centre: float, lower: float, upper: float, out: float
) -> None:
    """Write the point of the chart of column `p`: the numbers of a `Judgement`, with `out` above 0 if it is out."""
    columns[STATISTIC, p] = statistic
    columns[CENTRE, p] = centre
    columns[LOWER, p] = lower
    columns[UPPER, p] = upper
    columns[OUT, p] = out


class SignalMemory(Memory):
    """Memory of a chart of one signal, or of one chart an output.

    Attributes:
        chart: name of the chart.
        numbers: its settings and what it remembers, shape (numbers of one chart, charts).
    """

    chart: str
    numbers: Array


class CompiledChart(SignalChart):
    """A chart of one signal by a compiled kernel. A kind of chart gives its numbers, its start and its kernel.

    Args:
        settings: the numbers of its constructor, as its kernel wants them.
        start: memory of the chart before the first value.
    """

    memory_type = SignalMemory
    numbers: ClassVar[int]  # how many settings and twice how many memories it has
    memories: ClassVar[int]

    def __init__(self, settings: Iterable[float], start: Sequence[float]) -> None:
        self._use(SignalMemory(self.name, np.array([*settings, *start, *start], dtype=np.float64).reshape(-1, 1)))

    def _use(self, memory: SignalMemory) -> None:
        """See `Chart`."""
        if memory.numbers.shape[1] != 1:
            raise ValueError(f"a chart's memory must be of one signal, got {memory.numbers.shape[1]}: use Bank")
        self.memory, self._columns = memory, columns_of(type(self), memory)

    @staticmethod
    @abstractmethod
    def kernel(columns: Array) -> None:
        """Judge X of every column that is PRESENT.

        Args:
            columns: shape (SETTINGS + numbers, charts).
        """

    @classmethod
    @abstractmethod
    def explain(cls, judgement: Judgement, signal: Shown) -> tuple[str, dict[str, float]]:
        """See `SignalChart`; from the judgement alone, as the memory is in a bank."""

    def update(self, x: float) -> Judgement:
        """See `Chart`."""
        columns = self._columns
        columns[X, 0] = finite(x)
        self.kernel(columns)
        statistic, centre, lower, upper, out = columns[STATISTIC:SETTINGS, 0].tolist()
        return Judgement(statistic, centre, lower, upper, out > 0.0)

    def restart(self) -> None:
        """Forget the values seen."""
        restart_columns(self._columns, self.memories, 0)

    def setting(self, row: int) -> float:
        """A number of the column."""
        return float(self._columns[row, 0])


class Bank:
    """Charts of one kind, one an output of a plant, updated in one call.

    Args:
        kind: kind of the charts.
        memory: memory of all charts, which they update.

    Raises:
        ValueError: the memory is of another chart, or damaged.
    """

    def __init__(self, kind: type[CompiledChart], memory: SignalMemory) -> None:
        self.kind, self.memory = kind, memory
        self._columns = columns = columns_of(kind, memory)
        charts, self._kernel = columns.shape[1], _entry(kind)
        self._numbers = columns.reshape(-1).data  # all of them, one row after the other
        self._come, self._out = Struct(f"{2 * charts}d").pack_into, Struct(f"{charts}d").unpack_from
        self._out_offset = OUT * charts * columns.itemsize

    @classmethod
    def of(cls, charts: Sequence[CompiledChart]) -> "Bank":
        """Charts that go on from those of one kind.

        Raises:
            ValueError: they are of several kinds.
        """
        if len(kinds := {type(chart) for chart in charts}) != 1:
            raise ValueError(f"charts must be one or more of one kind, got {sorted(kind.__name__ for kind in kinds)}")
        numbers = np.concatenate([chart.memory.numbers for chart in charts], axis=1)
        return cls(type(charts[0]), SignalMemory(charts[0].name, numbers))

    def judge(self, values: list[float], present: list[bool], *, always: bool) -> list[Judgement | None] | None:
        """Update the charts with a row.

        Args:
            values: one a chart, finite where present.
            present: False leaves a chart as it is.
            always: True to return the judgements of charts within their limits as well.

        Returns:
            Judgement of each chart, None where it has no value; None in place of all if no chart is out.
        """
        self._come(self._numbers, 0, *values, *present)  # X and PRESENT are the first rows
        self._kernel.call(self._columns)
        out = self._out(self._numbers, self._out_offset)
        if not (always or (any(out) and any(here and much > 0.0 for here, much in zip(present, out, strict=True)))):
            return None
        columns = self._columns[STATISTIC:SETTINGS].T.tolist()
        return [
            Judgement(statistic, centre, lower, upper, much > 0.0) if here else None
            for here, (statistic, centre, lower, upper, much) in zip(present, columns, strict=True)
        ]

    def restart(self, index: int) -> None:
        """Forget the values seen, of one chart."""
        restart_columns(self._columns, self.kind.memories, index)


@cache
def _entry(kind: type[CompiledChart]) -> Entry:
    return Entry(kind.kernel)


def restart_columns(columns: Array, memories: int, index: int | NDArray[np.bool_]) -> None:
    """Forget the values seen by the chart of a column, or by those that are True."""
    if memories:
        columns[-memories:, index] = columns[-2 * memories : -memories, index]


def columns_of(kind: type[CompiledChart], memory: SignalMemory) -> Array:
    """Columns of charts of a kind, whose numbers are the memory's from now on.

    Raises:
        ValueError: the memory is of another chart, or damaged.
    """
    numbers = memory.numbers
    if memory.chart != kind.name:
        raise ValueError(f"the memory must be of the chart {kind.name}, got {memory.chart}")
    if numbers.ndim != 2 or len(numbers) != kind.numbers or not numbers.size or not np.all(np.isfinite(numbers)):
        raise ValueError(f"charts {kind.name} must have {kind.numbers} finite numbers each, got {numbers.tolist()}")
    columns = np.zeros((SETTINGS + kind.numbers, numbers.shape[1]))
    columns[PRESENT], columns[SETTINGS:] = 1.0, numbers
    memory.numbers = columns[SETTINGS:]
    return columns
