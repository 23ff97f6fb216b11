"""Local times of a zone to UTC, a change to or from summer time inside the record included."""

from collections.abc import Callable
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError
from reactorwatch.records.timestamps import fixed_offset_s

HOUR_NS = 3_600_000_000_000


def to_utc(local_ns: NDArray[np.int64], zone: str, refuse: Callable[[int, str], NoReturn]) -> NDArray[np.int64]:
    """Convert local times to UTC.

    When the clock is set back, local times of an hour occur twice. Rows up to the step back are summer time, those
    after it winter time; without a step back, the rows join the neighbour that they fit without a gap.

    Args:
        local_ns: nanoseconds since 1970 on the local clock, shape (rows,).
        zone: name of the zone, or a fixed offset.
        refuse: raises the error for a row and a rule.

    Returns:
        Nanoseconds since 1970 UTC, shape (rows,).

    Raises:
        InputError: the system does not know the zone.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    offset_s = fixed_offset_s(zone)
    if offset_s is not None:
        return local_ns - offset_s * 1_000_000_000
    local = pa.array(local_ns).cast(pa.timestamp("ns"))
    try:
        early, late = (
            np.array(pc.assume_timezone(local, zone, ambiguous=side, nonexistent=side).cast(pa.int64()))
            for side in ("earliest", "latest")
        )
    except pa.ArrowInvalid as error:
        raise InputError(
            f"--zone {zone}: is not in this system's database of time zones; install tzdata, or state an offset"
        ) from error
    skipped = np.flatnonzero(late - early == 1)  # 1 ns before the step, and just after it
    if skipped.size:
        refuse(
            int(skipped[0]),
            f"expected a time that exists in {zone}, where clocks are set forward then (--zone UTC or +01:00, "
            "if this clock knows no summer time)",
        )
    twice = np.flatnonzero(late > early)
    for stretch in np.split(twice, np.flatnonzero(np.diff(twice) > 1) + 1) if twice.size else ():
        first, end = int(stretch[0]), int(stretch[-1]) + 1
        steps = np.diff(local_ns[first:end])  # among several, one of 0 is a duplicate row
        back = np.flatnonzero((steps < 0) | ((steps == 0) & (steps.size == 1)))
        if back.size:
            second = first + int(back[0]) + 1
            early[second:end] = late[second:end]
            continue
        gaps = []
        for times in (early, late):
            before = times[first] - early[first - 1] if first else 0
            after = early[end] - times[end - 1] if end < early.size else 0
            gaps.append(max(before, after))
        if gaps[0] == gaps[1]:
            refuse(
                first,
                f"expected a time that is unique in {zone}, where this hour occurs twice and the rows fit both "
                "(--zone +01:00, for instance, states the offset)",
            )
        if gaps[0] > gaps[1]:
            early[first:end] = late[first:end]
    return early
