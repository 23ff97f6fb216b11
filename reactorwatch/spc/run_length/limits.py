"""What run lengths take and tell."""

from math import isfinite

from reactorwatch.errors import InputError

LARGEST_SHIFT = 100.0
LONGEST = 1e12
"""Run lengths beyond this cannot be told from double precision."""


def checked_shift(shift: float) -> float:
    """The size of the shift.

    Raises:
        InputError: it is not a finite number of at most 100.
    """
    if not (isfinite(shift) and abs(shift) <= LARGEST_SHIFT):
        raise InputError(f"shift must be in [-{LARGEST_SHIFT:g}, {LARGEST_SHIFT:g}] sigma, got {shift}")
    return abs(float(shift))


def within(name: str, value: float, lowest: float, highest: float) -> float:
    """The value.

    Raises:
        InputError: it is not in [lowest, highest].
    """
    if not lowest <= value <= highest:
        raise InputError(f"{name} must be in [{lowest:g}, {highest:g}], got {value}")
    return float(value)


def told(length: float) -> float:
    """The run length.

    Raises:
        InputError: it is beyond 1e12.
    """
    if not length < LONGEST:
        raise InputError(f"the run length must be below {LONGEST:g} samples to be computed; lower the limit")
    return float(length)
