"""Rows of many plants in their normal state: each goes through the compiled step and into the ring of newest rows."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from monitor_node.fleet.packed.record import LEVELS, Array, Bytes, Ints, Places, Records
from monitor_node.fleet.packed.ring import VALUE_BYTES, ZERO
from monitor_node.pipeline.row_frame import LAST_NS, Words
from monitor_node.pipeline.row_step import EVENT, step
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.records.record import MINUTE_NS

ORDINARY, NEW_MINUTE, ODD = 0, 1, 2
"""Kinds of a row: nothing happened; the same, and alarm KPIs are due; it is for the plant's own monitor."""

_MINUTE_NS = int(MINUTE_NS)


@jit
def _level(p: Any, i: int, bits: int) -> int:
    """Index of the level that an input is at, perhaps one that was unused; `LEVELS` if there is none."""
    free = LEVELS
    for level in range(LEVELS):
        if p.level_rows[i, level] == 0:
            free = min(free, level)
        elif p.levels[i, level] == bits:
            return level
    if free < LEVELS:
        p.levels[i, free] = bits
    return free


@jit
def _keep(p: Any, row: Bytes, others: Ints, bits: Ints) -> None:
    """Put a row into the ring, see `ring.Kept`."""
    inputs = others.shape[1]
    for i in range(inputs):
        if p.kept == others.shape[0] and row[i] < LEVELS:
            p.level_rows[i, row[i]] -= 1  # of the row that goes
        level = _level(p, i, bits[i])
        row[i] = level
        if level < LEVELS:
            p.level_rows[i, level] += 1
        else:
            others[p.head, i] = bits[i]
    for k in range(bits.size - inputs):
        code = bits[inputs + k] - p.reference[k] if bits[inputs + k] else ZERO
        for byte in range(VALUE_BYTES):
            row[inputs + VALUE_BYTES * k + byte] = code >> 8 * byte & 0xFF


@jit
def _fits(p: Any, spacing_ns: int, bits: NDArray[np.int64], is_kept: bool) -> bool:
    """True if the ring can keep a row."""
    over_ns = spacing_ns - p.usual_ns
    fits = over_ns % p.unit_ns == 0 and abs(over_ns // p.unit_ns) < 2**31
    inputs = bits.size - p.reference.size
    for i in range(p.reference.size if is_kept else 0):
        off = bits[inputs + i] - p.reference[i]
        fits = fits and (bits[inputs + i] == 0 or ZERO < off < -ZERO)
    return bool(fits)


@jit
def step_rows(
    plants: Records,
    numbers: Words,
    frame: Words,
    beliefs: Array,
    variances: Array,
    parameters: Array,
    after: Array,
    times: Places,
    ring: Bytes,
    others: Ints,
    row_slots: Places,
    row_time_ns: Ints,
    row_values: Array,
    row_time_min: Array,
    row_bits: Ints,
    kinds: Places,
) -> None:
    """Take rows through all stages, those of a plant one after the other.

    Args:
        plants: records.
        numbers: numbers of the stages, see `row_frame.words_of`.
        frame: see `row_frame.frame_of`.
        beliefs: beliefs of the filters, see `FilterNumbers`.
        variances: variances of the filters, see `FilterNumbers`.
        parameters: see `row_step.step`.
        after: see `row_step.step`.
        times: spacing before each of the newest rows, shape (plants, rows kept).
        ring: values of these rows, see `ring.Kept`, shape (plants, rows kept, bytes); without columns if there is no
            isolation.
        others: inputs at no level, shape (plants, rows kept, inputs).
        row_slots: slot of each row.
        row_time_ns: time of each row.
        row_values: values of each row, the inputs first, shape (rows, signals).
        row_time_min: time of each row in minutes.
        row_bits: values of each row as bits.
        kinds: filled with the kind of each row; after a row that is odd, all of its plant are.
    """
    keeps, is_kept = times.shape[1], ring.shape[2] > 0
    for k in range(row_slots.size):
        slot, time_ns = row_slots[k], row_time_ns[k]
        p = plants[slot]
        spacing_ns = time_ns - numbers[slot, LAST_NS]
        is_odd = p.odd or not _fits(p, spacing_ns, row_bits[k], is_kept)
        if not is_odd:
            is_odd = (
                step(
                    numbers,
                    frame,
                    beliefs,
                    variances,
                    parameters,
                    after,
                    slot,
                    time_ns,
                    row_time_min[k],
                    row_values[k],
                )
                == EVENT
            )
        if is_odd:
            kinds[k] = ODD
            p.odd = 1
            continue
        p.spacing_ns = spacing_ns
        p.rows_watched += 1
        over = (spacing_ns - p.usual_ns) // p.unit_ns
        if times[slot, p.head] != over:  # or a page of zeros would take memory
            times[slot, p.head] = over
        if is_kept:
            _keep(p, ring[slot, p.head], others[slot], row_bits[k])
        p.head = p.head + 1 if p.head + 1 < keeps else 0
        p.kept = min(p.kept + 1, keeps)
        minute = time_ns // _MINUTE_NS
        kinds[k] = ORDINARY if minute == p.kpi_minute else NEW_MINUTE
        p.kpi_minute = minute
