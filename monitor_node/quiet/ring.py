"""The newest rows of a plant, as its ring keeps them.

The ring holds when each row came, as the spacing before it: in a unit in which all are whole, and less the usual one,
in 32 bits. (What a search for causes wants of 600 rows is most of what a plant takes.) If that does not fit, as when a
plant whose times are in nanoseconds was away for more than two seconds, it has a monitor until the ring is past it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from monitor_node.quiet.layout import Array
from reactorwatch.records.record import MINUTE_NS

UNITS_NS = (1_000_000, 1_000, 1)
"""In which spacings are kept, the first in which all are whole."""


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


def newest_rows(p: np.void, times: NDArray[np.int32], ring: Array) -> NewestRows:
    """The rows that a ring keeps.

    Args:
        p: record of the plant.
        times: spacings, shape (rows kept,).
        ring: values, shape (rows kept, signals).
    """
    kept, keeps = int(p["kept"]), len(times)
    order = (int(p["head"]) - kept + np.arange(kept)) % keeps
    over = times[order].astype(np.int64) * p["unit_ns"] + p["usual_ns"]
    since = np.concatenate([[0], np.cumsum(over[:0:-1])])  # from each row to the newest, newest first
    return NewestRows((p["last_ns"] - since)[::-1].tolist(), ring[order])


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
