"""What a sample says was measured. Pure."""

import math

from reactorwatch.contract import messages_pb2 as messages

_NO_SAMPLE, _BAD = messages.QUALITY_UNSPECIFIED, messages.QUALITY_BAD


def measured(sample: messages.Sample) -> float | None:
    """The value that was measured.

    Returns:
        The value; NaN if it is of bad quality or not finite, which counts as not measured; None if the message is no
        sample at all: it lacks the quality that every publisher of ours states.
    """
    if sample.quality == _NO_SAMPLE:
        return None
    value: float = sample.value
    return value if sample.quality != _BAD and math.isfinite(value) else math.nan
