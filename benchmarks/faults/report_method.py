"""The method of the report that this project starts from: fixed limits on the residuals of one linear model.

A model of order 3 for each output is fitted to the training, an ARX model by least squares (its residual is that of the
next row) or an output-error model (that of its free run). The mean and the standard deviation of the residuals of the
training give the limits, mean +- 3 sigma, and one point of C or of T beyond them is an alarm.

That is a false alarm every few minutes. So that it can be compared at an equal rate of false alarms, the limits are
widened, for both outputs alike, until long runs without a fault have the promised rate: counted, not computed from a
distribution, because the residuals are neither independent nor normal where a linear model meets a nonlinear plant.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.faults.bank import PERIOD_MIN, TRAINING_MIN
from benchmarks.faults.runs import OUTPUTS, SIGNAL
from benchmarks.faults.score import Interval
from benchmarks.study_figures.report_scheme import ORDER
from reactorwatch.arrays import Array
from reactorwatch.identification.linear import fit_linear
from reactorwatch.identification.linear_model import LinearModel
from reactorwatch.identification.structure import Structure
from reactorwatch.records.record import Record

TRAINING_ROWS = round(TRAINING_MIN / PERIOD_MIN)


@dataclass(frozen=True)
class ReportMethod:
    """A chart of the residuals of one kind of model."""

    name: str  # name of the kind
    fit: Callable[[Structure, Array, Array], LinearModel]  # function of structure

    def statistic(self, record: Record) -> Array:
        """Larger residual of each row in standard deviations, shape (rows,).

        0 for the first rows, which cannot be predicted; infinite where the model's simulation has diverged.
        """
        worst = np.zeros(record.rows)
        flows = record.columns[SIGNAL]
        for signal in OUTPUTS:
            values = record.columns[signal]
            model = self.fit(Structure.of_order(ORDER), flows[:TRAINING_ROWS], values[:TRAINING_ROWS])
            residuals = model.residuals(flows, values)[:, 0]
            learned = residuals[:TRAINING_ROWS][np.isfinite(residuals[:TRAINING_ROWS])]
            off = np.abs(residuals - learned.mean()) / learned.std(ddof=1)
            worst = np.maximum(worst, np.where(np.isnan(off), 0.0, off))
        return worst


METHODS: tuple[ReportMethod, ...] = (
    ReportMethod("ARX", partial(fit_linear, "arx")),
    ReportMethod("OE", partial(fit_linear, "oe")),
)


def alarms_of(time_min: Array, statistic: Array, width: float) -> list[Interval]:
    """Intervals of the alarms of a run: each from a point that is out to the next that is in."""
    change = np.diff(statistic > width, prepend=False, append=False)
    edges = np.flatnonzero(change)
    times = np.append(time_min, inf)
    return [Interval(float(times[rise]), float(times[fall])) for rise, fall in edges.reshape(-1, 2)]


def count_alarms(statistics: Iterable[NDArray[np.floating[Any]]], width: float) -> int:
    """Count the alarms of some runs: points that are out, whose predecessor is in."""
    return sum(int(np.count_nonzero(np.diff(item > width, prepend=False, append=False))) // 2 for item in statistics)


def calibrated_width(statistics: Sequence[NDArray[np.floating[Any]]], rows_to_false_alarm: float) -> float:
    """The smallest width beyond which runs without a fault raise no more alarms than promised.

    A run raises an alarm for every rise from a row at or below the width to one above it. So the alarms at a width are
    as many as rows above it, less the pairs of neighbours that are both above it.
    """
    rows = np.concatenate(statistics)
    pairs = np.concatenate([np.minimum(item[1:], item[:-1]) for item in statistics])
    allowed = rows.size / rows_to_false_alarm
    levels = np.sort(rows[np.isfinite(rows)])[::-1]
    above = rows.size - np.searchsorted(np.sort(rows), levels, side="right")
    both_above = pairs.size - np.searchsorted(np.sort(pairs), levels, side="right")
    # From the widest limits inwards: where the count first passes what is allowed, the level before it is kept.
    too_many = above - both_above > allowed
    return float(levels[max(int(np.argmax(too_many)) - 1, 0)] if too_many.any() else levels[-1])
