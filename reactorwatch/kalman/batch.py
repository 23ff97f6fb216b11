"""Records in the layout of the compiled filter, and its runs over them in batches of rows.

Most rows follow the one before within two integration steps; machine code takes a batch of them in one call. Batches of
several filters of one model run in lanes (see `compiled_function`), each with its own record and noise: four take
little longer than one, and each gives the result that it gives by itself, to the last bit.

Where rows are missing and an input has another value after them, it may have changed with any of the missing rows or
with the row after them, each as likely (`InputUncertainty`). The state is predicted for each of these times; the prior
mean is the mean of the predictions, and their spread is added to its covariance. A share of the change's effect would
not do: the temperature's response grows with the time since the change, but the concentration's, which follows the
temperature, with its square.

The cost of a search is bounded by its work and not by a clock (`StepBudget`): so it stops at the same step on every
machine, and a replay gives the results of the live run bit for bit. The unit is a row filtered by machine code, about a
microsecond; other work counts as many units as it took rows' time when it was measured.
"""

from collections.abc import Generator, Sequence
from enum import IntEnum
from math import inf, log, pi
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import LANES, CompiledFunction
from reactorwatch.process.simulate import LONGEST_STEP_MIN

GATE = 6.0  # standard deviations beyond which a measurement is an outlier: once in 500 million normal values

LONGEST_ROW_MIN = 1.001 * 2 * LONGEST_STEP_MIN  # a row is two steps; times are rounded

LONGEST_GAP_MIN = 30.0  # after more a filter restarts, see `ekf`

LEAST_ROWS = 4000  # of a batch, for which lanes pay: 1,300 if their code is on disk, 13,000 if it must be compiled


class StepCost(IntEnum):
    """Costs of other work than a row, in filter steps, as measured (see the module)."""

    RUN = 100  # for the set-up and the results of a filter's run over a record of any length
    EVALUATION = 200  # for the signals and the layout of a hypothesis, besides its run and one for ten rows
    LINEARISATION = 300  # for a linearisation of a filter about its run, besides three for two rows
    COVARIANCE = 350  # for the covariance of a hypothesis's parameters
    ROW = 25  # for a row that is filtered by itself
    PREDICTION = 3  # for two integration steps before the last two of an interval
    START = 250  # for a start of the filter, which also stops the machine code
    SEARCH = 12_000  # for a search for steady states, where measurements do not determine the initial state


class BudgetExceededError(Exception):
    """The budget of filter steps is spent; the search ends here."""


class StepBudget:
    """A number of filter steps.

    Args:
        steps: number of steps, at least 1.

    Attributes:
        spent: number of steps taken so far.
    """

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self.spent = 0

    def spend(self, steps: int) -> None:
        """Count steps.

        Raises:
            BudgetExceededError: the budget would be exceeded; then nothing is counted, as nothing is done.
        """
        if self.spent + steps > self._steps:
            raise BudgetExceededError(f"the budget of {self._steps} filter steps is spent")
        self.spent += steps


class InputUncertainty(NamedTuple):
    """Intervals in which an input changed at an unknown time, each in the row at its end.

    Attributes:
        inputs: inputs after the change, shape (rows, n_u).
        first_min: earliest time of the change, shape (rows,).
        last_min: latest time of the change, shape (rows,); the others are evenly spaced between them.
        n_times: number of possible times, shape (rows,); 0 where the inputs are known.
    """

    inputs: Array
    first_min: Array
    last_min: Array
    n_times: NDArray[np.intp]

    @classmethod
    def for_missing_rows(cls, time_min: Array, inputs: Array, missing: NDArray[np.intp]) -> "InputUncertainty":
        """Mark the intervals with missing rows.

        Args:
            time_min: times of the rows, shape (rows,).
            inputs: inputs that hold from each row on, shape (rows, n_u).
            missing: number of rows missing before each row whose inputs hold since an unknown time, else 0, shape
                (rows,).
        """
        before = np.append(time_min[:1], time_min[:-1])
        n_times = np.where(missing > 0, missing + 1, 0)
        return cls(inputs, before + (time_min - before) / np.maximum(n_times, 1), time_min, n_times)

    def select(self, rows: slice | NDArray[np.intp]) -> "InputUncertainty":
        """Select rows."""
        return InputUncertainty(self.inputs[rows], self.first_min[rows], self.last_min[rows], self.n_times[rows])

    @property
    def rows(self) -> NDArray[np.bool_]:
        """True for rows at the end of an uncertain interval, shape (rows,)."""
        return np.asarray(self.n_times > 0)

    def changes(self, row: int) -> list[tuple[float, list[float]]]:
        """Possible changes before a row, at increasing times, each with the inputs from then on; empty: none."""
        times: list[float] = np.linspace(self.first_min[row], self.last_min[row], self.n_times[row]).tolist()
        inputs: list[float] = self.inputs[row].tolist()
        return [(time, inputs) for time in times]


class FilterRecord:
    """The rows of a record, prepared once for many runs of `Filter.run`.

    Args:
        time_min: shape (rows,).
        inputs: shape (rows, n_u) or (rows,) for one input; NaN where unknown.
        measured: shape (rows, n_y); NaN where missing.
        gate: standard deviations beyond which a measurement does not correct the state.
        accept: measurements that correct the state whatever the gate, shape (rows, n_y); None: none.
        uncertainty: intervals in which inputs changed at an unknown time; None: there are none.

    Attributes:
        rows: the arguments `new` of the compiled rows, see `ekf_step`; the first row lacks what comes from the row
            before.
        near: True for rows at most two integration steps after the one before, shape (rows,); undecided for the first.
    """

    def __init__(
        self,
        time_min: Array,
        inputs: Array,
        measured: Array,
        gate: float = inf,
        accept: NDArray[np.bool_] | None = None,
        uncertainty: InputUncertainty | None = None,
    ) -> None:
        count, n_y = measured.shape
        inputs = inputs.reshape(count, -1)
        n_u = inputs.shape[1]
        self.time_min, self.inputs, self.measured = time_min, inputs, measured
        self.gate, self.uncertainty = gate, uncertainty
        self.accept = np.zeros(measured.shape, dtype=np.bool_) if accept is None else accept
        self.rows = rows = np.zeros((count, 2 * n_u + 3 + 2 * n_y))
        self.near = near = np.zeros(count, dtype=np.bool_)
        half = 0.5 * np.diff(time_min)
        near[1:] = (half > 0.0) & (2.0 * half <= LONGEST_ROW_MIN) & np.all(np.isfinite(inputs[:-1]), axis=1)
        if uncertainty is not None:
            near &= ~uncertainty.rows
        rows[1:, :n_u], rows[:, n_u : 2 * n_u], rows[:, 2 * n_u] = inputs[:-1], inputs, time_min
        rows[1:, 2 * n_u + 1], rows[1:, 2 * n_u + 2] = half, half
        rows[:, -2 * n_y : -n_y], rows[:, -n_y:] = measured, np.where(self.accept, inf, gate)

    def following(
        self, before_min: float | None, inputs: Sequence[float], breaks: Sequence[float]
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Complete `rows` (read-only) and `near` with what precedes the record.

        Args:
            before_min: time of the row before the first one; None if there is none.
            inputs: inputs of that row.
            breaks: times at which the right-hand side jumps, increasing.
        """
        near, times, n_u = self.near.copy(), self.time_min, self.inputs.shape[1]
        rows = self.rows if before_min is None and not breaks else self.rows.copy()
        first, second = 2 * n_u + 1, 2 * n_u + 2
        near[0] = False
        if before_min is not None:
            half = 0.5 * (times[0] - before_min)
            rows[0, :n_u], rows[0, first], rows[0, second] = inputs, half, half
            near[0] = 0.0 < 2.0 * half <= LONGEST_ROW_MIN and not (
                self.uncertainty is not None and self.uncertainty.rows[0]
            )
        for point in breaks:
            row = int(times.searchsorted(point))
            since = times[row - 1] if row else before_min
            if row < times.size and since is not None and since < point < times[row]:
                near[row] &= sum(since < other < times[row] for other in breaks) == 1
                rows[row, first], rows[row, second] = point - since, times[row] - point
        return rows, near


class Innovation(NamedTuple):
    """Innovation of a row, one number an output. In the row that a filter starts with all are NaN.

    Attributes:
        prediction: predicted measurement.
        residual: the innovation, measured less predicted; NaN where nothing was measured.
        sd: standard deviation of the innovation if the model is right.
        normalized: innovation normalised by its covariance, independent and standard normal if the model is right; NaN
            where nothing was measured.
    """

    prediction: tuple[float, ...]
    residual: tuple[float, ...]
    sd: tuple[float, ...]
    normalized: tuple[float, ...]


class FilterResult(NamedTuple):
    """Innovations and filtered states of a record. In rows that the filter starts with all are NaN.

    Attributes:
        prediction: predicted measurements, shape (rows, n_y).
        residual: innovations, shape (rows, n_y); NaN where nothing was measured.
        sd: standard deviations of the innovations, shape (rows, n_y).
        normalized: normalised innovations, shape (rows, n_y); NaN where nothing was measured.
        conditional_sd: standard deviation of each innovation given those of the outputs before it, shape (rows, n_y).
        x: filtered state, shape (rows, n_x).
        P: filtered covariance, shape (rows, n_x, n_x).
    """

    prediction: Array
    residual: Array
    sd: Array
    normalized: Array
    conditional_sd: Array
    x: Array
    P: Array

    @property
    def log_likelihood(self) -> Array:
        """Log likelihood of each row's measurements, shape (rows,)."""
        measured = np.isfinite(self.normalized)
        parts = np.where(measured, 0.5 * self.normalized**2 + 0.5 * log(2 * pi) + np.log(self.conditional_sd), 0.0)
        return np.asarray(-np.sum(parts, axis=1))


class ResampledRecord(NamedTuple):
    """A record with unmeasured rows inserted so that no interval exceeds two integration steps.

    A filter takes such rows in one call, and others one by one, thirty times as slowly. An inserted row has the inputs
    of the row before.

    Attributes:
        time_min: shape (more,).
        inputs: shape (more, n_u).
        measured: shape (more, n_y); NaN in inserted rows.
        uncertainty: uncertain intervals; None: there are none.
        original_index: indices of the original rows, shape (rows,).
    """

    time_min: Array
    inputs: Array
    measured: Array
    uncertainty: InputUncertainty | None
    original_index: NDArray[np.intp]

    def at_original_rows(self, result: FilterResult) -> FilterResult:
        """Select the original rows of a filter's result."""
        if self.original_index.size == self.time_min.size:
            return result
        return FilterResult(*(item[self.original_index] for item in result))


def count_pieces(time_min: Array) -> Array:
    """Number of pieces of two integration steps in each interval, shape (rows - 1,); 1 in a long gap."""
    step = np.diff(time_min)
    return np.where((step > LONGEST_ROW_MIN) & (step <= LONGEST_GAP_MIN), np.ceil(step / LONGEST_ROW_MIN), 1.0)


def insert_rows(
    time_min: Array, inputs: Array, measured: Array, uncertainty: InputUncertainty | None = None
) -> ResampledRecord:
    """Insert rows into a record (see `FilterRecord`), except into uncertain intervals and into long gaps."""
    pieces = count_pieces(time_min)
    if uncertainty is not None:
        pieces[uncertainty.rows[1:]] = 1.0
    counts = np.append(pieces.astype(np.intp), 1)
    index = np.cumsum(counts) - counts
    if index[-1] == index.size - 1:
        return ResampledRecord(time_min, inputs, measured, uncertainty, index)
    source = np.repeat(np.arange(index.size), counts)
    share = (np.arange(source.size) - index[source]) / counts[source]
    times = time_min[source] + share * np.append(np.diff(time_min), 0.0)[source]
    more = np.full((source.size, measured.shape[1]), np.nan)
    more[index] = measured
    if uncertainty is not None:
        n_times = np.zeros(source.size, dtype=np.intp)
        n_times[index] = uncertainty.n_times
        uncertainty = uncertainty.select(source)._replace(n_times=n_times)
    return ResampledRecord(times, inputs[source], more, uncertainty, index)


class RowBatch(NamedTuple):
    """Rows that are filtered in one call of the compiled row; see `ekf_step` for the arrays.

    Attributes:
        code: the compiled row.
        rows: number of rows.
        arguments: state and covariance before the first row, the rows, and the constants.
        results: arrays to be filled: state and covariance after each row, and its outputs.
    """

    code: CompiledFunction
    rows: int
    arguments: list[Array]
    results: list[Array]


BatchedRun: TypeAlias = Generator[RowBatch, int, FilterResult]
"""A filter's run: yields batches, and is sent how many rows of each succeeded."""


def run_together(runs: Sequence[BatchedRun]) -> list[FilterResult]:
    """Run different filters of the same model."""
    results: dict[int, FilterResult] = {}
    waiting: dict[int, RowBatch] = {}
    succeeded: dict[int, int | None] = dict.fromkeys(range(len(runs)))
    while succeeded:
        for index, rows in succeeded.items():
            try:
                waiting[index] = next(runs[index]) if rows is None else runs[index].send(rows)
            except StopIteration as end:
                results[index] = end.value
        alike = [index for index, item in waiting.items() if item.rows == next(iter(waiting.values())).rows][:LANES]
        succeeded = dict(zip(alike, _run_batches([waiting.pop(index) for index in alike]), strict=True))
    return [results[index] for index in range(len(runs))]


def _run_batches(batches: Sequence[RowBatch]) -> list[int]:
    """Number of rows that succeeded in each of some batches of the same length."""
    if len(batches) > 1 and batches[0].rows >= LEAST_ROWS:
        code, rows, arguments, results = zip(*batches, strict=True)
        if code[0].fill_chains(rows[0], arguments, results) == rows[0]:
            return list(rows)
    # one by one also where one of several stopped early: the others must still be run to their end
    return [item.code.fill(item.rows, item.arguments, item.results) for item in batches]
