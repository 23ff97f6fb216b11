"""Text of an alarm's suspects for people."""

from collections.abc import Iterable

from reactorwatch.contract.messages_pb2 import Suspect

MIN_PROBABILITY = 0.05
"""Probability below which a suspect is not shown."""

_MINUTE_NS = 60_000_000_000


def suspects_text(suspects: Iterable[Suspect], zero_ns: int | None = None) -> str:
    """Format the likeliest causes; empty if there are none.

    >>> suspects_text([Suspect(cause="coolant_flow", probability=0.93, profile="step", size=-0.1502, unit="1")])
    'coolant_flow (93 %; step of -0.15)'

    Args:
        suspects: the suspects of an alarm.
        zero_ns: time from which the minutes of onsets are counted; None: without onsets.
    """
    texts = []
    for item in suspects:
        if item.probability < MIN_PROBABILITY:
            continue
        text = f"{item.cause} ({100 * item.probability:.0f} %"
        if item.profile:
            text += f"; {item.profile} of {item.size:.3g}{'' if item.unit == '1' else f' {item.unit}'}"
            if zero_ns is not None:
                text += f" at {(item.onset_ns - zero_ns) / _MINUTE_NS:.1f} min"
        texts.append(text + ")")
    return ", ".join(texts)
