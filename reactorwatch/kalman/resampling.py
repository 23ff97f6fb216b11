"""A record with rows put in where rows are far apart, so that two steps lead from each row to the next.

A filter takes such rows at once, and any others one by one, thirty times as slowly. Nothing is measured in a row that
is put in, and the inputs are those of the row before.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.kalman.ekf import LONGEST_GAP_MIN
from reactorwatch.kalman.filter_record import LONGEST_ROW_MIN
from reactorwatch.kalman.innovations import Innovations
from reactorwatch.kalman.input_uncertainty import Doubt


class Filled(NamedTuple):
    """A record with more rows.

    Attributes:
        time_min: shape (more,).
        inputs: shape (more, n_u).
        measured: shape (more, n_y); NaN in rows that were put in.
        doubt: as it was.
        own: where the rows of the record are, shape (rows,).
    """

    time_min: Array
    inputs: Array
    measured: Array
    doubt: Doubt | None
    own: NDArray[np.intp]

    def of_record(self, found: Innovations) -> Innovations:
        """What a filter says of the rows of the record."""
        if self.own.size == self.time_min.size:
            return found
        return Innovations(*(item[self.own] for item in found))


def filled(time_min: Array, inputs: Array, measured: Array, doubt: Doubt | None = None) -> Filled:
    """Put rows in, but for ways in doubt and for those that no filter goes.

    Args:
        time_min: shape (rows,), increasing.
        inputs: shape (rows, n_u).
        measured: shape (rows, n_y).
        doubt: ways on which nobody knows when inputs changed; None: there are none.
    """
    step = np.diff(time_min)
    if not np.any(step > LONGEST_ROW_MIN):
        return Filled(time_min, inputs, measured, doubt, np.arange(time_min.size))
    pieces = np.where((step > LONGEST_ROW_MIN) & (step <= LONGEST_GAP_MIN), np.ceil(step / LONGEST_ROW_MIN), 1.0)
    if doubt is not None:
        pieces[doubt.rows[1:]] = 1.0
    counts = np.append(pieces.astype(np.intp), 1)
    own = np.cumsum(counts) - counts
    if own[-1] == own.size - 1:
        return Filled(time_min, inputs, measured, doubt, own)
    source = np.repeat(np.arange(own.size), counts)
    share = (np.arange(source.size) - own[source]) / counts[source]
    times = time_min[source] + share * np.append(step, 0.0)[source]
    more = np.full((source.size, measured.shape[1]), np.nan)
    more[own] = measured
    if doubt is not None:
        moments = np.zeros(source.size, dtype=np.intp)
        moments[own] = doubt.moments
        doubt = doubt.of_rows(source)._replace(moments=moments)
    return Filled(times, inputs[source], more, doubt, own)
