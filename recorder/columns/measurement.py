"""What a sample says was measured. Pure."""

import math

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.records.record import LARGEST_VALUE

_NO_SAMPLE, _BAD = messages.QUALITY_UNSPECIFIED, messages.QUALITY_BAD


def measured(sample: messages.Sample) -> float | None:
    """The value that was measured.

    Returns:
        The value; NaN if it is of bad quality, not finite or larger than any value can be, which counts as not
        measured; None if the message is no
        sample at all: it lacks the quality that every publisher of ours states.
    """
    if sample.quality == _NO_SAMPLE:
        return None
    value: float = sample.value
    return value if sample.quality != _BAD and abs(value) < LARGEST_VALUE else math.nan
