"""The suspects of an alarm in words for people, wherever they are shown."""

from collections.abc import Iterable

from reactorwatch.contract.messages_pb2 import Suspect

WORTH_TELLING = 0.05
"""Probability below which a suspect is not told to people."""

_MINUTE_NS = 60_000_000_000


def suspects_text(suspects: Iterable[Suspect], zero_ns: int | None = None) -> str:
    """The likeliest causes; empty if nothing is known.

    >>> suspects_text([Suspect(cause="coolant_flow", probability=0.93, profile="step", size=-0.1502, unit="1")])
    'coolant_flow (93 %; step of -0.15)'

    Args:
        suspects: of an alarm.
        zero_ns: where minutes start, if onsets are to be told.
    """
    told = []
    for item in suspects:
        if item.probability < WORTH_TELLING:
            continue
        text = f"{item.cause} ({100 * item.probability:.0f} %"
        if item.profile:
            text += f"; {item.profile} of {item.size:.3g}{'' if item.unit == '1' else f' {item.unit}'}"
            if zero_ns is not None:
                text += f" at {(item.onset_ns - zero_ns) / _MINUTE_NS:.1f} min"
        told.append(text + ")")
    return ", ".join(told)
