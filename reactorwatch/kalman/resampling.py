"""Insert unmeasured rows so that no interval exceeds two integration steps.

A filter takes such rows in one call, and others one by one, thirty times as slowly. An inserted row has no measurement
and the inputs of the row before.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.kalman.ekf import LONGEST_GAP_MIN
from reactorwatch.kalman.filter_record import LONGEST_ROW_MIN
from reactorwatch.kalman.innovations import FilterResult
from reactorwatch.kalman.input_uncertainty import InputUncertainty


class ResampledRecord(NamedTuple):
    """A record with inserted rows.

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
    """Insert rows, except into uncertain intervals and into gaps at which the filter restarts.

    Args:
        time_min: shape (rows,), increasing.
        inputs: shape (rows, n_u).
        measured: shape (rows, n_y).
        uncertainty: intervals in which inputs changed at an unknown time; None: there are none.
    """
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
