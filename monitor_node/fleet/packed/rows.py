"""Rows of many plants in their normal state: each goes through the compiled step and into the ring of newest rows."""

from monitor_node.fleet.packed.record import Array, Bytes, Ints, Places, Records
from monitor_node.fleet.packed.ring import add_row, fits
from monitor_node.pipeline.row_frame import LAST_NS, Words
from monitor_node.pipeline.row_step import EVENT, step
from reactorwatch.codegen.numba_kernel import borrow, jit
from reactorwatch.records.record import MINUTE_NS

ORDINARY, NEW_MINUTE, ODD = 0, 1, 2
"""Kinds of a row: nothing happened; the same, and alarm KPIs are due; it is for the plant's own monitor."""

_MINUTE_NS = int(MINUTE_NS)


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
        ring: values of these rows, see `ring`, shape (plants, rows kept, bytes); without columns if there is no
            isolation.
        others: inputs at no level, shape (plants, rows kept, inputs).
        row_slots: slot of each row.
        row_time_ns: time of each row.
        row_values: values of each row, the inputs first, shape (rows, signals).
        row_time_min: time of each row in minutes.
        row_bits: values of each row as bits.
        kinds: filled with the kind of each row; after a row that is odd, all of its plant are.
    """
    is_kept = ring.shape[2] > 0
    for k in range(row_slots.size):
        slot, time_ns = row_slots[k], row_time_ns[k]
        values, bits = borrow(row_values[k]), borrow(row_bits[k])
        p = plants[slot]
        spacing_ns = time_ns - numbers[slot, LAST_NS]
        is_odd = p.odd or not fits(p, spacing_ns, bits, is_kept)
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
                    values,
                )
                == EVENT
            )
        if is_odd:
            kinds[k] = ODD
            p.odd = 1
            continue
        p.spacing_ns = spacing_ns
        p.rows_watched += 1
        add_row(p, borrow(times[slot]), borrow(ring[slot]), borrow(others[slot]), spacing_ns, bits)
        minute = time_ns // _MINUTE_NS
        kinds[k] = ORDINARY if minute == p.kpi_minute else NEW_MINUTE
        p.kpi_minute = minute
