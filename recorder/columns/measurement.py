"""Validity of a sample's value. Pure."""

import math

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.records.record import LARGEST_VALUE

_NO_SAMPLE, _BAD = messages.QUALITY_UNSPECIFIED, messages.QUALITY_BAD


def measured_value(sample: messages.Sample) -> float | None:
    """Measured value of a sample.

    Returns:
        The value; NaN, which counts as not measured, if it is of bad quality, not finite or impossibly large; None if
        the message is no sample, because it lacks the quality that every publisher of this software sets.
    """
    if sample.quality == _NO_SAMPLE:
        return None
    value: float = sample.value
    return value if sample.quality != _BAD and abs(value) < LARGEST_VALUE else math.nan
