"""Group alarms into incidents: one fault is one incident, not twenty alarms.

A fault raises the most sensitive alarm first, then others, and some of them are cleared and raised again while it
lasts. So an alarm activated within `incident_min` of the last change (raised or cleared) of an alarm of the latest
incident belongs to that incident. A later alarm, or an earlier one because the plant's clock was set back, starts a new
incident. Its first alarm is the first-out alarm (ISA-18.1), the one to look at first.

The window counts from the last change, and not from the last clearing: an alarm that has been active alone for days
does not make every new fault part of its incident. A spike starts no incident while an alarm without a known cause is
active: it joins the latest one.
"""

from typing import Annotated, TypeAlias

import msgspec

from reactorwatch.records.record import MINUTE_NS

Count: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
"""A count that fits into a message."""


class Incident(msgspec.Struct, forbid_unknown_fields=True):
    """The latest incident.

    Attributes:
        number: number of the incident from 1; 0 before the first.
        first_in: name of the first-out alarm.
        changed_ns: time when an alarm of the incident was last raised or cleared.
    """

    number: Count = 0
    first_in: str = ""
    changed_ns: int = 0


class Incidents:
    """Assigns activated alarms to incidents.

    Args:
        incident_min: minutes after the last change of an incident in which an alarm still belongs to it.

    Attributes:
        state: the latest incident.
    """

    def __init__(self, incident_min: float) -> None:
        self._window_ns = int(incident_min * MINUTE_NS)
        self.state = Incident()

    def assign(self, time_ns: int, alarm: str, *, joins: bool = False) -> int:
        """Assign an activated alarm to an incident; returns the incident's number.

        Args:
            time_ns: time of the row.
            alarm: name of the alarm.
            joins: True if the alarm joins the latest incident, however old, without changing it.
        """
        latest = self.state
        if joins and latest.number:
            return latest.number
        if not (latest.number and 0 <= time_ns - latest.changed_ns <= self._window_ns):
            latest.number, latest.first_in = latest.number + 1, alarm
        latest.changed_ns = time_ns
        return latest.number

    def on_cleared(self, time_ns: int, number: int) -> None:
        """Record that an alarm of an incident was cleared."""
        if number and number == self.state.number:
            self.state.changed_ns = time_ns
