"""The alarms of one plant: their states, incidents and KPIs.

Alarms change with samples, with an operator's actions, and when shelving ends. All times are sample times. So alarms
without an operator's action follow from the samples alone.
"""

from collections.abc import Callable, Iterable
from math import isfinite
from typing import Literal

import msgspec
from google.protobuf.message import DecodeError as ProtobufDecodeError

from monitor_node.alarms.alarms import (
    LAST_NS,
    AlarmMemory,
    ChartAlarm,
    Explanation,
    SuspectedCause,
    TimeNs,
    memory_from_message,
)
from monitor_node.alarms.incidents import Incident, Incidents
from monitor_node.alarms.kpis import KpiCounter, KpiState
from monitor_node.alarms.on_off_delay import OnOffDelay
from monitor_node.alarms.states import UNACKNOWLEDGED_STATES, Event, State, is_consistent
from monitor_node.config import MonitorConfig, PriorityName
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, AlarmKpis
from reactorwatch.errors import InputError
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.spc.charts.base import Judgement

KPIS = "monitor"
"""The name in the key of the KPIs."""

SUSPECTED = "suspected"
"""The event of an alarm with new suspects."""

STOPPED = "; the search for its cause stopped at its budget of filter steps, so none is named"
"""The end of an alarm's text after such a search."""


class AnnunciatorState(msgspec.Struct, forbid_unknown_fields=True):
    """State of a plant's alarms.

    Attributes:
        version: version of this structure.
        plant: name of the plant.
        time_ns: time of the newest row; None before the first.
        alarms: state of each alarm by name.
        incident: the latest incident.
        kpis: state of the KPI counter.
        suspects: possible causes of the latest incident.
        kpi_minute: minute in which KPIs were last published; None if unknown.
        kpis_changed: True if KPIs are due with the next row.
        told: the newest published `AlarmKpis`, serialized.
    """

    version: Literal[1]
    plant: str
    time_ns: TimeNs | None
    alarms: dict[str, AlarmMemory]
    incident: Incident
    kpis: KpiState
    suspects: list[SuspectedCause] = []
    kpi_minute: int | None = None
    kpis_changed: bool = False
    told: bytes | None = None


class Annunciator:
    """The alarms of one plant.

    Args:
        config: settings of the monitor.

    Attributes:
        time_ns: time of the newest row; None before the first.
        changes: count of changes that a restart must preserve.
        has_unexplained: True if an alarm is active that does not name its cause itself.
    """

    def __init__(self, config: MonitorConfig) -> None:
        self._config = config
        self._alarms: dict[str, ChartAlarm] = {}
        self._keys: dict[str, str] = {}  # key of each alarm's messages, by its name
        self._undeclared: dict[str, AlarmMemory] = {}  # from a stored state; settings may declare them again
        self._transient: set[str] = set()
        self._incidents = Incidents(config.incident_min)
        self._kpis = KpiCounter()
        self._kpi_key = keys.key(config.plant, keys.ALARM_KPIS, KPIS)
        self._shelved: list[ChartAlarm] = []
        self._suspects: list[SuspectedCause] = []  # of the latest incident
        self._kpi_minute: int | None = None
        self._kpis_changed = False
        self._newest_kpis: AlarmKpis | None = None
        self.time_ns: int | None = None
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

        Args:
            chart: name of the chart.
            signal: name of the signal, or another word in the alarm's key.
            without_on_delay: True if one violating point raises the alarm, and not `raise_count` among `window`.
            without_off_delay: True if one normal point clears the alarm, and not `clear_count`.
            names_cause: True if the alarm names its cause itself.
            is_transient: True if the alarm is for a single value. While an alarm without a known cause is active, it
                joins the latest incident, so that it removes no suspects.
            priority: priority; None: that of the signal.
            dead_band: dead band; None: that of the settings.
        """
        config = self._config
        count, window = (1, 1) if without_on_delay else (config.raise_count, config.window)
        rule = OnOffDelay(count, window, 1 if without_off_delay else config.clear_count)
        urgency = priority or config.priorities.get(signal, "medium")
        band = config.dead_band if dead_band is None else dead_band
        alarm = ChartAlarm(chart, signal, urgency, rule, band, names_cause=names_cause)
        if is_transient:
            self._transient.add(alarm.name)
        self._alarms[alarm.name] = alarm
        self._keys[alarm.name] = keys.key(config.plant, keys.ALARM, alarm.name)
        return alarm

    # --- samples ---------------------------------------------------------------------------------------------

    def record_change(
        self, alarm: ChartAlarm, time_ns: int, judgement: Judgement, unit: str, explanation: Explanation | None
    ) -> Publication:
        """Record that an alarm declared here was raised or cleared by its `update`; returns its message.

        Arguments as for `ChartAlarm.record`.
        """
        before = alarm.memory.state
        if explanation is not None:
            parts = (explanation.text, self.describe_operation(time_ns), self.warning)
            explanation = explanation._replace(text="; ".join(filter(None, parts)))
        event = alarm.record(time_ns, judgement, unit, explanation)
        self._on_change(alarm, event, before, time_ns)
        return self._publication(alarm, event, time_ns)

    def end_row(self, time_ns: int) -> list[Publication]:
        """End shelving where its time is over; publish KPIs after a change and each minute.

        Args:
            time_ns: time of the row, which all charts have evaluated.
        """
        self.time_ns = time_ns
        publications: list[Publication] = []
        for alarm in self._shelved:
            memory = alarm.memory
            # A clock that was set back ends shelving as well; otherwise it would last as much longer.
            if not memory.shelved_ns <= time_ns < memory.shelved_until_ns:
                self._apply(alarm, Event.SHELF_TIME_OVER, time_ns)
                publications.append(self._publication(alarm, Event.SHELF_TIME_OVER, time_ns))
        minute = time_ns // MINUTE_NS
        if self._kpis_changed or minute != self._kpi_minute:
            publications.append(self._publish_kpis(time_ns))
        return publications

    def set_suspects(self, time_ns: int, suspects: list[SuspectedCause], *, stopped: bool = False) -> list[Publication]:
        """Set the possible causes of the latest incident, for its active alarms and for those still to come.

        Args:
            time_ns: time of the row.
            suspects: possible causes, the likeliest first.
            stopped: True if the search stopped at its budget, which the alarms' texts then say.
        """
        publications: list[Publication] = []
        self._suspects = list(suspects)
        for alarm in self._alarms.values():
            memory = alarm.memory
            if alarm.names_cause:
                continue
            if memory.rule.standing and memory.incident == self._incidents.state.number and memory.incident:
                memory.suspects = list(suspects)
                memory.text = memory.text.removesuffix(STOPPED) + (STOPPED if stopped else "")
                self.changes += 1
                publications.append(self._publication(alarm, SUSPECTED, time_ns))
        return publications

    def is_at_rest(self, counting: Iterable[ChartAlarm]) -> bool:
        """True if no alarm is active or shelved, and no alarms but the given ones remember points."""
        if self._shelved or any(alarm.memory.rule.standing for alarm in self._alarms.values()):
            return False
        known = {alarm.name for alarm in counting}
        return all(name in known or not alarm.memory.rule.recent for name, alarm in self._alarms.items())

    @property
    def incident(self) -> int:
        """Number of the latest incident; 0 before the first."""
        return self._incidents.state.number

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
        return [self._publication(alarm, event, time_ns), self._publish_kpis(time_ns)]

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
        return [self._publication(alarm, Event.SHELVE, time_ns), self._publish_kpis(time_ns)]

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
        return self._find(name).message(self.time_ns or 0, "")

    def all_alarms(self) -> list[Alarm]:
        """The present messages of all alarms."""
        return [self.alarm(name) for name in self._alarms]

    # --- state -----------------------------------------------------------------------------------------------

    def to_bytes(self) -> bytes:
        """Serialise the state as MessagePack."""
        state = AnnunciatorState(
            version=1,
            plant=self._config.plant,
            time_ns=self.time_ns,
            alarms=self._undeclared | {name: alarm.memory for name, alarm in self._alarms.items()},
            incident=self._incidents.state,
            kpis=self._kpis.state,
            suspects=self._suspects,
            kpi_minute=self._kpi_minute,
            kpis_changed=self._kpis_changed,
            told=None if self._newest_kpis is None else self._newest_kpis.SerializeToString(),
        )
        return msgspec.msgpack.encode(state)

    def from_bytes(self, data: bytes) -> None:
        """Resume from what `to_bytes` returned. Alarms that are not declared here are only stored again.

        Raises:
            InputError: the bytes are no state, or one of another plant; nothing has changed.
        """
        try:
            state = msgspec.msgpack.decode(data, type=AnnunciatorState)
            kpis = None if state.told is None else AlarmKpis.FromString(state.told)
        except (msgspec.DecodeError, UnicodeDecodeError, ProtobufDecodeError) as error:
            raise InputError(f"is no alarm state: {error}") from error
        if state.plant != self._config.plant:
            raise InputError(f"is the alarm state of plant {state.plant!r}, not of {self._config.plant!r}")
        for name, memory in state.alarms.items():
            if not is_consistent(memory.state, active=memory.rule.standing):
                active = "is active" if memory.rule.standing else "is not active"
                raise InputError(f"is no alarm state: {name} is {memory.state}, but its condition {active}")
        for name in state.alarms.keys() & self._alarms.keys():
            self._alarms[name].restore(state.alarms[name])
        self._undeclared = {name: memory for name, memory in state.alarms.items() if name not in self._alarms}
        self._refresh()
        self.time_ns = state.time_ns
        self._incidents.state = state.incident
        self._kpis.state, self._newest_kpis = state.kpis, kpis
        self._suspects = state.suspects
        self._kpi_minute, self._kpis_changed = state.kpi_minute, state.kpis_changed

    def resume_from(self, alarms: Iterable[Alarm]) -> None:
        """Resume from the alarms that another monitor of the plant published last, without its state.

        Args:
            alarms: the newest message of each. Undeclared alarms and inconsistent states are left out.
        """
        incident = self._incidents.state
        for alarm in alarms:
            memory = memory_from_message(alarm)
            if alarm.alarm in self._alarms and is_consistent(memory.state, active=memory.rule.standing):
                self._alarms[alarm.alarm].restore(memory)
                if alarm.incident > incident.number or (alarm.incident == incident.number and alarm.first_in):
                    incident.number, incident.first_in = alarm.incident, alarm.alarm
                incident.changed_ns = max(incident.changed_ns, alarm.raised_ns, alarm.cleared_ns)
        self._refresh()

    # --- within ----------------------------------------------------------------------------------------------

    def _find(self, name: str) -> ChartAlarm:
        alarm = self._alarms.get(name)
        if alarm is None:
            raise InputError(f"there is no alarm {name!r} (there are: {', '.join(self._alarms)})")
        return alarm

    def _now_ns(self) -> int:
        if self.time_ns is None:
            raise InputError("no sample has come yet, and alarms change at the time of a sample; wait for the plant")
        return self.time_ns

    def _change_by(self, alarm: ChartAlarm, event: Event, time_ns: int, by: str, comment: str) -> None:
        try:
            self._apply(alarm, event, time_ns)
        except InputError as error:
            raise InputError(f"alarm {alarm.name} {error}") from error
        alarm.memory.by, alarm.memory.comment = by, comment or alarm.memory.comment

    def _apply(self, alarm: ChartAlarm, event: Event, time_ns: int) -> None:
        before = alarm.memory.state
        alarm.apply(event)
        self._on_change(alarm, event, before, time_ns)

    def _on_change(self, alarm: ChartAlarm, event: Event, before: State, time_ns: int) -> None:
        """Assign an alarm that changed to its incident, and count it."""
        memory = alarm.memory
        if event is Event.CLEARED and (memory.first_in or alarm.name not in self._transient):
            self._incidents.on_cleared(time_ns, memory.incident)
        if memory.state is State.UNACKNOWLEDGED and before is not State.UNACKNOWLEDGED:
            self._kpis.count(time_ns, alarm.name, alarm.priority)
            if not memory.incident:
                joins = alarm.name in self._transient and self.has_unexplained
                memory.incident = self._incidents.assign(time_ns, alarm.name, joins=joins)
                memory.first_in = self._incidents.state.first_in == alarm.name
                if memory.first_in:
                    self._suspects = []
                if not alarm.names_cause:
                    memory.suspects = list(self._suspects)
        self._refresh()
        self.changes += 1
        self._kpis_changed = True

    def _refresh(self) -> None:
        """Refresh what every row reads and few rows change."""
        alarms = self._alarms.values()
        self._shelved = [alarm for alarm in alarms if alarm.memory.state is State.SHELVED]
        self.has_unexplained = any(alarm.memory.rule.standing and not alarm.names_cause for alarm in alarms)

    def _publication(self, alarm: ChartAlarm, event: str, time_ns: int) -> Publication:
        return Publication(self._keys[alarm.name], alarm.message(time_ns, event))

    def _publish_kpis(self, time_ns: int) -> Publication:
        before = self._newest_kpis
        if self._kpis_changed or before is None or before.standing or before.alarms_10min:
            kpis = self._kpis.compute(time_ns, self._alarms.values(), self._incidents.state.number)
        else:  # nothing that time alone would change
            kpis = AlarmKpis()
            kpis.CopyFrom(before)
            kpis.time_ns = time_ns
        self._kpi_minute, self._kpis_changed, self._newest_kpis = time_ns // MINUTE_NS, False, kpis
        return Publication(self._kpi_key, kpis)
