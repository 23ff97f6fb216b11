"""Runs of filters over records, stretch by stretch: each by itself, or several of one model at once.

Most rows of a record are two steps behind the one before; a stretch of them is taken by machine code without a stop.
Several filters of the same model may go through their stretches together, in lanes (see `compiled_function`), each with
its own record and its own noise: four of them take little longer than one, and each says what it would say alone, to
the last bit.
"""

from collections.abc import Generator, Sequence
from typing import NamedTuple, TypeAlias

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import LANES, RowCode
from reactorwatch.kalman.innovations import Innovations

LEAST_ROWS = 1000
"""Of a stretch: for fewer the lanes are not worth what it takes to make their code."""


class Stretch(NamedTuple):
    """Rows that are taken at once.

    Attributes:
        code: that takes them.
        memory: of the filter before the first row.
        new: of the rows, shape (rows, ...); see `ekf_step`, as for all of them.
        constants: likewise.
        after: what the filter remembers after each row, to be filled.
        told: what it says of each row, to be filled.
    """

    code: RowCode
    memory: Array
    new: Array
    constants: Array
    after: Array
    told: Array

    def taken(self) -> int:
        """Take the rows; returns how many went well."""
        return self.code.fill(len(self.new), *self.arrays)

    @property
    def arrays(self) -> tuple[list[Array], list[Array]]:
        """Arguments and results of the code."""
        return [self.memory, self.new, self.constants], [self.after, self.told]


Stretches: TypeAlias = Generator[Stretch, int, Innovations]
"""A run of a filter, which is told of each stretch how many of its rows went well."""


def alone(run: Stretches) -> Innovations:
    """What a run of one filter says."""
    done: int | None = None
    while True:
        try:
            stretch = next(run) if done is None else run.send(done)
        except StopIteration as end:
            return _said(end)
        done = stretch.taken()


def together(runs: Sequence[Stretches]) -> list[Innovations]:
    """What runs of some filters of the same model say. No filter is in two of them."""
    found: dict[int, Innovations] = {}
    waiting: dict[int, Stretch] = {}
    for number in range(len(runs)):
        _go_on(runs, number, None, waiting, found)
    while waiting:
        first = next(iter(waiting.values()))
        alike = [number for number, item in waiting.items() if len(item.new) == len(first.new)][:LANES]
        stretches = [waiting.pop(number) for number in alike]
        for number, rows in zip(alike, _taken(stretches), strict=True):
            _go_on(runs, number, rows, waiting, found)
    return [found[number] for number in range(len(runs))]


def _taken(stretches: Sequence[Stretch]) -> list[int]:
    """How many rows of each of some stretches of the same length went well."""
    rows = len(stretches[0].new)
    if len(stretches) == 1 or rows < LEAST_ROWS:
        return [item.taken() for item in stretches]
    arguments, results = zip(*(item.arrays for item in stretches), strict=True)
    if stretches[0].code.fill_together(rows, arguments, results) == rows:
        return [rows] * len(stretches)
    return [item.taken() for item in stretches]  # where one stops the others go on


def _go_on(
    runs: Sequence[Stretches],
    number: int,
    done: int | None,
    waiting: dict[int, Stretch],
    found: dict[int, Innovations],
) -> None:
    """Up to the next stretch of a run, or to its end."""
    try:
        waiting[number] = next(runs[number]) if done is None else runs[number].send(done)
    except StopIteration as end:
        found[number] = _said(end)


def _said(end: StopIteration) -> Innovations:
    said = end.value
    assert isinstance(said, Innovations)
    return said
