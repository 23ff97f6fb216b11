"""Run filters over records in batches of rows: one filter, or several of one model in lanes.

Most rows follow the one before within two integration steps; machine code takes a batch of them in one call. Batches of
several filters of one model run in lanes (see `compiled_function`), each with its own record and noise: four take
little longer than one, and each gives the result that it gives by itself, to the last bit.
"""

from collections.abc import Generator, Sequence
from typing import NamedTuple, TypeAlias

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import LANES, CompiledFunction
from reactorwatch.kalman.innovations import FilterResult

LEAST_ROWS = 1000
"""Smallest number of rows of a batch for which compiling the lanes pays."""


class RowBatch(NamedTuple):
    """Rows that are filtered in one call; see `ekf_step` for the arrays.

    Attributes:
        code: the compiled row.
        belief: state and covariance before the first row.
        new: the rows.
        constants: parameters and variances.
        after: state and covariance after each row, to be filled.
        outputs: outputs of each row, to be filled.
    """

    code: CompiledFunction
    belief: Array
    new: Array
    constants: Array
    after: Array
    outputs: Array

    def run(self) -> int:
        """Filter the rows; returns how many succeeded."""
        return self.code.fill(len(self.new), *self.arrays)

    @property
    def arrays(self) -> tuple[list[Array], list[Array]]:
        """Arguments and results of the code."""
        return [self.belief, self.new, self.constants], [self.after, self.outputs]


BatchedRun: TypeAlias = Generator[RowBatch, int, FilterResult]
"""A filter's run: yields batches, and is sent how many rows of each succeeded."""


def run_together(runs: Sequence[BatchedRun]) -> list[FilterResult]:
    """Run different filters of the same model."""
    results: dict[int, FilterResult] = {}
    waiting: dict[int, RowBatch] = {}

    def advance(index: int, done: int | None) -> None:
        """Run to the next batch or to the end."""
        try:
            waiting[index] = next(runs[index]) if done is None else runs[index].send(done)
        except StopIteration as end:
            results[index] = end.value

    for index in range(len(runs)):
        advance(index, None)
    while waiting:
        first = next(iter(waiting.values()))
        alike = [index for index, item in waiting.items() if len(item.new) == len(first.new)][:LANES]
        batches = [waiting.pop(index) for index in alike]
        for index, rows in zip(alike, _run_batches(batches), strict=True):
            advance(index, rows)
    return [results[index] for index in range(len(runs))]


def _run_batches(batches: Sequence[RowBatch]) -> list[int]:
    """Number of rows that succeeded in each of some batches of the same length."""
    rows = len(batches[0].new)
    if len(batches) == 1 or rows < LEAST_ROWS:
        return [item.run() for item in batches]
    arguments, results = zip(*(item.arrays for item in batches), strict=True)
    if batches[0].code.fill_chains(rows, arguments, results) == rows:
        return [rows] * len(batches)
    return [item.run() for item in batches]  # one stopped early: the others must still be run to their end
