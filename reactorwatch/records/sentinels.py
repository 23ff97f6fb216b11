"""Values that probably mean "not measured": they repeat exactly, far from all others of their signal."""

import re
from collections.abc import Mapping

import numpy as np

from reactorwatch.arrays import Array

_CODE = re.compile(r"-9+(\.9+)?|999+|-?(32767|32768|65535|2147483647|2147483648|4294967295|1e\+?\d\d|10{9,14})")
"""Nines, limits of integers, large powers of ten; 99 and 99.9 are values of a saturated input, -9 is any number."""

_FEWEST_OTHERS = 10
"""Distinct other values; a signal with fewer may be one of modes, or of steps of an actuator."""


def describe_sentinels(columns: Mapping[str, Array]) -> list[str]:
    """Notes on the probable sentinels of signals, each with the option that excludes it.

    A known code is so far from the other values as these are from each other. Any other value repeats at least three
    times, is 20 times as far and 10 times as large, and none at which sound inputs stand, closed or fully open.

    Args:
        columns: values by signal, as the file has them; NaN: not measured.
    """
    rows: dict[str, list[str]] = {}
    for name, values in columns.items():
        finite = values[np.isfinite(values)]
        if not finite.size or max(np.count_nonzero(finite == end) for end in (finite.min(), finite.max())) < 2:
            continue  # as mostly; sorting takes longer
        found, counts = np.unique(finite, return_counts=True)
        repeated = np.flatnonzero((counts > 1) & (np.abs(found) > 1.0)).tolist()
        codes = [i for i in repeated if found[i] != -9.0 and _CODE.fullmatch(f"{found[i]:.15g}")]
        for i in repeated:
            value, others = float(found[i]), np.delete(found, [i, *codes])
            if others.size < _FEWEST_OTHERS:
                continue
            low, high = float(others[0]), float(others[-1])
            distance, size = max(low - value, value - high), max(abs(low), abs(high))
            is_far = distance > 20.0 * (high - low) and abs(value) > 10.0 * size and counts[i] > 2
            if distance > high - low if i in codes else is_far and abs(value) != 100.0:
                rows.setdefault(f"{value:.15g}", []).append(f"{counts[i]} rows of {name}")
    return [
        f"{value} is probably no measurement but a code, in {', '.join(of)} (--missing {value} excludes it)"
        for value, of in rows.items()
    ]
