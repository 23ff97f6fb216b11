"""Newest rows of a plant, compressed in a ring without loss.

The 600 rows for isolation are most of the memory of a plant.

The ring holds when each row came, as the spacing before it: in a unit in which all are whole, and less the usual one,
in 32 bits. If that does not fit, as when a plant whose times are in nanoseconds was away for more than two seconds, it
has a monitor until the ring is past it. Of a plant whose rows come evenly all are zero, and memory that never held
anything else takes no room (see `slots`).

What was measured is kept in seven bytes: the 64 bits of its number, less those of a value that the signal had before.
That fits as long as values are of one sign and within a factor of 200 of that one, and it fits for zero, which has a
code of its own.

An input is mostly one of a few values, at which it is held for some rows each: one byte tells which of those that the
kept rows have, as far as there are no more than `LEVELS`. One that is none of them, as under a controller, is kept as
it is, in an array that takes memory only where that happened.
"""

from typing import NamedTuple

import numpy as np

from monitor_node.fleet.packed.record import LEVELS, Array, Bytes, Ints, Places
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


def kept_spacings(times_ns: list[int], usual_ns: int) -> tuple[int, Places] | None:
    """Spacings of rows as the ring keeps them, and their unit; None if they do not fit.

    Args:
        times_ns: times of the rows; before the first the spacing is unknown, and kept as the usual one.
        usual_ns: usual spacing.
    """
    over = np.diff(times_ns, prepend=times_ns[0] - usual_ns) - usual_ns
    unit_ns = next(unit for unit in UNITS_NS if not np.any(over % unit))
    kept = over // unit_ns
    return None if np.any(np.abs(kept) >= 2**31) else (unit_ns, kept.astype(np.int32))


class Kept(NamedTuple):
    """Values as they are kept; n rows of u inputs and s - u outputs.

    Attributes:
        rows: the level of each input, then the outputs, shape (n, bytes).
        reference: bits of the values from which outputs are kept as differences, shape (s - u,).
        levels: bits of the values of each input, shape (u, LEVELS).
        level_rows: number of rows at each of them, shape (u, LEVELS).
        others: bits of each input where it is at none of them, shape (n, u).
    """

    rows: Bytes
    reference: Ints
    levels: Ints
    level_rows: Places
    others: Ints


def row_bytes(columns: int, inputs: int) -> int:
    """Size of a row in bytes.

    Args:
        columns: number of its values; 0 if they are not kept.
        inputs: number of inputs among them.
    """
    return inputs + VALUE_BYTES * (columns - inputs) if columns else 0


def kept_values(values: Array, inputs: int) -> Kept | None:
    """Values as they are kept; None if they do not fit.

    Args:
        values: inputs first, shape (rows, signals).
        inputs: number of inputs.
    """
    bits = np.ascontiguousarray(values).view(np.int64)
    levels, level_rows = np.zeros((inputs, LEVELS), np.int64), np.zeros((inputs, LEVELS), np.int32)
    if not values.shape[1]:
        none = np.empty((len(values), 0), np.uint8)
        return Kept(none, bits[0, :0], levels, level_rows, np.empty((0, inputs), np.int64))
    measured = bits[:, inputs:]
    last = [column[np.flatnonzero(column)[-1:]] for column in measured.T]
    reference = np.array([each[0] if each.size else 0 for each in last], dtype=np.int64)
    codes = np.where(measured == 0, ZERO, measured - reference)
    if np.any((measured != 0) & ((codes <= ZERO) | (codes >= -ZERO))):
        return None
    whole = np.ascontiguousarray(codes.astype("<i8")).view(np.uint8).reshape(*codes.shape, 8)
    at = np.empty((len(values), inputs), np.uint8)
    for i in range(inputs):
        found, which, counts = np.unique(bits[:, i], return_inverse=True, return_counts=True)
        most = np.argsort(-counts, kind="stable")[:LEVELS]
        levels[i, : most.size], level_rows[i, : most.size] = found[most], counts[most]
        index = np.full(found.size, LEVELS, np.uint8)
        index[most] = np.arange(most.size)
        at[:, i] = index[which]
    rows = np.column_stack([at, whole[:, :, :VALUE_BYTES].reshape(len(values), -1)])
    return Kept(rows, reference, levels, level_rows, np.where(at == LEVELS, bits[:, :inputs], 0))


def values_of(kept: Kept) -> Array:
    """The values that are kept, shape (rows, signals)."""
    rows, count = kept.rows, len(kept.levels)
    if not rows.shape[1]:
        return np.empty((len(rows), 0))
    whole = np.zeros((len(rows), (rows.shape[1] - count) // VALUE_BYTES, 8), np.uint8)
    whole[:, :, 8 - VALUE_BYTES :] = rows[:, count:].reshape(len(rows), -1, VALUE_BYTES)
    codes = whole.view("<i8")[:, :, 0] >> 8 * (8 - VALUE_BYTES)  # with its sign
    measured = np.where(codes == ZERO, 0, codes + kept.reference)
    at = rows[:, :count]
    held = kept.levels[np.arange(count), np.minimum(at, LEVELS - 1)]
    inputs = np.where(at < LEVELS, held, kept.others)
    return np.ascontiguousarray(np.column_stack([inputs, measured])).view(np.float64)


def newest_rows(p: np.void, last_ns: int, times: Places, ring: Bytes, others: Ints) -> NewestRows:
    """The rows that a ring keeps.

    Args:
        p: record of the plant.
        last_ns: time of the newest row.
        times: spacings, shape (rows kept,).
        ring: values, shape (rows kept, bytes).
        others: inputs at no level, shape (rows kept, inputs).
    """
    count, keeps = int(p["kept"]), len(times)
    order = (int(p["head"]) - count + np.arange(count)) % keeps
    over = times[order].astype(np.int64) * p["unit_ns"] + p["usual_ns"]
    at_no_level = others[order] if others.size else others
    kept = Kept(ring[order], p["reference"], p["levels"], p["level_rows"], at_no_level)
    since = np.concatenate([[0], np.cumsum(over[:0:-1])])  # from each row to the newest, newest first
    return NewestRows((last_ns - since)[::-1].tolist(), values_of(kept))


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
