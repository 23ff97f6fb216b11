"""Alarms of a back-test as lines for people: by incident, one line for each alarm."""

from collections.abc import Sequence

from reactorwatch.contract.alarm_text import describe_suspects, priority_word, suspects_text
from reactorwatch.contract.messages_pb2 import Alarm
from reactorwatch.records.record import format_utc, to_minutes

Raised = tuple[Alarm, int | None]
"""An alarm that was raised, and when it was cleared; None: it is active at the end."""


def alarm_headline(raised: Sequence[Raised], zero_ns: int, clock_zero_ns: int | None = None) -> str:
    """First alarm, number of alarms and incidents, and the likeliest causes; empty without an alarm.

    Args:
        raised: alarms in the order in which they were raised.
        zero_ns: time from which minutes are counted.
        clock_zero_ns: clock time of that time; None: unknown.
    """
    if not raised:
        return ""
    first = raised[0][0]
    incidents = len({alarm.incident for alarm, _ in raised})
    count = f"{_count(len(raised), 'alarm')} in {_count(incidents, 'incident')}"
    cause = _cause([alarm for alarm, _ in raised if alarm.incident == first.incident])
    named = f"; likely cause: {cause}" if cause else ""
    clock = "" if clock_zero_ns is None else f" ({format_utc(first.raised_ns - zero_ns + clock_zero_ns)})"
    return f"Detected at {to_minutes(first.raised_ns, zero_ns):g} min{clock} by {first.alarm}: {count}{named}"


def alarm_lines(raised: Sequence[Raised], zero_ns: int) -> list[str]:
    """Lines of the alarms; arguments as for `alarm_headline`."""
    lines = []
    for incident in dict.fromkeys(alarm.incident for alarm, _ in raised):
        members = [item for item in raised if item[0].incident == incident]
        if len({alarm.incident for alarm, _ in raised}) > 1:
            lines.append(f"incident {incident}, from {to_minutes(members[0][0].raised_ns, zero_ns):g} min")
        names = dict.fromkeys(alarm.alarm for alarm, _ in members)
        lines += [_line([item for item in members if item[0].alarm == name], zero_ns) for name in names]
        texts = filter(None, (suspects_text(alarm.suspects, zero_ns) for alarm, _ in members))
        lines.extend(f"  suspect: {text}" for text in dict.fromkeys(texts))
    return lines


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _line(times: Sequence[Raised], zero_ns: int) -> str:
    """Line of one alarm of an incident, which may have been raised several times."""
    (alarm, _), (_, cleared_ns) = times[0], times[-1]
    often = "" if len(times) == 1 else f", raised {len(times)} times"
    end = "active at the end" if cleared_ns is None else f"cleared at {to_minutes(cleared_ns, zero_ns):g} min"
    minute = f"{to_minutes(alarm.raised_ns, zero_ns):9g} min"
    return f"  {minute}  {alarm.alarm} ({priority_word(alarm.priority)}){often}, {end}: {alarm.text}"


def _cause(alarms: Sequence[Alarm]) -> str:
    """Likeliest cause of an incident, by the last search that found one of the catalogue; else by the last search."""
    searched = [alarm for alarm in alarms if alarm.suspects]
    named = [alarm for alarm in searched if alarm.suspects[0].text]
    latest = (named or searched)[-1:]
    return describe_suspects(latest[0].suspects[:1]) if latest else ""
