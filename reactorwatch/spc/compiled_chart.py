"""Charts of one signal by a compiled kernel, alone or as a bank.

The charts of one signal also come as a `Bank`, one chart a plant for thousands of plants. A chart is a column of
numbers, a bank is an array (number, plant), and one kernel a kind of chart serves both: its inner loop runs over the
plants, every plant goes through the same operations, so the bits are the same. (Per-plant branches are written
as selections, so that the compiler can turn the loop into vector instructions.)
"""

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from functools import cache
from struct import Struct
from typing import Any, ClassVar, Generic, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.codegen.numba_kernel import Entry, inline
from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import LARGEST_VALUE, Array, Judgement, Shown, SignalChart, finite
from reactorwatch.stored_state import Memory

# The first rows of a chart's column: what comes in and what goes out. After them come its settings, where its memory
# starts, and its memory.
X, PRESENT, STATISTIC, CENTRE, LOWER, UPPER, OUT, SETTINGS = range(8)


@inline
def write_point(
    columns: Array, p: int, statistic: float, centre: float, lower: float, upper: float, out: float
) -> None:
    """Write the point of the chart of plant `p`: the numbers of a `Judgement`, with `out` above 0 if it is out."""
    columns[STATISTIC, p] = statistic
    columns[CENTRE, p] = centre
    columns[LOWER, p] = lower
    columns[UPPER, p] = upper
    columns[OUT, p] = out


class Judgements(NamedTuple):
    """The fields of `Judgement` for many plants, each of shape (plants,); NaN and False for an absent plant."""

    statistic: Array
    centre: Array
    lower_limit: Array
    upper_limit: Array
    out: NDArray[np.bool_]


class SignalMemory(Memory):
    """Memory of a chart of one signal, or of a bank of them.

    Attributes:
        chart: name of the chart.
        numbers: its settings and what it remembers, shape (numbers of one chart, plants).
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
            raise ValueError(f"a chart's memory must be of one plant, got {memory.numbers.shape[1]}: use Bank")
        self.memory, self._columns = memory, columns_of(type(self), memory)

    @staticmethod
    @abstractmethod
    def kernel(columns: Array) -> None:
        """Judge X of every plant that is PRESENT.

        Args:
            columns: shape (SETTINGS + numbers, plants).
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
        _restart(self._columns, self.memories, slice(None))

    def setting(self, row: int) -> float:
        """A number of the column."""
        return float(self._columns[row, 0])


Kind = TypeVar("Kind", bound=CompiledChart)


class Bank(Generic[Kind]):
    """Charts of one kind, one a plant, updated in one call. A plant's numbers are the single chart's, bit for bit.

    Args:
        charts: at least one; each with settings and memory of its own.

    Attributes:
        kind: kind of the charts.
        memory: memory of all charts.

    Raises:
        InputError: there is none, or they are of several kinds.
    """

    def __init__(self, charts: Sequence[Kind]) -> None:
        kinds = {type(chart) for chart in charts}
        if len(kinds) != 1:
            raise InputError(f"charts must be one or more of one kind, got {sorted(kind.__name__ for kind in kinds)}")
        (self.kind,) = kinds
        columns = np.concatenate([chart.memory.numbers for chart in charts], axis=1)
        self._use(self.kind, SignalMemory(self.kind.name, columns))

    @classmethod
    def resume(cls, kind: type[Kind], memory: SignalMemory) -> Self:
        """Charts of a kind that go on from a memory, which they update.

        Raises:
            ValueError: the memory is of another chart, or damaged.
        """
        bank = cls.__new__(cls)
        bank._use(kind, memory)
        return bank

    def _use(self, kind: type[Kind], memory: SignalMemory) -> None:
        self.kind, self.memory = kind, memory
        self._columns = columns = columns_of(kind, memory)
        plants, self._kernel = columns.shape[1], _entry(kind)
        self._numbers = self._columns.reshape(-1).data  # all of them, one row after the other
        self._come, self._out = Struct(f"{2 * plants}d").pack_into, Struct(f"{plants}d").unpack_from
        self._out_offset = OUT * plants * self._columns.itemsize

    @property
    def numbers(self) -> Array:
        """Settings and memory of the charts, shape (numbers of one chart, plants): a view, contiguous."""
        return self._columns[SETTINGS:]

    def update(self, values: ArrayLike, present: NDArray[np.bool_] | None = None) -> Judgements:
        """Update the charts with the next value of every plant.

        Args:
            values: shape (plants,).
            present: shape (plants,); False leaves a plant's chart as it is and its value unread. All, if not given.

        Raises:
            ValueError: a present value that is not finite, or a wrong shape; nothing is changed then, in no plant.
        """
        columns = self._columns
        x = np.asarray(values, dtype=np.float64)
        if x.shape != (columns.shape[1],):
            raise ValueError(f"values must have shape ({columns.shape[1]},), got {x.shape}")
        if present is None:
            present = np.ones(x.shape, dtype=np.bool_)
        if present.shape != x.shape or present.dtype != np.bool_:
            raise ValueError(f"present must be {x.size} booleans, got {present.shape} of {present.dtype}")
        refused = present & ~(np.abs(x) < LARGEST_VALUE)
        if refused.any():
            plant = int(np.argmax(refused))
            raise ValueError(f"plant {plant}: a chart takes finite values below {LARGEST_VALUE:g}, got {x[plant]}")
        columns[X] = np.where(present, x, 0.0)
        columns[PRESENT] = present
        self.kind.kernel(columns)
        points = columns[STATISTIC:OUT].copy()
        points[:, ~present] = np.nan
        return Judgements(points[0], points[1], points[2], points[3], present & (columns[OUT] > 0.0))

    def judge(self, values: list[float], present: list[bool], *, always: bool) -> list[Judgement | None] | None:
        """Update the few charts of one plant, as at every row.

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

    def restart(self, plants: NDArray[np.bool_] | int | None = None) -> None:
        """Forget the values seen: of all plants, of those that are True, or of one by its index."""
        _restart(self._columns, self.kind.memories, slice(None) if plants is None else plants)

    def chart(self, plant: int) -> Kind:
        """A copy of one plant's chart, in the single form.

        Raises:
            IndexError: there is no such plant.
        """
        if not 0 <= plant < self._columns.shape[1]:
            raise IndexError(f"plant must be in 0..{self._columns.shape[1] - 1}, got {plant}")
        return self.kind.resume(SignalMemory(self.kind.name, self._columns[SETTINGS:, plant : plant + 1].copy()))


@cache
def _entry(kind: type[CompiledChart]) -> Entry:
    return Entry(kind.kernel)


def _restart(columns: Array, memories: int, plants: Any) -> None:
    if memories:
        columns[-memories:, plants] = columns[-2 * memories : -memories, plants]


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
