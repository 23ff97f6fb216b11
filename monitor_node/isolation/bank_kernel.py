"""Kernels of the bank of filters: a row takes some microseconds, where NumPy would take hundreds."""

from math import inf, isfinite, log

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.diagnosis.fitting.fault_filter import HUBER

NO_FAULT = -1
"""Index in place of the cause's in the filter of a plant without a fault."""

DIVERGED = 1e6
"""Standard deviations beyond which all innovations count alike."""


@jit
def growth(time_min: float, is_step: bool, onset_min: float, reference_min: float, end_min: float) -> float:
    """Size of a cause at a time relative to that at the reference time."""
    return 1.0 if is_step else (min(time_min, end_min) - onset_min) / (reference_min - onset_min)


@jit
def set_causes(
    rows: Array, first: int, second: int, filters: NDArray[np.void], begin_min: float, end_min: float
) -> None:
    """Set the interval mean and the sample value of each filter's cause in the arguments of the compiled step.

    Args:
        rows: arguments of each filter.
        first: index of the first cause's interval mean among the inputs of the row before.
        second: index of the first cause's interval mean among the inputs of the row.
        filters: numbers of the filters.
        begin_min: start of the interval.
        end_min: end of the interval.
    """
    for i in range(len(filters)):
        item = filters[i]
        if item.cause != NO_FAULT:
            column = 2 * item.cause
            begin = item.size * growth(begin_min, item.is_step, item.onset_min, item.reference_min, item.end_min)
            end = item.size * growth(end_min, item.is_step, item.onset_min, item.reference_min, item.end_min)
            rows[i, first + column], rows[i, first + column + 1] = 0.5 * (begin + end), begin
            rows[i, second + column], rows[i, second + column + 1] = end, end


@jit
def add_evidence(
    filters: NDArray[np.void], outputs: Array, measured: NDArray[np.bool_], share: int, summed_rows: tuple[int, ...]
) -> bool:
    """Add a row to the evidence of each filter, and keep its relative size within bounds.

    Args:
        filters: numbers of the filters, with their beliefs after the row.
        outputs: outputs of the compiled step.
        measured: mask of the measured values, shape (n_y,).
        share: index of the relative size in the belief.
        summed_rows: numbers of rows of the blocks, see `residual.sums_dtype`.

    Returns:
        True if the filter of a cause has diverged; its evidence is then minus infinity.
    """
    n_y, diverged = measured.size, False
    for i in range(len(filters)):
        item = filters[i]
        belief = item.belief
        loss = 0.0
        for value in belief:
            loss += 0.0 * value  # not finite if the belief is not
        for j in range(n_y):
            if measured[j]:
                size, scale = abs(outputs[i, 3 * n_y + j]), outputs[i, 4 * n_y + j]
                if not (isfinite(size) and scale > 0.0):
                    loss = inf
                else:
                    size = min(size, DIVERGED)
                    loss += 0.5 * min(size, HUBER) ** 2 + HUBER * max(size - HUBER, 0.0) + log(scale)
        if not isfinite(loss):
            item.log_evidence = -inf
            diverged |= item.cause != NO_FAULT
            continue
        item.log_evidence -= loss
        belief[share] = min(max(belief[share], 0.0), item.largest_share)
        item.rows += 1
        for j in range(n_y):
            if not measured[j]:
                continue
            w = min(max(outputs[i, 3 * n_y + j], -HUBER), HUBER)
            for b in range(len(summed_rows)):
                item.sum[b, j] += w
                item.summed[b, j] += 1.0
        for b in range(len(summed_rows)):
            if item.rows % summed_rows[b] == 0:
                for j in range(n_y):
                    if item.summed[b, j] > 0.0:
                        item.square[b, j] += item.sum[b, j] ** 2 / item.summed[b, j]
                        item.count[b, j] += 1.0
                    item.sum[b, j] = item.summed[b, j] = 0.0
    return diverged
