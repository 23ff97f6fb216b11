"""Suspects that an incident gives its alarms, and which of them are new."""

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType

from reactorwatch.contract.messages_pb2 import Alarm, Suspect

MAX_INCIDENTS = 1000
"""Incidents whose suspects are remembered; few change after others have begun."""


def set_suspects(alarm: Alarm, suspects: Iterable[Suspect]) -> None:
    """Replace the suspects of an alarm, as by those that its incident has now."""
    del alarm.suspects[:]
    alarm.suspects.extend(suspects)


class NewSuspects:
    """Tells incidents with new suspects from those that repeat theirs, as after a restart of a monitor.

    Args:
        suspects: suspects of incidents that were published before, by number of the incident.
    """

    def __init__(self, suspects: Mapping[int, Sequence[Suspect]] = MappingProxyType({})) -> None:
        self._suspects = {number: list(items) for number, items in suspects.items()}

    def update(self, number: int, suspects: Sequence[Suspect]) -> bool:
        """True if an incident has suspects, and other ones than before."""
        if not suspects:
            return False
        before, self._suspects[number] = self._suspects.pop(number, None), list(suspects)
        if len(self._suspects) > MAX_INCIDENTS:
            del self._suspects[next(iter(self._suspects))]  # the one that was published longest ago
        return self._suspects.get(number) != before
