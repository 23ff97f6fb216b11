"""A sensor that shows what was there some time ago, for the filter: its values are moved to when they were true.

A delay would cost a filter many states. But a value that a sensor shows m late is exactly one that a prompt sensor
showed at t - m, so the filter is given it there, between the rows of the other sensors, as a row of its own. What it
says of that value counts for the row in which it was shown.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.run import Run, doubt_of
from reactorwatch.kalman.innovations import FilterResult
from reactorwatch.kalman.input_uncertainty import InputUncertainty


class Moved(NamedTuple):
    """A run with the values of one output moved.

    Attributes:
        run: with more rows; its inputs are those of the run and what else was given for every row.
        prompt: where the run's rows are in it, shape (rows,).
        late: where the values of the late output are, shape (rows,).
        before: whether such a value was true before the filter began, so that nothing tells what it is, shape (rows,).
        uncertainty: the ways of the run on which nobody knows when inputs changed; None: there are none.
    """

    run: Run
    prompt: NDArray[np.int64]
    late: NDArray[np.int64]
    before: NDArray[np.bool_]
    uncertainty: InputUncertainty | None = None


def moved(run: Run, inputs: Array, held: NDArray[np.bool_], output: int, delay_min: Array) -> Moved:
    """The run as if the sensor were prompt.

    Args:
        run: the record.
        inputs: for every row, shape (rows, n).
        held: which of the inputs are held from their row on; the others belong to the measurements of their row.
        output: place of the late output.
        delay_min: shape (rows,), at least 0.
    """
    rows = run.time_min.size
    begins = np.array([0, *run.breaks])
    begun_min = run.time_min[begins[np.searchsorted(begins, np.arange(rows), side="right") - 1]]
    true_min = run.time_min - np.maximum(delay_min, 0.0)
    before = true_min < begun_min
    true_min = np.maximum(true_min, begun_min)
    times, where = np.unique(np.concatenate([run.time_min, true_min]), return_inverse=True)
    prompt, late = where[:rows], where[rows:]
    source = np.clip(np.searchsorted(run.time_min, times, side="right") - 1, 0, rows - 1)
    spread = inputs[source]
    measured = np.full((times.size, run.measured.shape[1]), np.nan)
    for place in range(measured.shape[1]):
        measured[late if place == output else prompt, place] = run.measured[:, place]
    spread[late[:, None], np.flatnonzero(~held)] = inputs[:, ~held]
    uncertainty = doubt_of(run, spread, np.searchsorted(run.time_min, times, side="left"))
    return Moved(Run(times, spread, measured), prompt, late, before, uncertainty)


def gathered(found: FilterResult, by: Moved, output: int) -> FilterResult:
    """The filter's run in the rows of the record."""
    items = [np.array(item[by.prompt]) for item in found]
    for item, whole in zip(items[:5], found[:5], strict=True):
        item[:, output] = whole[by.late, output]
    return FilterResult(*items)
