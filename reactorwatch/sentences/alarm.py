"""Alarms and their suspects in words; a number that this version has no word for is shown as it is."""

from collections.abc import Iterable
from datetime import UTC, datetime

from reactorwatch.contract.messages_pb2 import AlarmState, Priority, Suspect

MIN_PROBABILITY = 0.05
"""Probability below which a suspect is not shown."""

_MINUTE_NS = 60_000_000_000  # not of `records.record`, whose NumPy takes longer to import than a command to answer


def describe_suspects(suspects: Iterable[Suspect]) -> str:
    """Likeliest causes of an alarm in words, with their probabilities; empty if there are none.

    >>> lost = Suspect(cause="coolant_flow", probability=0.93, text="15 % of the coolant lost")
    >>> describe_suspects([lost, Suspect(cause="feed_flow", probability=0.06)])
    '15 % of the coolant lost (93 %), feed flow (6 %)'
    """
    shown = (item for item in suspects if item.probability >= MIN_PROBABILITY)
    return ", ".join(describe_suspect(item.cause, item.probability, item.text) for item in shown)


def describe_suspect(cause: str, probability: float, text: str) -> str:
    """A cause in words, with its probability."""
    return f"{text or cause.replace('_', ' ')} ({100 * probability:.0f} %)"


def suspects_text(suspects: Iterable[Suspect], zero_ns: int | None = None) -> str:
    """Likeliest causes with their sizes in words where they have some, profiles and onsets; empty if there are none.

    >>> step = Suspect(cause="coolant_flow", probability=0.93, profile="step", size=-0.1502, unit="1")
    >>> suspects_text([step])
    'coolant_flow (93 %; step of -0.15)'
    >>> step.text = "15 % of the coolant lost"
    >>> suspects_text([step])
    '15 % of the coolant lost (93 %; coolant_flow, step)'

    Args:
        suspects: the suspects of an alarm.
        zero_ns: time from which the minutes of onsets are counted; None: without onsets.
    """
    texts = []
    for item in suspects:
        if item.probability < MIN_PROBABILITY:
            continue
        details = [item.cause] if item.text else []
        if item.profile:
            size = "" if item.text else f" of {item.size:.3g}{'' if item.unit == '1' else f' {item.unit}'}"
            onset = "" if zero_ns is None else f" at {(item.onset_ns - zero_ns) / _MINUTE_NS:.1f} min"
            details.append(f"{item.profile}{size}{onset}")
        probability = f"{100 * item.probability:.0f} %"
        texts.append(f"{item.text or item.cause} ({'; '.join(filter(None, (probability, ', '.join(details))))})")
    return ", ".join(texts)


def priority_word(priority: int) -> str:
    """Word of a priority.

    >>> priority_word(Priority.PRIORITY_HIGH), priority_word(99)
    ('high', '99')
    """
    known = priority in Priority.values()
    return Priority.Name(priority).removeprefix("PRIORITY_").lower() if known else str(priority)


def state_word(state: int) -> str:
    """Words of an alarm's state.

    >>> state_word(AlarmState.ALARM_STATE_RETURNED_UNACKNOWLEDGED), state_word(99)
    ('returned unacknowledged', '99')
    """
    known = state in AlarmState.values()
    return AlarmState.Name(state).removeprefix("ALARM_STATE_").lower().replace("_", " ") if known else str(state)


def format_moment(time_ns: int) -> str:
    """Format a time in UTC.

    >>> format_moment(1_772_352_000_250_000_000), format_moment(10**21)
    ('2026-03-01 08:00:00 UTC', '1000000000000000000000 ns')
    """
    try:
        return datetime.fromtimestamp(time_ns // 1_000_000_000, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    except (OverflowError, ValueError, OSError):
        return f"{time_ns} ns"
