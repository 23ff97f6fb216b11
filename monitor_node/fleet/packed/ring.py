"""Newest rows of a plant, compressed in a ring without loss.

The 600 rows for isolation are most of the memory of a plant.

The ring holds when each row came, as the spacing before it: in a unit in which all are whole, and less the usual one,
in 32 bits. If that does not fit, as when a plant whose times are in nanoseconds was away for more than two seconds, it
has a monitor until the ring is past it. Of a plant whose rows come evenly all are zero, and memory that never held
anything else takes no room (see `array`).

What was measured is kept in seven bytes: the 64 bits of its number, less those of a value that the signal had before.
That fits as long as values are of one sign and within a factor of 200 of that one, and it fits for zero, which has a
code of its own.

An input is mostly one of a few values, at which it is held for some rows each: one byte tells which of those that the
kept rows have, as far as there are no more than `LEVELS`. One that is none of them, as under a controller, is kept as
it is, in an array that takes memory only where that happened.
"""

from typing import Any, NamedTuple

import numpy as np

from monitor_node.fleet.packed.record import LEVELS, Array, Bytes, Ints, Places, Records
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.records.record import MINUTE_NS

UNITS_NS = (1_000_000, 1_000, 1)
"""In which spacings are kept, the first in which all are whole."""

VALUE_BYTES = 7
ZERO = -(2 ** (8 * VALUE_BYTES - 1))
"""The code of zero; those of other values are above it, and below its negative."""


class NewestRows(NamedTuple):
    """Newest rows of a plant, oldest first.

    Attributes:
        times_ns: time of each row.
        values: values of each row, the inputs first, shape (rows, signals); without columns if they are not kept.
    """

    times_ns: list[int]
    values: Array


def row_bytes(columns: int, inputs: int) -> int:
    """Size of a row in bytes: the level of each input, then the outputs.

    Args:
        columns: number of its values; 0 if they are not kept.
        inputs: number of inputs among them.
    """
    return inputs + VALUE_BYTES * (columns - inputs) if columns else 0


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
def fits(p: Any, spacing_ns: int, bits: Ints, is_kept: bool) -> bool:
    """True if the ring of a plant can keep a row.

    Args:
        p: record of the plant.
        spacing_ns: time since the row before.
        bits: values of the row as bits, the inputs first.
        is_kept: True if values are kept.
    """
    over_ns = spacing_ns - p.usual_ns
    found = over_ns % p.unit_ns == 0 and abs(over_ns // p.unit_ns) < 2**31
    inputs = bits.size - p.reference.size
    for i in range(p.reference.size if is_kept else 0):
        off = bits[inputs + i] - p.reference[i]
        found = found and (bits[inputs + i] == 0 or ZERO < off < -ZERO)
    return bool(found)


@jit
def add_row(p: Any, times: Places, ring: Bytes, others: Ints, spacing_ns: int, bits: Ints) -> None:
    """Put a row that fits into the ring of a plant; arguments as for `fits` and `newest_rows`."""
    over = (spacing_ns - p.usual_ns) // p.unit_ns
    if times[p.head] != over:  # or a page of zeros would take memory
        times[p.head] = over
    if ring.shape[1] > 0:
        _keep(p, ring[p.head], others, bits)
    p.head = p.head + 1 if p.head + 1 < times.size else 0
    p.kept = min(p.kept + 1, times.size)


@jit
def _add_rows(plants: Records, slot: int, times: Places, ring: Bytes, others: Ints, times_ns: Ints, bits: Ints) -> bool:
    p, spacings_ns = plants[slot], np.empty_like(times_ns)
    for k in range(
        times_ns.size
    ):  # all are checked before any is written: memory of a plant that is not kept stays zero
        spacings_ns[k] = times_ns[k] - times_ns[k - 1] if k else p.usual_ns
        if not fits(p, spacings_ns[k], bits[k], ring.shape[1] > 0):
            return False
    for k in range(times_ns.size):
        add_row(p, times, ring, others, spacings_ns[k], bits[k])
    return True


def keep_rows(
    plants: Records, slot: int, times: Places, ring: Bytes, others: Ints, rows: NewestRows, usual_ns: int
) -> bool:
    """Fill the empty ring of a plant; returns False if it cannot keep the rows.

    Args:
        plants: records.
        slot: index of the plant.
        times: see `newest_rows`.
        ring: see `newest_rows`.
        others: see `newest_rows`.
        rows: rows of the plant. The spacing before the first is unknown, and kept as the usual one.
        usual_ns: usual spacing.
    """
    p, times_ns = plants[slot], np.array(rows.times_ns, np.int64)
    bits = np.ascontiguousarray(rows.values).view(np.int64)
    over_ns = np.diff(times_ns) - usual_ns
    p["usual_ns"], p["unit_ns"] = usual_ns, next(unit for unit in UNITS_NS if not np.any(over_ns % unit))
    for k, column in enumerate(bits[:, others.shape[1] :].T):
        p["reference"][k] = column[column != 0][-1:].sum()  # the newest that is not 0
    return bool(_add_rows(plants, slot, times, ring, others, times_ns, bits))


def newest_rows(p: np.void, last_ns: int, times: Places, ring: Bytes, others: Ints) -> NewestRows:
    """The rows that a ring keeps.

    Args:
        p: record of the plant.
        last_ns: time of the newest row.
        times: spacings, shape (rows kept,).
        ring: values, shape (rows kept, bytes).
        others: bits of the inputs at no level, shape (rows kept, inputs).
    """
    count, keeps = int(p["kept"]), len(times)
    order = (int(p["head"]) - count + np.arange(count)) % keeps
    over = times[order].astype(np.int64) * p["unit_ns"] + p["usual_ns"]
    since = np.concatenate([[0], np.cumsum(over[:0:-1])])  # from each row to the newest, newest first
    values = _values(p, ring[order], others[order]) if ring.shape[1] else np.empty((count, 0))
    return NewestRows((last_ns - since)[::-1].tolist(), values)


def _values(p: np.void, rows: Bytes, others: Ints) -> Array:
    """Values of rows, shape (rows, signals)."""
    inputs = others.shape[1]
    whole = np.zeros((len(rows), (rows.shape[1] - inputs) // VALUE_BYTES, 8), np.uint8)
    whole[:, :, 8 - VALUE_BYTES :] = rows[:, inputs:].reshape(len(rows), -1, VALUE_BYTES)
    codes = whole.view("<i8")[:, :, 0] >> 8 * (8 - VALUE_BYTES)  # with its sign
    measured = np.where(codes == ZERO, 0, codes + p["reference"])
    at = rows[:, :inputs]
    held = p["levels"][np.arange(inputs), np.minimum(at, LEVELS - 1)]
    return np.ascontiguousarray(np.column_stack([np.where(at < LEVELS, held, others), measured])).view(np.float64)


def times_ns_of(times_min: Array) -> list[int]:
    """Times of rows, as whole as minutes tell them: in milliseconds if these are they."""
    whole = np.floor(times_min)
    rest_ns = (times_min - whole) * MINUTE_NS
    for unit_ns in UNITS_NS:
        times_ns = [
            int(minute) * MINUTE_NS + round(over / unit_ns) * unit_ns
            for minute, over in zip(whole.tolist(), rest_ns.tolist(), strict=True)
        ]
        if [time_ns / MINUTE_NS for time_ns in times_ns] == times_min.tolist():
            break
    return times_ns
