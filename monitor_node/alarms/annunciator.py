"""The alarms of one plant: their states, incidents and KPIs.

A fault raises the most sensitive alarm first, then others, and some of them are cleared and raised again while it
lasts. So an alarm activated within `incident_min` of the last change (raised or cleared) of an alarm of the latest
incident belongs to that incident: one fault is one incident, not twenty alarms. A later alarm, or an earlier one
because the plant's clock was set back, starts a new incident. Its first alarm is the first-out alarm (ISA-18.1), the
one to look at first. The window counts from the last change, and not from the last clearing: an alarm that has been
active alone for days does not make every new fault part of its incident.

Alarms change with samples, with an operator's actions, and when shelving ends. All times are sample times. So alarms
without an operator's action follow from the samples alone.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Literal, TypeAlias

import msgspec

from monitor_node.alarms.alarms import (
    LAST_NS,
    Activation,
    AlarmChange,
    AlarmMemory,
    ChartAlarm,
    Incident,
    KpiCounter,
    SuspectedCause,
    TimeNs,
)
from monitor_node.config import MonitorConfig, PriorityName
from reactorwatch.contract import keys
from reactorwatch.contract.alarm_states import CODES, UNACKNOWLEDGED_STATES, Event, State, is_consistent, next_state
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, Contribution
from reactorwatch.errors import InputError
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.stored_state import Memory

KPIS = "monitor"
"""The name in the key of the KPIs."""

STOPPED = "the search for its cause stopped at its budget of filter steps, so none is named"
"""Text of an incident after such a search."""

Action: TypeAlias = Event | Literal["comment"]
"""Action of an operator; a comment changes no state."""

SHARED = (
    *("raised_ns", "cleared_ns", "value", "limit", "unit", "text", "incident", "first_in", "shelved_until_ns"),
    *("by", "comment"),
)
"""Fields that the memory of an alarm and its message have in common."""


class AnnunciatorMemory(Memory):
    """Memory of a plant's alarms.

    Attributes:
        time_ns: time of the newest row; None before the first.
        alarms: memory of each alarm by name; those that are not declared are kept: settings may declare them again.
        incidents: incidents that may change, in the order of their numbers: those with an alarm that is active or waits
            for an operator, and the latest; empty before the first.
        kpis: counter of activations.
        kpi_minute: minute in which KPIs were last published; None if unknown.
        kpis_due: True if KPIs are due with the next row, after a change of an alarm.
        incidents_due: True if an incident may have changed since incidents were last published.
    """

    time_ns: TimeNs | None = None
    alarms: dict[str, AlarmMemory] = msgspec.field(default_factory=dict)
    incidents: list[Incident] = msgspec.field(default_factory=list)
    kpis: KpiCounter = msgspec.field(default_factory=KpiCounter)
    kpi_minute: int | None = None
    kpis_due: bool = False
    incidents_due: bool = False


class Annunciator:
    """The alarms of one plant.

    Args:
        config: settings of the monitor.

    Attributes:
        memory: memory of the alarms.
        incident: number of the latest incident; 0 before the first.
        has_unexplained: True if an alarm is active that does not name its cause itself.
    """

    def __init__(self, config: MonitorConfig) -> None:
        self._config = config
        self._window_ns = int(config.incident_min * MINUTE_NS)
        self._alarms: dict[str, ChartAlarm] = {}
        self._alarm_key, self._incident_key, self._kpi_key = (
            keys.key(config.plant, kind, name)
            for kind, name in ((keys.ALARM, ""), (keys.INCIDENT, ""), (keys.ALARM_KPIS, KPIS))
        )
        self._shelved: list[ChartAlarm] = []
        self.memory = AnnunciatorMemory()
        self.incident = 0
        self.has_unexplained = False
        self.describe_operation: Callable[[int], str] = lambda time_ns: ""
        """Operation of the plant at a time, which the text of a raised alarm then states; empty: as usual."""
        self.warning = ""
        """Warning of false alarms, which the text of a raised alarm states; empty: none."""

    def declare(
        self,
        chart: str,
        signal: str,
        *,
        without_on_delay: bool = False,
        without_off_delay: bool = False,
        names_cause: bool = False,
        is_transient: bool = False,
        priority: PriorityName | None = None,
        dead_band: float | None = None,
    ) -> ChartAlarm:
        """Declare the alarm of a chart.

        One that was declared before, as before an error of this software, keeps its memory, but for the points and a
        change that was not applied.

        Args:
            chart: name of the chart.
            signal: name of the signal, or another word in the alarm's key.
            without_on_delay: True if one violating point raises the alarm, and not `raise_count` among `window`.
            without_off_delay: True if one ordinary point clears the alarm, and not `clear_count`.
            names_cause: see `ChartAlarm`.
            is_transient: see `ChartAlarm`.
            priority: priority; None: that of the signal.
            dead_band: dead band; None: that of the settings.
        """
        config = self._config
        count, window = (1, 1) if without_on_delay else (config.raise_count, config.window)
        delays = count, window, 1 if without_off_delay else config.clear_count
        urgency = priority or config.priorities.get(signal, "medium")
        band = config.dead_band if dead_band is None else dead_band
        alarm = ChartAlarm(chart, signal, urgency, delays, band, names_cause=names_cause, is_transient=is_transient)
        alarm.memory = memory = self.memory.alarms.setdefault(alarm.name, alarm.memory)
        memory.recent, memory.in_a_row, memory.standing = 0, 0, memory.is_active
        self._alarms[alarm.name] = alarm
        return alarm

    # --- rows ------------------------------------------------------------------------------------------------

    def apply(self, time_ns: int, changes: Sequence[AlarmChange]) -> list[Publication]:
        """Apply the changes of alarms that the stages of a row have found, in their order; returns their messages."""
        publications: list[Publication] = []
        operation = self.describe_operation(time_ns) if changes else ""
        for change in changes:
            alarm, memory, judgement = change.alarm, change.alarm.memory, change.judgement
            at_ns = time_ns if change.time_ns is None else change.time_ns
            self._take_suspects(alarm)
            memory.value, memory.unit, memory.is_active = judgement.statistic, change.unit, change.is_raised
            if change.is_raised:
                memory.above = judgement.statistic > judgement.centre
                memory.limit = judgement.upper_limit if memory.above else judgement.lower_limit
                memory.raised_ns, memory.cleared_ns, memory.incident, memory.first_in = at_ns, 0, 0, False
                if memory.state is State.NORMAL:
                    memory.by = memory.comment = ""
                memory.text = "; ".join(filter(None, (change.text, operation, self.warning)))
                memory.contributions, memory.suspects = change.contributions, list(change.suspects)
            else:
                memory.cleared_ns, memory.text = at_ns, f"{alarm.name} is back within its limits"
            event = Event.RAISED if change.is_raised else Event.CLEARED
            self._set_state(alarm, event, at_ns)
            publications.append(self._publication(alarm, event, at_ns))
            if change.entries:
                self.set_suspects(change.entries)
        return publications

    def end_row(self, time_ns: int) -> list[Publication]:
        """End shelving whose time is over; publish changed incidents, and KPIs after a change and each minute."""
        memory = self.memory
        memory.time_ns = time_ns
        publications: list[Publication] = []
        for alarm in self._shelved:
            # A clock that was set back ends shelving as well; otherwise it would last as much longer.
            if not alarm.memory.shelved_ns <= time_ns < alarm.memory.shelved_until_ns:
                self._set_state(alarm, Event.SHELF_TIME_OVER, time_ns)
                publications.append(self._publication(alarm, Event.SHELF_TIME_OVER, time_ns))
        if memory.incidents_due:
            publications += self._publish_incidents(time_ns)
        if memory.kpis_due or time_ns // MINUTE_NS != memory.kpi_minute:
            publications.append(self._publish_kpis(time_ns))
        return publications

    def set_suspects(self, suspects: Sequence[SuspectedCause], *, stopped: bool = False) -> None:
        """Set the possible causes of the latest incident; it is published at the end of the row.

        Args:
            suspects: possible causes, the likeliest first.
            stopped: True if the search stopped at its budget, which the incident's text then says.
        """
        if self.memory.incidents:
            incident = self.memory.incidents[-1]
            incident.suspects, incident.text = list(suspects), STOPPED if stopped else ""
            self.memory.incidents_due = True

    def is_at_rest(self, counting: Iterable[ChartAlarm]) -> bool:
        """True if no alarm is active or shelved, and no alarms but the given ones remember points."""
        if self._shelved or any(alarm.memory.standing for alarm in self._alarms.values()):
            return False
        known = {alarm.name for alarm in counting}
        return all(name in known or not alarm.memory.recent for name, alarm in self._alarms.items())

    # --- operators -------------------------------------------------------------------------------------------

    def act(self, name: str, action: Action, by: str, comment: str, minutes: float = 0.0) -> list[Publication]:
        """Apply an operator's action.

        Args:
            name: name of the alarm.
            action: the action; shelving a shelved alarm changes the time for which it is shelved.
            by: name of the operator.
            comment: reason; empty: the last comment stays.
            minutes: duration of shelving in plant time.

        Raises:
            InputError: there is no such alarm, no sample has come yet, the table of states refuses the action, the
                comment is empty where it is the action, or minutes are not positive or too many.
        """
        alarm = self._find(name)
        memory, time_ns, longest = alarm.memory, self.memory.time_ns, self._config.longest_shelf_min
        if time_ns is None:
            raise InputError("no sample has come yet, and alarms change at the time of a sample; wait for the plant")
        if not isinstance(action, Event):
            if not comment:
                raise InputError("comment must say something, got ''")
            memory.by, memory.comment = by, comment
            return [self._publication(alarm, action, time_ns)]
        if action is Event.SHELVE and not 0 < minutes <= longest:
            raise InputError(f"minutes must be in (0, {longest:g}], which longest_shelf_min sets, got {minutes:g}")
        try:
            self._set_state(alarm, action, time_ns)
        except InputError as error:
            raise InputError(f"alarm {name} {error}") from error
        memory.by, memory.comment = by, comment or memory.comment
        if action is Event.SHELVE:
            memory.shelved_ns, memory.shelved_until_ns = time_ns, min(time_ns + round(minutes * MINUTE_NS), LAST_NS)
        changed = self._publication(alarm, action, time_ns)
        return [changed, *self._publish_incidents(time_ns), self._publish_kpis(time_ns)]

    def acknowledge_incident(self, number: int, by: str, comment: str) -> list[Publication]:
        """Acknowledge all alarms of an incident, one after the other; arguments as for `act`.

        Raises:
            InputError: no sample has come yet, or the incident has no alarm that is unacknowledged.
        """
        due = [
            name
            for name, alarm in self._alarms.items()
            if alarm.memory.incident == number and alarm.memory.state in UNACKNOWLEDGED_STATES
        ]
        if not due:
            raise InputError(f"incident {number} has no alarm to acknowledge (the latest incident is {self.incident})")
        return [item for name in due for item in self.act(name, Event.ACKNOWLEDGE, by, comment)]

    def alarm(self, name: str) -> Alarm:
        """The present message of an alarm.

        Raises:
            InputError: there is no such alarm.
        """
        return self._message(self._find(name), "", self.memory.time_ns or 0)

    def all_alarms(self) -> list[Alarm]:
        """The present messages of all alarms."""
        return [self.alarm(name) for name in self._alarms]

    def restore(self, memory: AnnunciatorMemory) -> None:
        """Resume from the memory of another annunciator of the plant.

        Raises:
            InputError: the memory contradicts itself; nothing has changed.
        """
        for name, alarm in memory.alarms.items():
            if not is_consistent(alarm.state, active=alarm.standing):
                active = "is active" if alarm.standing else "is not active"
                raise InputError(f"is no state of alarms: {name} is {alarm.state}, but its condition {active}")
        for name, declared in self._alarms.items():
            declared.memory = memory.alarms.setdefault(name, declared.memory)
        self.memory = memory
        self._refresh()

    # --- within ----------------------------------------------------------------------------------------------

    def _find(self, name: str) -> ChartAlarm:
        alarm = self._alarms.get(name)
        if alarm is None:
            raise InputError(f"there is no alarm {name!r} (there are: {', '.join(self._alarms)})")
        return alarm

    def _set_state(self, alarm: ChartAlarm, event: Event, time_ns: int) -> None:
        """Apply an event to the state of an alarm, to its incident, and to the KPIs.

        Raises:
            InputError: the table of states refuses the event; nothing has changed.
        """
        memory, before = alarm.memory, alarm.memory.state
        memory.state = next_state(before, event, active=memory.standing)
        if memory.state is not State.SHELVED:
            memory.shelved_ns = memory.shelved_until_ns = 0
        if event is Event.CLEARED and (memory.first_in or not alarm.is_transient):
            for incident in self.memory.incidents:
                if incident.number == memory.incident:
                    incident.changed_ns = time_ns
        if memory.state is State.UNACKNOWLEDGED and before is not State.UNACKNOWLEDGED:
            kpis, priority = self.memory.kpis, alarm.priority
            kpis.recent.append(Activation(time_ns, alarm.name))
            kpis.raised[priority] = kpis.raised.get(priority, 0) + 1
            if not memory.incident:
                self._assign(alarm, time_ns)
        self._refresh()
        self.memory.kpis_due = self.memory.incidents_due = True

    def _refresh(self) -> None:
        """Refresh what every row reads and few rows change."""
        alarms = self._alarms.values()
        self._shelved = [alarm for alarm in alarms if alarm.memory.state is State.SHELVED]
        self.incident = self.memory.incidents[-1].number if self.memory.incidents else 0
        self.has_unexplained = any(alarm.memory.is_active and not alarm.names_cause for alarm in alarms)

    def _publication(self, alarm: ChartAlarm, event: str, time_ns: int) -> Publication:
        return Publication(self._alarm_key + alarm.name, self._message(alarm, event, time_ns))

    def _message(self, alarm: ChartAlarm, event: str, time_ns: int) -> Alarm:
        """An alarm as a message, with the event that changed it and the time of that."""
        self._take_suspects(alarm)
        memory = alarm.memory
        return Alarm(
            time_ns=time_ns,
            alarm=alarm.name,
            state=CODES[memory.state],
            priority=alarm.priority,
            contributions=[Contribution(signal=name, share=share) for name, share in memory.contributions.items()],
            suspects=[item.message for item in memory.suspects],
            event=event,
            names_cause=alarm.names_cause,
            **{field: getattr(memory, field) for field in SHARED},
        )

    def _publish_kpis(self, time_ns: int) -> Publication:
        memory = self.memory
        memory.kpi_minute, memory.kpis_due = time_ns // MINUTE_NS, False
        return Publication(self._kpi_key, memory.kpis.compute(time_ns, self._alarms.values(), self.incident))

    # --- incidents -------------------------------------------------------------------------------------------

    def _assign(self, alarm: ChartAlarm, time_ns: int) -> None:
        """Assign an activated alarm to the latest incident, or to a new one.

        A transient alarm joins the latest incident, however old, without changing it, while an alarm without a known
        cause is active.
        """
        incidents = self.memory.incidents
        joins = bool(incidents) and alarm.is_transient and self.has_unexplained
        if not (joins or (incidents and 0 <= time_ns - incidents[-1].changed_ns <= self._window_ns)):
            for other in self._alarms.values():
                self._take_suspects(other)
            incidents.append(Incident(1 + self.incident, since_ns=time_ns))
        latest = incidents[-1]
        if alarm.name not in latest.alarms:
            latest.alarms.append(alarm.name)
        if not joins:
            latest.changed_ns = time_ns
        alarm.memory.incident, alarm.memory.first_in = latest.number, latest.alarms[0] == alarm.name

    def _take_suspects(self, alarm: ChartAlarm) -> None:
        """Give an alarm the suspects of its incident, if that is the latest and the alarm does not name its cause."""
        memory, incidents = alarm.memory, self.memory.incidents
        if incidents and memory.incident == incidents[-1].number and memory.is_active and not alarm.names_cause:
            memory.suspects = list(incidents[-1].suspects)

    def _publish_incidents(self, time_ns: int) -> list[Publication]:
        """Messages of the incidents that have changed; those that are over are forgotten, but for the latest."""
        memory, publications, kept = self.memory, list[Publication](), list[Incident]()
        for incident in memory.incidents:
            found = (self._alarms.get(name) for name in incident.alarms)
            members = [item.memory for item in found if item is not None and item.memory.incident == incident.number]
            message = incident.message(members)
            content = message.SerializeToString(deterministic=True)
            if content != incident.published:
                incident.published, message.time_ns = content, time_ns
                publications.append(Publication(f"{self._incident_key}{incident.number}", message))
            if incident is memory.incidents[-1] or any(item.state is not State.NORMAL for item in members):
                kept.append(incident)
        memory.incidents, memory.incidents_due = kept, False
        return publications
