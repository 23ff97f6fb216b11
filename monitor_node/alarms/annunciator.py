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
from math import isfinite

import msgspec
from google.protobuf.message import DecodeError as ProtobufDecodeError

from monitor_node.alarms.alarms import (
    LAST_NS,
    AlarmChange,
    AlarmMemory,
    ChartAlarm,
    Condition,
    Incident,
    OnOffDelay,
    SuspectedCause,
    TimeNs,
    suspect_messages,
)
from monitor_node.alarms.kpis import KpiCounter
from monitor_node.config import MonitorConfig, PriorityName
from reactorwatch.contract import keys
from reactorwatch.contract.alarm_states import CODES, UNACKNOWLEDGED_STATES, Event, State, is_consistent
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, AlarmKpis
from reactorwatch.contract.messages_pb2 import Incident as IncidentMessage
from reactorwatch.errors import InputError
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.stored_state import Memory

KPIS = "monitor"
"""The name in the key of the KPIs."""

STOPPED = "the search for its cause stopped at its budget of filter steps, so none is named"
"""Text of an incident after such a search."""

URGENCY = (
    *(State.UNACKNOWLEDGED, State.ACKNOWLEDGED, State.RETURNED_UNACKNOWLEDGED, State.SHELVED),
    *(State.SUPPRESSED_BY_DESIGN, State.OUT_OF_SERVICE, State.NORMAL),
)
"""States of alarms, the most urgent first; an incident has that of its most urgent alarm."""


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
        published_kpis: the newest published `AlarmKpis`, serialized; empty before the first.
    """

    time_ns: TimeNs | None = None
    alarms: dict[str, AlarmMemory] = msgspec.field(default_factory=dict)
    incidents: list[Incident] = msgspec.field(default_factory=list)
    kpis: KpiCounter = msgspec.field(default_factory=KpiCounter)
    kpi_minute: int | None = None
    kpis_due: bool = False
    incidents_due: bool = False
    published_kpis: bytes = b""


class Annunciator:
    """The alarms of one plant.

    Args:
        config: settings of the monitor.

    Attributes:
        memory: memory of the alarms.
        changes: count of changes that a restart must preserve.
        has_unexplained: True if an alarm is active that does not name its cause itself.
    """

    def __init__(self, config: MonitorConfig) -> None:
        self._config = config
        self._window_ns = int(config.incident_min * MINUTE_NS)
        self._alarms: dict[str, ChartAlarm] = {}
        self._keys: dict[str, str] = {}  # key of each alarm's messages, by its name
        self._kpi_key = keys.key(config.plant, keys.ALARM_KPIS, KPIS)
        self._shelved: list[ChartAlarm] = []
        self._newest_kpis: AlarmKpis | None = None
        self.memory = AnnunciatorMemory()
        self.changes = 0
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
        rule = OnOffDelay(count, window, 1 if without_off_delay else config.clear_count)
        urgency = priority or config.priorities.get(signal, "medium")
        band = config.dead_band if dead_band is None else dead_band
        alarm = ChartAlarm(chart, signal, urgency, rule, band, names_cause=names_cause, is_transient=is_transient)
        alarm.memory = self.memory.alarms.setdefault(alarm.name, alarm.memory)
        alarm.memory.rule = Condition(standing=alarm.memory.is_active)
        self._alarms[alarm.name] = alarm
        self._keys[alarm.name] = keys.key(config.plant, keys.ALARM, alarm.name)
        return alarm

    # --- samples ---------------------------------------------------------------------------------------------

    def apply(self, time_ns: int, changes: Sequence[AlarmChange]) -> list[Publication]:
        """Apply the changes of alarms that the stages of a row have found, in their order; returns their messages.

        Args:
            time_ns: time of the row.
            changes: changes of alarms declared here.
        """
        if not changes:
            return []
        publications, activated = list[Publication](), list[tuple[int, ChartAlarm]]()
        operation = self.describe_operation(time_ns)
        for change in changes:
            alarm, explanation = change.alarm, change.explanation
            at_ns = time_ns if change.time_ns is None else change.time_ns
            before = alarm.memory.state
            self._take_suspects(alarm)
            if explanation is not None:
                text = "; ".join(filter(None, (explanation.text, operation, self.warning)))
                change = change._replace(explanation=explanation._replace(text=text))
            event = alarm.record(at_ns, change)
            if self._on_change(alarm, event, before, at_ns):
                activated.append((at_ns, alarm))
            publications.append(self._publication(alarm, event, at_ns))
            if explanation is not None and explanation.entries:
                self.set_suspects(explanation.entries)
        if activated:
            self.memory.kpis.count(activated)
        return publications

    def end_row(self, time_ns: int) -> list[Publication]:
        """End shelving where its time is over; publish incidents that changed, and KPIs after a change and each minute.

        Args:
            time_ns: time of the row, which all charts have evaluated.
        """
        memory = self.memory
        memory.time_ns = time_ns
        publications: list[Publication] = []
        for alarm in self._shelved:
            # A clock that was set back ends shelving as well; otherwise it would last as much longer.
            if not alarm.memory.shelved_ns <= time_ns < alarm.memory.shelved_until_ns:
                self._apply(alarm, Event.SHELF_TIME_OVER, time_ns)
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
            self.changes += 1

    def is_at_rest(self, counting: Iterable[ChartAlarm]) -> bool:
        """True if no alarm is active or shelved, and no alarms but the given ones remember points."""
        if self._shelved or any(alarm.memory.rule.standing for alarm in self._alarms.values()):
            return False
        known = {alarm.name for alarm in counting}
        return all(name in known or not alarm.memory.rule.recent for name, alarm in self._alarms.items())

    @property
    def incident(self) -> int:
        """Number of the latest incident; 0 before the first."""
        return self.memory.incidents[-1].number if self.memory.incidents else 0

    # --- operator actions ------------------------------------------------------------------------------------

    def act(self, name: str, event: Event, by: str, comment: str) -> list[Publication]:
        """Apply an operator's action, other than shelving.

        Args:
            name: name of the alarm.
            event: the action.
            by: name of the operator.
            comment: reason; empty: the last comment stays.

        Raises:
            InputError: there is no such alarm, no sample has come yet, or the table of states refuses it.
        """
        alarm, time_ns = self._find(name), self._now_ns()
        self._change_by(alarm, event, time_ns, by, comment)
        return [self._publication(alarm, event, time_ns), *self._publish_summary(time_ns)]

    def acknowledge_incident(self, number: int, by: str, comment: str) -> list[Publication]:
        """Acknowledge all alarms of an incident, one after the other.

        Args:
            number: number of the incident.
            by: name of the operator.
            comment: reason; empty: the last comment stays.

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

    def shelve(self, name: str, minutes: float, by: str, comment: str) -> list[Publication]:
        """Shelve an alarm, or change the time for which it is shelved.

        Args:
            name: name of the alarm.
            minutes: duration in plant time.
            by: name of the operator.
            comment: reason; empty: the last comment stays.

        Raises:
            InputError: as `act`, or the time is not positive or too long.
        """
        alarm, time_ns = self._find(name), self._now_ns()
        longest = self._config.longest_shelf_min
        if not (isfinite(minutes) and 0 < minutes <= longest):
            raise InputError(f"minutes must be in (0, {longest:g}], which longest_shelf_min sets, got {minutes:g}")
        self._change_by(alarm, Event.SHELVE, time_ns, by, comment)
        alarm.memory.shelved_ns = time_ns
        alarm.memory.shelved_until_ns = min(time_ns + round(minutes * MINUTE_NS), LAST_NS)
        return [self._publication(alarm, Event.SHELVE, time_ns), *self._publish_summary(time_ns)]

    def comment(self, name: str, by: str, comment: str) -> list[Publication]:
        """Set an operator's comment on an alarm.

        Raises:
            InputError: there is no such alarm, no sample has come yet, or the comment is empty.
        """
        alarm, time_ns = self._find(name), self._now_ns()
        if not comment:
            raise InputError("comment must say something, got ''")
        self.changes += 1
        alarm.memory.by, alarm.memory.comment = by, comment
        return [self._publication(alarm, "comment", time_ns)]

    def alarm(self, name: str) -> Alarm:
        """The present message of an alarm.

        Raises:
            InputError: there is no such alarm.
        """
        alarm = self._find(name)
        self._take_suspects(alarm)
        return alarm.message(self.memory.time_ns or 0, "")

    def all_alarms(self) -> list[Alarm]:
        """The present messages of all alarms."""
        return [self.alarm(name) for name in self._alarms]

    # --- state -----------------------------------------------------------------------------------------------

    def restore(self, memory: AnnunciatorMemory) -> None:
        """Resume from the memory of another annunciator of the plant.

        Raises:
            InputError: the memory contradicts itself; nothing has changed.
        """
        for name, alarm in memory.alarms.items():
            if not is_consistent(alarm.state, active=alarm.rule.standing):
                active = "is active" if alarm.rule.standing else "is not active"
                raise InputError(f"is no state of alarms: {name} is {alarm.state}, but its condition {active}")
        try:
            kpis = AlarmKpis.FromString(memory.published_kpis) if memory.published_kpis else None
        except ProtobufDecodeError as error:
            raise InputError(f"is no state of alarms: {error}") from error
        for name, declared in self._alarms.items():
            declared.memory = memory.alarms.setdefault(name, declared.memory)
        self.memory, self._newest_kpis = memory, kpis
        self._refresh()

    # --- within ----------------------------------------------------------------------------------------------

    def _find(self, name: str) -> ChartAlarm:
        alarm = self._alarms.get(name)
        if alarm is None:
            raise InputError(f"there is no alarm {name!r} (there are: {', '.join(self._alarms)})")
        return alarm

    def _now_ns(self) -> int:
        if self.memory.time_ns is None:
            raise InputError("no sample has come yet, and alarms change at the time of a sample; wait for the plant")
        return self.memory.time_ns

    def _change_by(self, alarm: ChartAlarm, event: Event, time_ns: int, by: str, comment: str) -> None:
        try:
            self._apply(alarm, event, time_ns)
        except InputError as error:
            raise InputError(f"alarm {alarm.name} {error}") from error
        alarm.memory.by, alarm.memory.comment = by, comment or alarm.memory.comment

    def _apply(self, alarm: ChartAlarm, event: Event, time_ns: int) -> None:
        before = alarm.memory.state
        alarm.apply(event)
        if self._on_change(alarm, event, before, time_ns):
            self.memory.kpis.count([(time_ns, alarm)])

    def _on_change(self, alarm: ChartAlarm, event: Event, before: State, time_ns: int) -> bool:
        """Assign an alarm that changed to its incident; returns True if it was activated."""
        memory = alarm.memory
        if event is Event.CLEARED and (memory.first_in or not alarm.is_transient):
            for incident in self.memory.incidents:
                if incident.number == memory.incident:
                    incident.changed_ns = time_ns
        is_activated = memory.state is State.UNACKNOWLEDGED and before is not State.UNACKNOWLEDGED
        if is_activated and not memory.incident:
            self._assign(alarm, time_ns)
        self._refresh()
        self.changes += 1
        self.memory.kpis_due = self.memory.incidents_due = True
        return is_activated

    def _assign(self, alarm: ChartAlarm, time_ns: int) -> None:
        """Assign an activated alarm to the latest incident, or to a new one.

        A transient alarm joins the latest incident, however old, without changing it, while an alarm without a known
        cause is active.
        """
        incidents = self.memory.incidents
        joins = bool(incidents) and alarm.is_transient and self.has_unexplained
        if not (joins or (incidents and 0 <= time_ns - incidents[-1].changed_ns <= self._window_ns)):
            self._keep_suspects()
            incidents.append(Incident(1 + self.incident, since_ns=time_ns))
        latest = incidents[-1]
        if alarm.name not in latest.alarms:
            latest.alarms.append(alarm.name)
        if not joins:
            latest.changed_ns = time_ns
        alarm.memory.incident, alarm.memory.first_in = latest.number, latest.alarms[0] == alarm.name

    def _refresh(self) -> None:
        """Refresh what every row reads and few rows change."""
        alarms = self._alarms.values()
        self._shelved = [alarm for alarm in alarms if alarm.memory.state is State.SHELVED]
        self.has_unexplained = any(alarm.memory.is_active and not alarm.names_cause for alarm in alarms)

    def _publication(self, alarm: ChartAlarm, event: str, time_ns: int) -> Publication:
        self._take_suspects(alarm)
        return Publication(self._keys[alarm.name], alarm.message(time_ns, event))

    def _take_suspects(self, alarm: ChartAlarm) -> None:
        """Give an alarm the suspects of its incident, if that is the latest and the alarm does not name its cause."""
        memory, incidents = alarm.memory, self.memory.incidents
        if incidents and memory.incident == incidents[-1].number and memory.is_active and not alarm.names_cause:
            memory.suspects = list(incidents[-1].suspects)

    def _keep_suspects(self) -> None:
        """Give the suspects of the latest incident to its alarms, before a later one comes."""
        for alarm in self._alarms.values():
            self._take_suspects(alarm)

    def _publish_summary(self, time_ns: int) -> list[Publication]:
        """Publish the incidents that have changed, and the KPIs."""
        return [*self._publish_incidents(time_ns), self._publish_kpis(time_ns)]

    def _publish_incidents(self, time_ns: int) -> list[Publication]:
        """Messages of the incidents that have changed; those that are over are forgotten, but for the latest."""
        memory, publications = self.memory, list[Publication]()
        for incident in memory.incidents:
            message = self._incident_message(incident)
            content = message.SerializeToString(deterministic=True)
            if content != incident.published:
                incident.published, message.time_ns = content, time_ns
                path = keys.key(self._config.plant, keys.INCIDENT, str(incident.number))
                publications.append(Publication(path, message))
        latest = memory.incidents[-1:]
        memory.incidents = [item for item in memory.incidents[:-1] if not self._is_over(item)] + latest
        memory.incidents_due = False
        return publications

    def _members(self, incident: Incident) -> list[ChartAlarm]:
        """Alarms whose last activation belongs to an incident."""
        found = (self._alarms.get(name) for name in incident.alarms)
        return [alarm for alarm in found if alarm is not None and alarm.memory.incident == incident.number]

    def _is_over(self, incident: Incident) -> bool:
        """True if no alarm of an incident is active or waits for an operator."""
        return all(alarm.memory.state is State.NORMAL for alarm in self._members(incident))

    def _incident_message(self, incident: Incident) -> IncidentMessage:
        """An incident as a message, without the time."""
        members = self._members(incident)
        is_active = any(alarm.memory.is_active for alarm in members)
        states = {alarm.memory.state for alarm in members}
        return IncidentMessage(
            number=incident.number,
            since_ns=incident.since_ns,
            until_ns=0 if is_active else incident.changed_ns,
            state=CODES[next((state for state in URGENCY if state in states), State.NORMAL)],
            alarms=incident.alarms,
            suspects=suspect_messages(incident.suspects),
            text=incident.text,
        )

    def _publish_kpis(self, time_ns: int) -> Publication:
        memory, before = self.memory, self._newest_kpis
        if memory.kpis_due or before is None or before.standing or before.alarms_10min:
            kpis = memory.kpis.compute(time_ns, self._alarms.values(), self.incident)
        else:  # nothing that time alone would change
            kpis = AlarmKpis()
            kpis.CopyFrom(before)
            kpis.time_ns = time_ns
        memory.kpi_minute, memory.kpis_due, self._newest_kpis = time_ns // MINUTE_NS, False, kpis
        memory.published_kpis = kpis.SerializeToString()
        return Publication(self._kpi_key, kpis)
