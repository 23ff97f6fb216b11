"""The newest rows of a plant, as its ring keeps them.

What a search for causes wants of 600 rows is most of what a plant takes, so they are kept as small as they go without
the loss of a bit.

The ring holds when each row came, as the spacing before it: in a unit in which all are whole, and less the usual one,
in 32 bits. If that does not fit, as when a plant whose times are in nanoseconds was away for more than two seconds, it
has a monitor until the ring is past it. Of a plant whose rows come evenly all are zero, and memory that never held
anything else takes no room (see `slots`).

A value is kept in seven bytes: the 64 bits of its number, less those of a value that the signal had before. That fits
as long as values are of one sign and within a factor of 200 of that one, and it fits for zero, which has a code of its
own.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from monitor_node.quiet.layout import Array, Bytes, Ints
from reactorwatch.records.record import MINUTE_NS

UNITS_NS = (1_000_000, 1_000, 1)
"""In which spacings are kept, the first in which all are whole."""


VALUE_BYTES = 7
ZERO = -(2 ** (8 * VALUE_BYTES - 1))
"""The code of zero; those of other values are above it, and below its negative."""


class NewestRows(NamedTuple):
    """The newest rows of a plant, oldest first.

    Attributes:
        times_ns: of each.
        values: of each, input first, shape (rows, signals); without columns if they are not kept.
    """

    times_ns: list[int]
    values: Array


def kept_spacings(times_ns: list[int], usual_ns: int) -> tuple[int, NDArray[np.int32]] | None:
    """The spacings of rows as the ring keeps them, and the unit that they are in; None if they do not fit.

    Args:
        times_ns: of the rows; of the first no spacing is known, which is kept as the usual one.
        usual_ns: the usual spacing.
    """
    over = np.diff(times_ns, prepend=times_ns[0] - usual_ns) - usual_ns
    unit_ns = next(unit for unit in UNITS_NS if not np.any(over % unit))
    kept = over // unit_ns
    return None if np.any(np.abs(kept) >= 2**31) else (unit_ns, kept.astype(np.int32))


def reference_bits(values: Array) -> Ints:
    """The bits that values are kept as what they are more than: of each signal's last one that is not zero.

    Args:
        values: shape (rows, signals).
    """
    bits = np.ascontiguousarray(values).view(np.int64)
    return np.array([column[np.flatnonzero(column)[-1]] if column.any() else 0 for column in bits.T], dtype=np.int64)


def kept_values(values: Array, reference: Ints) -> Bytes | None:
    """Values as the ring keeps them, shape (rows, bytes); None if they do not fit.

    Args:
        values: shape (rows, signals).
        reference: see `reference_bits`.
    """
    bits = np.ascontiguousarray(values).view(np.int64)
    codes = np.where(bits == 0, ZERO, bits - reference)
    if np.any((bits != 0) & ((codes <= ZERO) | (codes >= -ZERO))):
        return None
    whole = np.ascontiguousarray(codes.astype("<i8")).view(np.uint8).reshape(*values.shape, 8)
    return np.ascontiguousarray(whole[:, :, :VALUE_BYTES]).reshape(len(values), -1)


def values_of(kept: Bytes, reference: Ints) -> Array:
    """The values that are kept, shape (rows, signals)."""
    whole = np.zeros((len(kept), kept.shape[1] // VALUE_BYTES, 8), np.uint8)
    whole[:, :, 8 - VALUE_BYTES :] = kept.reshape(len(kept), -1, VALUE_BYTES)
    codes = whole.view("<i8")[:, :, 0] >> 8 * (8 - VALUE_BYTES)  # with its sign
    return np.where(codes == ZERO, 0, codes + reference[: codes.shape[1]]).astype(np.int64).view(np.float64)


def newest_rows(p: np.void, times: NDArray[np.int32], ring: Bytes) -> NewestRows:
    """The rows that a ring keeps.

    Args:
        p: record of the plant.
        times: spacings, shape (rows kept,).
        ring: values, shape (rows kept, bytes).
    """
    kept, keeps = int(p["kept"]), len(times)
    order = (int(p["head"]) - kept + np.arange(kept)) % keeps
    over = times[order].astype(np.int64) * p["unit_ns"] + p["usual_ns"]
    since = np.concatenate([[0], np.cumsum(over[:0:-1])])  # from each row to the newest, newest first
    return NewestRows((p["last_ns"] - since)[::-1].tolist(), values_of(ring[order], p["reference"]))


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
