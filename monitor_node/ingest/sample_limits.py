"""Limits of usable samples."""

from math import isfinite

from reactorwatch.contract.messages_pb2 import Quality, Sample
from reactorwatch.records.record import LARGEST_VALUE as LARGEST_VALUE

LARGEST_SAMPLE = 1000
"""Bytes. A sample takes some thirty and its unit; a larger payload is not decoded."""

LARGEST_NUMBER = 2**62
"""Limit of sequence numbers and of times in ns (146 years from 1970): sums of them must still fit into a message."""

USABLE = frozenset({Quality.QUALITY_GOOD, Quality.QUALITY_UNCERTAIN})
"""Qualities of samples that are used."""


def reject_reason(signal: str, sample: Sample) -> tuple[str, str]:
    """Reason to reject a sample, and a description of it."""
    if sample.quality == Quality.QUALITY_UNSPECIFIED:
        return "payload", f"{signal}: the sample has no quality, so it is no Sample of reactorwatch"
    if not isfinite(sample.value):
        return "not_finite", f"{signal} is {sample.value} at {sample.time_ns} ns"
    if sample.quality == Quality.QUALITY_BAD:
        return "bad_quality", f"{signal} is marked bad at {sample.time_ns} ns"
    if sample.quality not in USABLE:
        return "bad_quality", f"{signal} has the quality {sample.quality}, which this version does not know"
    return "out_of_range", f"{signal} is {sample.value} at {sample.time_ns} ns: sizes must be below {LARGEST_VALUE:g}"
