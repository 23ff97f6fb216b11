"""Incidents of a back-test in words: a headline for each, and one line for each alarm."""

from collections.abc import Sequence
from math import inf
from typing import TYPE_CHECKING, NamedTuple

from reactorwatch.contract.messages_pb2 import Alarm, Suspect
from reactorwatch.records.record import format_utc, to_minutes
from reactorwatch.sentences.alarm import describe_suspects, suspects_text

if TYPE_CHECKING:
    from reactorwatch.results.alarms import RaisedAlarm

MOST_INCIDENTS = 10
"""Largest number of incidents in a headline; more are listed below it only."""


class CauseGroup(NamedTuple):
    """Alarms of one incident and one cause.

    An incident groups alarms by time: a plant that was silent, and a fault soon after it, are two groups of one
    incident.

    Attributes:
        raised: the alarms in the order in which they were raised.
        suspect: likeliest cause; None: a check states what it is, or no search has found one.
    """

    raised: list["RaisedAlarm"]
    suspect: Suspect | None

    @property
    def size(self) -> tuple[int, float]:
        """Highest priority, then the time from the first alarm raised to the last one cleared; inf if one is active."""
        end_ns = max(inf if item.cleared_ns is None else item.cleared_ns for item in self.raised)
        return max(item.message.priority for item in self.raised), end_ns - self.raised[0].message.raised_ns

    def describe(self, zero_ns: int, clock_zero_ns: int | None) -> str:
        """Start, cause with its probability, and alarms; arguments as for `headline`."""
        first, suspect = self.raised[0].message, self.suspect
        since_ns = suspect.onset_ns if suspect is not None and suspect.onset_ns else first.raised_ns
        clock = "" if clock_zero_ns is None else f" ({format_utc(since_ns - zero_ns + clock_zero_ns)})"
        named = "" if suspect is None else describe_suspects([suspect])
        what = named or first.text.partition("; ")[0]
        unnamed = "" if named or first.names_cause else ", no cause named"
        count = "1 alarm," if len(self.raised) == 1 else f"{len(self.raised)} alarms, the first"
        since = f"{to_minutes(since_ns, zero_ns):.1f}".removesuffix(".0")
        return f"since {since} min{clock}: {what}{unnamed}; {count} {_when(self.raised[0])}"


def group_by_cause(raised: Sequence["RaisedAlarm"]) -> list[list[CauseGroup]]:
    """Group the alarms of each incident by cause, the largest group first; so are the incidents (`CauseGroup.size`).

    Args:
        raised: alarms in the order in which they were raised.
    """
    incidents = []
    for members in _incidents(raised):
        by_check: dict[str | None, list[RaisedAlarm]] = {}
        for item in members:
            by_check.setdefault(_check(item.message), []).append(item)
        groups = [CauseGroup(items, _cause(items) if name is None else None) for name, items in by_check.items()]
        incidents.append(sorted(groups, key=lambda group: group.size, reverse=True))
    return sorted(incidents, key=lambda groups: groups[0].size, reverse=True)


def headline(
    raised: Sequence["RaisedAlarm"], zero_ns: int, clock_zero_ns: int | None = None, doubt: str = ""
) -> list[str]:
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
        also = ", ".join(_when(group.raised[0]) for group in others)
        text = largest.describe(zero_ns, clock_zero_ns) + (f"; in the same incident {also}" if also else "")
        lines.append(f"{'Raised' if doubt else 'Detected'} {text}")
    more = len(incidents) - MOST_INCIDENTS
    return [*lines, f"and {_count(more, 'smaller incident')}, listed below"] if more > 0 else lines


def alarm_lines(raised: Sequence["RaisedAlarm"], zero_ns: int) -> list[str]:
    """Lines of the alarms; arguments as for `headline`."""
    lines = []
    incidents = _incidents(raised)
    for members in incidents:
        if len(incidents) > 1:
            lines.append(f"incident {members[0].message.incident}, from {members[0].raised_min:g} min")
        names = dict.fromkeys(item.alarm for item in members)
        lines += [_line([item for item in members if item.alarm == name]) for name in names]
        texts = filter(None, (suspects_text(item.message.suspects, zero_ns) for item in members))
        lines.extend(f"  suspect: {text}" for text in dict.fromkeys(texts))
    return lines


def _incidents(raised: Sequence["RaisedAlarm"]) -> list[list["RaisedAlarm"]]:
    """Alarms by incident, in the order of the first alarms."""
    incidents: dict[int, list[RaisedAlarm]] = {}
    for item in raised:
        incidents.setdefault(item.message.incident, []).append(item)
    return [*incidents.values()]


def _check(alarm: Alarm) -> str | None:
    """Name of the signal check that raised an alarm and so states its cause; None: a chart did."""
    return alarm.alarm.partition("/")[0] if alarm.names_cause else None


def _when(item: "RaisedAlarm") -> str:
    return f"{item.alarm} at {item.raised_min:g} min"


def _count(number: int, noun: str) -> str:
    return f"{number or 'no'} {noun}{'' if number == 1 else 's'}"


def _line(times: Sequence["RaisedAlarm"]) -> str:
    """Line of one alarm of an incident, which may have been raised several times."""
    first, cleared_min = times[0], times[-1].cleared_min
    often = "" if len(times) == 1 else f", raised {len(times)} times"
    end = "active at the end" if cleared_min is None else f"cleared at {cleared_min:g} min"
    return f"  {first.raised_min:9g} min  {first.alarm} ({first.priority}){often}, {end}: {first.message.text}"


def _cause(raised: Sequence["RaisedAlarm"]) -> Suspect | None:
    """Likeliest cause of a group, by the last search that found one of the catalogue; else by the last search."""
    searched = [item.message for item in raised if item.message.suspects]
    named = [alarm for alarm in searched if alarm.suspects[0].text]
    return next((alarm.suspects[0] for alarm in reversed(named or searched)), None)
