"""Kernels of the bank of filters: a row takes some microseconds, where NumPy would take hundreds."""

from math import exp, inf, isfinite, log, nan

import numpy as np
from numpy.typing import NDArray

from monitor_node.isolation.residual import SUMMED_ROWS, log_evidence_of_squares
from monitor_node.isolation.window import GATE
from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import call_at, jit
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
def set_rows(
    rows: Array,
    filters: NDArray[np.void],
    fixed: Array,
    before: Array,
    inputs: Array,
    begin_min: float,
    end_min: float,
) -> None:
    """Set the arguments of the compiled step (`ekf_step.row_function`) of each filter; measured values are missing.

    Args:
        rows: arguments of each filter.
        filters: numbers of the filters.
        fixed: inputs of the bank's model without a cause.
        before: inputs of the process in the row before.
        inputs: inputs of the process.
        begin_min: start of the interval.
        end_min: end of the interval.
    """
    n_u, n_p = fixed.size, inputs.size
    for i in range(len(filters)):
        item, row = filters[i], rows[i]
        row[:n_u] = row[n_u : 2 * n_u] = fixed
        row[:n_p], row[n_u : n_u + n_p] = before, inputs
        if item.cause != NO_FAULT:
            first, second = n_p + 2 * item.cause, n_u + n_p + 2 * item.cause
            begin = item.size * growth(begin_min, item.is_step, item.onset_min, item.reference_min, item.end_min)
            end = item.size * growth(end_min, item.is_step, item.onset_min, item.reference_min, item.end_min)
            row[first], row[first + 1] = 0.5 * (begin + end), begin
            row[second], row[second + 1] = end, end
        row[2 * n_u] = end_min
        row[2 * n_u + 1] = row[2 * n_u + 2] = 0.5 * (end_min - begin_min)
        row[2 * n_u + 3 :] = inf


@jit
def filter_row(
    filters: NDArray[np.void],
    step: int,
    beliefs: Array,
    rows: Array,
    constants: Array,
    measured: Array,
    far: NDArray[np.bool_],
    share: int,
) -> bool:
    """Correct the filters by a row, and add it to their evidence.

    Args:
        filters: numbers of the filters.
        step: address of the compiled step.
        beliefs: belief of each filter at the start of the interval.
        rows: arguments of each filter, see `set_rows`; the measured values are filled in.
        constants: constants of the bank.
        measured: values of the sensors; NaN where missing. A value far from each prediction becomes NaN, unless the
            one before it was far too.
        far: flags of the outputs whose last value was far; they are updated.
        share: index of the relative size in a belief.

    Returns:
        True if the filter of a cause has diverged, see `add_evidence`.
    """
    n_y = measured.size
    after, outputs = step_filters(step, beliefs, rows, constants, measured)
    is_outlier = False
    for j in range(n_y):
        is_far = True
        for i in range(len(filters)):
            is_far = is_far and abs(outputs[i, n_y + j]) > GATE * outputs[i, 2 * n_y + j]
        if is_far and not far[j]:  # an outlier, until the next value confirms it
            is_outlier, measured[j] = True, nan
        far[j] = is_far
    if is_outlier:
        after, outputs = step_filters(step, beliefs, rows, constants, measured)
    for i in range(len(filters)):
        filters[i].belief[:] = after[i]
    return add_evidence(filters, outputs, measured, share)


@jit
def step_filters(step: int, beliefs: Array, rows: Array, constants: Array, measured: Array) -> tuple[Array, Array]:
    """Call the compiled step for these measured values; for the arguments see `filter_row`.

    Returns:
        The beliefs after the row, and the outputs of the step.
    """
    n, n_y = len(rows), measured.size
    after, outputs = np.empty(beliefs.shape), np.empty((n, 5 * n_y + 1))
    for row in rows:
        row[row.size - 2 * n_y : row.size - n_y] = measured
    arguments = (beliefs.ctypes.data, rows.ctypes.data, constants.ctypes.data)
    call_at(step, (n, *arguments, after.ctypes.data, outputs.ctypes.data))
    return after, outputs


@jit
def set_shares(filters: NDArray[np.void], shares: Array) -> None:
    """Compute the probability of each filter, and last that of none of the causes.

    Args:
        filters: numbers of the filters, the plant without a fault last.
        shares: array for the result, one longer than `filters`.
    """
    n, best = len(filters), 0
    for i in range(n):
        shares[i] = filters[i].log_evidence
        if i < n - 1 and shares[i] > shares[best]:
            best = i
    shares[n] = shares[best] + log_evidence_of_squares(filters[best].square, filters[best].count)
    top, total = np.max(shares), 0.0
    for i in range(n + 1):
        shares[i] = exp(shares[i] - top)
        total += shares[i]
    shares /= total


@jit
def add_evidence(filters: NDArray[np.void], outputs: Array, measured: Array, share: int) -> bool:
    """Add a row to the evidence of each filter, and keep its relative size within bounds.

    Args:
        filters: numbers of the filters, with their beliefs after the row.
        outputs: outputs of the compiled step.
        measured: values of the sensors; NaN where missing.
        share: index of the relative size in the belief.

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
            if isfinite(measured[j]):
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
            if not isfinite(measured[j]):
                continue
            w = min(max(outputs[i, 3 * n_y + j], -HUBER), HUBER)
            for b in range(len(SUMMED_ROWS)):
                item.sum[b, j] += w
                item.summed[b, j] += 1.0
        for b in range(len(SUMMED_ROWS)):
            if item.rows % SUMMED_ROWS[b] == 0:
                for j in range(n_y):
                    if item.summed[b, j] > 0.0:
                        item.square[b, j] += item.sum[b, j] ** 2 / item.summed[b, j]
                        item.count[b, j] += 1.0
                    item.sum[b, j] = item.summed[b, j] = 0.0
    return diverged
