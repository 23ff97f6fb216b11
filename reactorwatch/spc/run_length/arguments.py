"""Checks of arguments and results of run lengths."""

from math import isfinite

from reactorwatch.errors import InputError

LARGEST_SHIFT = 100.0
LONGEST = 1e12
"""Longest run length that double precision resolves."""


def shift_size(shift: float) -> float:
    """Size of a shift.

    Raises:
        InputError: it is not a finite number of at most 100.
    """
    if not (isfinite(shift) and abs(shift) <= LARGEST_SHIFT):
        raise InputError(f"shift must be in [-{LARGEST_SHIFT:g}, {LARGEST_SHIFT:g}] sigma, got {shift}")
    return abs(float(shift))


def check_range(name: str, value: float, lowest: float, highest: float) -> float:
    """Check a range; returns the value.

    Raises:
        InputError: it is not in [lowest, highest].
    """
    if not lowest <= value <= highest:
        raise InputError(f"{name} must be in [{lowest:g}, {highest:g}], got {value}")
    return float(value)


def check_length(length: float) -> float:
    """Check a run length; returns it.

    Raises:
        InputError: it is beyond 1e12.
    """
    if not length < LONGEST:
        raise InputError(f"the run length must be below {LONGEST:g} samples to be computed; lower the limit")
    return float(length)
