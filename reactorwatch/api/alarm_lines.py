"""Alarms of a back-test as lines for people: a headline for each incident, and one line for each alarm."""

from collections.abc import Sequence
from math import inf
from typing import NamedTuple

from monitor_node.checks.signal_checks import CHECKS
from reactorwatch.contract.alarm_text import describe_suspects, priority_word, suspects_text
from reactorwatch.contract.messages_pb2 import Alarm, Suspect
from reactorwatch.records.record import format_utc, to_minutes

Raised = tuple[Alarm, int | None]
"""An alarm that was raised, and when it was cleared; None: it is active at the end."""

MOST_INCIDENTS = 10
"""Largest number of incidents in a headline; more are listed below it only."""

_CHECKS = frozenset(check.name for check in CHECKS)


class CauseGroup(NamedTuple):
    """Alarms of one incident and one cause.

    An incident groups alarms by time: a plant that was silent, and a fault soon after it, are two groups of one
    incident.

    Attributes:
        raised: the alarms in the order in which they were raised.
        suspect: likeliest cause; None: a check states what it is, or no search has found one.
    """

    raised: list[Raised]
    suspect: Suspect | None

    @property
    def size(self) -> tuple[int, float]:
        """Highest priority, then the time from the first alarm raised to the last one cleared; inf if one is active."""
        end_ns = max(inf if cleared_ns is None else cleared_ns for _, cleared_ns in self.raised)
        return max(alarm.priority for alarm, _ in self.raised), end_ns - self.raised[0][0].raised_ns

    def describe(self, zero_ns: int, clock_zero_ns: int | None) -> str:
        """Start, cause with its probability, and alarms; arguments as for `headline`."""
        first, suspect = self.raised[0][0], self.suspect
        since_ns = suspect.onset_ns if suspect is not None and suspect.onset_ns else first.raised_ns
        clock = "" if clock_zero_ns is None else f" ({format_utc(since_ns - zero_ns + clock_zero_ns)})"
        named = "" if suspect is None else describe_suspects([suspect])
        what = named or first.text.partition("; ")[0]
        unnamed = "" if named or _check(first) else ", no cause named"
        count = "1 alarm," if len(self.raised) == 1 else f"{len(self.raised)} alarms, the first"
        since = f"{to_minutes(since_ns, zero_ns):.1f}".removesuffix(".0")
        return f"since {since} min{clock}: {what}{unnamed}; {count} {_when(first, zero_ns)}"


def group_by_cause(raised: Sequence[Raised]) -> list[list[CauseGroup]]:
    """Group the alarms of each incident by cause, the largest group first; so are the incidents (`CauseGroup.size`).

    Args:
        raised: alarms in the order in which they were raised.
    """
    incidents = []
    for members in _incidents(raised):
        by_check: dict[str | None, list[Raised]] = {}
        for item in members:
            by_check.setdefault(_check(item[0]), []).append(item)
        groups = [CauseGroup(items, _cause(items) if name is None else None) for name, items in by_check.items()]
        incidents.append(sorted(groups, key=lambda group: group.size, reverse=True))
    return sorted(incidents, key=lambda groups: groups[0].size, reverse=True)


def headline(raised: Sequence[Raised], zero_ns: int, clock_zero_ns: int | None = None, doubt: str = "") -> list[str]:
    """Doubts about the result, then a line for each incident, the largest first: what it is, since when, how sure.

    Args:
        raised: alarms in the order in which they were raised.
        zero_ns: time from which minutes are counted.
        clock_zero_ns: clock time of that time; None: unknown.
        doubt: reason why alarms are no detections; empty: they are.
    """
    incidents = group_by_cause(raised)
    count = f"{_count(len(raised), 'alarm')} {'was' if len(raised) == 1 else 'were'} raised"
    where = f" in {_count(len(incidents), 'incident')}" if incidents else ""
    lines = [f"{doubt}; {count}{where}"] if doubt else [] if raised else ["no alarms"]
    for largest, *others in incidents[:MOST_INCIDENTS]:
        also = ", ".join(_when(group.raised[0][0], zero_ns) for group in others)
        text = largest.describe(zero_ns, clock_zero_ns) + (f"; in the same incident {also}" if also else "")
        lines.append(f"{'Raised' if doubt else 'Detected'} {text}")
    more = len(incidents) - MOST_INCIDENTS
    return [*lines, f"and {_count(more, 'smaller incident')}, listed below"] if more > 0 else lines


def alarm_lines(raised: Sequence[Raised], zero_ns: int) -> list[str]:
    """Lines of the alarms; arguments as for `headline`."""
    lines = []
    incidents = _incidents(raised)
    for members in incidents:
        first = members[0][0]
        if len(incidents) > 1:
            lines.append(f"incident {first.incident}, from {to_minutes(first.raised_ns, zero_ns):g} min")
        names = dict.fromkeys(alarm.alarm for alarm, _ in members)
        lines += [_line([item for item in members if item[0].alarm == name], zero_ns) for name in names]
        texts = filter(None, (suspects_text(alarm.suspects, zero_ns) for alarm, _ in members))
        lines.extend(f"  suspect: {text}" for text in dict.fromkeys(texts))
    return lines


def _incidents(raised: Sequence[Raised]) -> list[list[Raised]]:
    """Alarms by incident, in the order of the first alarms."""
    incidents: dict[int, list[Raised]] = {}
    for item in raised:
        incidents.setdefault(item[0].incident, []).append(item)
    return [*incidents.values()]


def _check(alarm: Alarm) -> str | None:
    """Name of the signal check that raised an alarm and so states its cause; None: a chart did."""
    name = alarm.alarm.partition("/")[0]
    return name if name in _CHECKS else None


def _when(alarm: Alarm, zero_ns: int) -> str:
    return f"{alarm.alarm} at {to_minutes(alarm.raised_ns, zero_ns):g} min"


def _count(number: int, noun: str) -> str:
    return f"{number or 'no'} {noun}{'' if number == 1 else 's'}"


def _line(times: Sequence[Raised], zero_ns: int) -> str:
    """Line of one alarm of an incident, which may have been raised several times."""
    (alarm, _), (_, cleared_ns) = times[0], times[-1]
    often = "" if len(times) == 1 else f", raised {len(times)} times"
    end = "active at the end" if cleared_ns is None else f"cleared at {to_minutes(cleared_ns, zero_ns):g} min"
    minute = f"{to_minutes(alarm.raised_ns, zero_ns):9g} min"
    return f"  {minute}  {alarm.alarm} ({priority_word(alarm.priority)}){often}, {end}: {alarm.text}"


def _cause(raised: Sequence[Raised]) -> Suspect | None:
    """Likeliest cause of an group, by the last search that found one of the catalogue; else by the last search."""
    searched = [alarm for alarm, _ in raised if alarm.suspects]
    named = [alarm for alarm in searched if alarm.suspects[0].text]
    return next((alarm.suspects[0] for alarm in reversed(named or searched)), None)
