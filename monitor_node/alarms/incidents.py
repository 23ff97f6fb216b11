"""Which alarms belong together: one fault is one incident, not twenty alarms.

A fault raises the alarm that feels it first, then others, and some of them come and go while it lasts. So an alarm that
comes up within `incident_min` of the last change (raised or cleared) of an alarm of the latest incident belongs to that
incident; later, or at an earlier time because the plant's clock was set back, it begins a new one. The alarm that
begins it is its first-in alarm, the one to look at first.

The window counts from the last change, and not from the last clearing: an alarm that has stood alone for days does not
make every new fault part of its incident. A spike begins no incident while an alarm stands whose cause is not known: it
belongs to the latest one.
"""

from typing import Annotated, TypeAlias

import msgspec

from reactorwatch.records.record import MINUTE_NS

Count: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
"""A number that messages can carry."""


class Incident(msgspec.Struct, forbid_unknown_fields=True):
    """The latest incident.

    Attributes:
        number: counted from 1; 0: there was none yet.
        first_in: name of the alarm that began it.
        changed_ns: when an alarm of it was last raised or cleared.
    """

    number: Count = 0
    first_in: str = ""
    changed_ns: int = 0


class Incidents:
    """Gives alarms that come up their incident.

    Args:
        incident_min: how long after the last change of an incident an alarm still belongs to it, in minutes.

    Attributes:
        state: the latest incident.
    """

    def __init__(self, incident_min: float) -> None:
        self._window_ns = int(incident_min * MINUTE_NS)
        self.state = Incident()

    def came_up(self, time_ns: int, alarm: str, *, joins: bool = False) -> int:
        """Number of the incident that an alarm which comes up now belongs to.

        Args:
            time_ns: of the row.
            alarm: its name.
            joins: whether it belongs to the latest incident, however long ago that changed, and changes nothing of it.
        """
        latest = self.state
        if joins and latest.number:
            return latest.number
        if not (latest.number and 0 <= time_ns - latest.changed_ns <= self._window_ns):
            latest.number, latest.first_in = latest.number + 1, alarm
        latest.changed_ns = time_ns
        return latest.number

    def cleared(self, time_ns: int, number: int) -> None:
        """Take note that an alarm of an incident was cleared."""
        if number and number == self.state.number:
            self.state.changed_ns = time_ns
