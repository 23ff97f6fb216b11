"""The alarms of one plant together: their states, incidents and figures, and all that they remember as one structure.

Alarms change when samples come, when a person says so, and when a shelf's time is over. All times are those of samples,
so what is said of alarms that nobody touched follows from the samples alone.
"""

from collections.abc import Callable, Iterable
from math import isfinite
from typing import Literal

import msgspec
from google.protobuf.message import DecodeError as ProtobufDecodeError

from monitor_node.alarms.alarms import LAST_NS, AlarmMemory, ChartAlarm, Explanation, SuspectedCause, TimeNs, remembered
from monitor_node.alarms.incidents import Incident, Incidents
from monitor_node.alarms.kpis import Counted, KpiCounter, KpiState
from monitor_node.alarms.on_off_delay import Persistence
from monitor_node.alarms.states import Event, State, fits
from monitor_node.config import MonitorConfig, PriorityName
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, AlarmKpis
from reactorwatch.errors import InputError
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.spc.charts.base import Judgement

KPIS = "monitor"
"""The name in the key of the figures."""

SUSPECTED = "suspected"
"""The event of an alarm whose suspects are new."""

STOPPED = "; the search for its cause stopped at its budget of filter steps, so none is named"
"""The end of an alarm's text after such a search."""


class BoardState(msgspec.Struct, forbid_unknown_fields=True):
    """Everything that is remembered of a plant's alarms.

    Attributes:
        version: of this structure.
        plant: whose.
        time_ns: time of the newest row; None before the first.
        alarms: by name.
        incident: the latest.
        kpis: what the figures are made of.
        suspects: of the latest incident.
        kpi_minute: in which the figures were told last; None: they were not, or it is not known.
        kpis_changed: whether they are to be told with the next row, like it or not.
        told: the figures as told last, an `AlarmKpis`.
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


class AlarmBoard:
    """The alarms of one plant.

    Args:
        config: of the monitor.

    Attributes:
        time_ns: time of the newest row; None before the first.
        changes: counts up whenever there is something that a restart must not forget.
        has_unexplained: whether an alarm stands that does not say itself what its cause is.
    """

    def __init__(self, config: MonitorConfig) -> None:
        self._config = config
        self._alarms: dict[str, ChartAlarm] = {}
        self._undeclared: dict[str, AlarmMemory] = {}  # of a stored state: settings may bring the alarm back
        self._passing: set[str] = set()
        self._incidents = Incidents(config.incident_min)
        self._kpis = KpiCounter()
        self._kpi_key = keys.key(config.plant, keys.ALARM_KPIS, KPIS)
        self._shelved: list[ChartAlarm] = []
        self._suspects: list[SuspectedCause] = []  # of the latest incident
        self._kpi_minute: int | None = None
        self._kpis_changed = False
        self._told: AlarmKpis | None = None
        self.time_ns: int | None = None
        self.changes = 0
        self.has_unexplained = False

    def declare(
        self,
        chart: str,
        signal: str,
        *,
        at_once: bool = False,
        over_at_once: bool = False,
        tells_cause: bool = False,
        is_passing: bool = False,
        priority: PriorityName | None = None,
        dead_band: float | None = None,
    ) -> ChartAlarm:
        """A new alarm, for a chart.

        Args:
            chart: its name.
            signal: what it is of.
            at_once: whether one point out raises it, and not `raise_count` among `window`.
            over_at_once: whether one point back in clears it, and not `clear_count`.
            tells_cause: whether it says itself what its cause is.
            is_passing: whether it is of a single value: while an alarm stands whose cause is not known, it belongs to
                the latest incident, so that it takes no suspects away.
            priority: that of the signal if not given.
            dead_band: as set if not given.
        """
        config = self._config
        count, window = (1, 1) if at_once else (config.raise_count, config.window)
        rule = Persistence(count, window, 1 if over_at_once else config.clear_count)
        urgency = priority or config.priorities.get(signal, "medium")
        band = config.dead_band if dead_band is None else dead_band
        alarm = ChartAlarm(chart, signal, urgency, rule, band, tells_cause=tells_cause)
        if is_passing:
            self._passing.add(alarm.name)
        self._alarms[alarm.name] = alarm
        return alarm

    # --- what samples do -------------------------------------------------------------------------------------

    def judge(
        self,
        alarm: ChartAlarm,
        time_ns: int,
        judgement: Judgement,
        unit: str,
        explain: Callable[[Judgement], Explanation] | None = None,
    ) -> list[Publication]:
        """Take the point of an alarm's chart in; returns the alarm if it changes.

        Args:
            alarm: one that was declared here.
            time_ns: of the sample.
            judgement: of the chart.
            unit: of the statistic.
            explain: asked for what to say if it is raised.
        """
        event = alarm.judge(time_ns, judgement, unit, explain)
        if event is None:
            return []
        self._change(alarm, event, time_ns)
        return [self._publication(alarm, event, time_ns)]

    def end_row(self, time_ns: int) -> list[Publication]:
        """End shelves whose time is over, and tell the figures after a change and each minute.

        Args:
            time_ns: of the row that all charts have now judged.
        """
        self.time_ns = time_ns
        publications: list[Publication] = []
        for alarm in self._shelved:
            memory = alarm.memory
            # A clock that was set back ends a shelf as well, which otherwise would last as much longer.
            if not memory.shelved_ns <= time_ns < memory.shelved_until_ns:
                self._change(alarm, Event.SHELF_TIME_OVER, time_ns)
                publications.append(self._publication(alarm, Event.SHELF_TIME_OVER, time_ns))
        minute = time_ns // MINUTE_NS
        if self._kpis_changed or minute != self._kpi_minute:
            publications.append(self._figures(time_ns))
        return publications

    def suspect(self, time_ns: int, suspects: list[SuspectedCause], *, stopped: bool = False) -> list[Publication]:
        """Tell what the alarms of the latest incident may come from: those that stand, and those that are yet to come.

        Args:
            time_ns: of the row that this was found at.
            suspects: the likeliest first.
            stopped: whether the search for them stopped at its budget, which the texts of the alarms then say.
        """
        publications: list[Publication] = []
        self._suspects = list(suspects)
        for alarm in self._alarms.values():
            memory = alarm.memory
            if alarm.tells_cause:
                continue
            if memory.rule.standing and memory.incident == self._incidents.state.number and memory.incident:
                memory.suspects = list(suspects)
                memory.text = memory.text.removesuffix(STOPPED) + (STOPPED if stopped else "")
                self.changes += 1
                publications.append(self._publication(alarm, SUSPECTED, time_ns))
        return publications

    @property
    def incident(self) -> int:
        """Number of the latest incident; 0: there was none yet."""
        return self._incidents.state.number

    # --- what people do --------------------------------------------------------------------------------------

    def act(self, name: str, event: Event, by: str, comment: str) -> list[Publication]:
        """Let a person do something to an alarm, other than shelve it.

        Args:
            name: of the alarm.
            event: what.
            by: who.
            comment: why; empty: the last comment stays.

        Raises:
            InputError: there is no such alarm, no sample has come yet, or the table of states refuses it.
        """
        alarm, time_ns = self._named(name), self._now_ns()
        self._change_by(alarm, event, time_ns, by, comment)
        return [self._publication(alarm, event, time_ns), self._figures(time_ns)]

    def shelve(self, name: str, minutes: float, by: str, comment: str) -> list[Publication]:
        """Let a person put an alarm out of sight for a time, or change the time.

        Args:
            name: of the alarm.
            minutes: how long, of plant time.
            by: who.
            comment: why; empty: the last comment stays.

        Raises:
            InputError: as `act`, or the time is not positive or too long.
        """
        alarm, time_ns = self._named(name), self._now_ns()
        longest = self._config.longest_shelf_min
        if not (isfinite(minutes) and 0 < minutes <= longest):
            raise InputError(f"minutes must be in (0, {longest:g}], which longest_shelf_min sets, got {minutes:g}")
        self._change_by(alarm, Event.SHELVE, time_ns, by, comment)
        alarm.memory.shelved_ns = time_ns
        alarm.memory.shelved_until_ns = min(time_ns + round(minutes * MINUTE_NS), LAST_NS)
        return [self._publication(alarm, Event.SHELVE, time_ns), self._figures(time_ns)]

    def comment(self, name: str, by: str, comment: str) -> list[Publication]:
        """Let a person say something about an alarm.

        Raises:
            InputError: there is no such alarm, no sample has come yet, or the comment is empty.
        """
        alarm, time_ns = self._named(name), self._now_ns()
        if not comment:
            raise InputError("comment must say something, got ''")
        self.changes += 1
        alarm.memory.by, alarm.memory.comment = by, comment
        return [self._publication(alarm, "comment", time_ns)]

    def alarm(self, name: str) -> Alarm:
        """An alarm as it is.

        Raises:
            InputError: there is no such alarm.
        """
        return self._named(name).message(self.time_ns or 0, "")

    def all_alarms(self) -> list[Alarm]:
        """All alarms as they are."""
        return [self.alarm(name) for name in self._alarms]

    # --- what survives a restart -----------------------------------------------------------------------------

    def to_bytes(self) -> bytes:
        """Everything that is remembered, as MessagePack."""
        state = BoardState(
            version=1,
            plant=self._config.plant,
            time_ns=self.time_ns,
            alarms=self._undeclared | {name: alarm.memory for name, alarm in self._alarms.items()},
            incident=self._incidents.state,
            kpis=self._kpis.state,
            suspects=self._suspects,
            kpi_minute=self._kpi_minute,
            kpis_changed=self._kpis_changed,
            told=None if self._told is None else self._told.SerializeToString(),
        )
        return msgspec.msgpack.encode(state)

    def from_bytes(self, data: bytes) -> None:
        """Go on from what `to_bytes` returned. Alarms that are not declared here are only stored again.

        Raises:
            InputError: the bytes are not that, or of another plant; everything is as before.
        """
        try:
            state = msgspec.msgpack.decode(data, type=BoardState)
            told = None if state.told is None else AlarmKpis.FromString(state.told)
        except (msgspec.DecodeError, UnicodeDecodeError, ProtobufDecodeError) as error:
            raise InputError(f"is no alarm state: {error}") from error
        if state.plant != self._config.plant:
            raise InputError(f"is the alarm state of plant {state.plant!r}, not of {self._config.plant!r}")
        for name, memory in state.alarms.items():
            if not fits(memory.state, standing=memory.rule.standing):
                stands = "stands" if memory.rule.standing else "does not stand"
                raise InputError(f"is no alarm state: {name} is {memory.state}, but its condition {stands}")
        for name in state.alarms.keys() & self._alarms.keys():
            self._alarms[name].memory = state.alarms[name]
        self._undeclared = {name: memory for name, memory in state.alarms.items() if name not in self._alarms}
        self._note()
        self.time_ns = state.time_ns
        self._incidents.state = state.incident
        self._kpis.state, self._told = state.kpis, told
        self._suspects = state.suspects
        self._kpi_minute, self._kpis_changed = state.kpi_minute, state.kpis_changed

    def go_on_from(self, alarms: Iterable[Alarm]) -> None:
        """Go on from what another monitor of the plant said last of its alarms, where nothing else is left of it.

        Args:
            alarms: the newest message of each. Those that are not declared here are left out, and so is what makes no
                state of an alarm.
        """
        incident = self._incidents.state
        for alarm in alarms:
            memory = remembered(alarm)
            if alarm.alarm in self._alarms and fits(memory.state, standing=memory.rule.standing):
                self._alarms[alarm.alarm].memory = memory
                if alarm.incident > incident.number or (alarm.incident == incident.number and alarm.first_in):
                    incident.number, incident.first_in = alarm.incident, alarm.alarm
                incident.changed_ns = max(incident.changed_ns, alarm.raised_ns, alarm.cleared_ns)
        self._note()

    # --- within ----------------------------------------------------------------------------------------------

    def _named(self, name: str) -> ChartAlarm:
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
            self._change(alarm, event, time_ns)
        except InputError as error:
            raise InputError(f"alarm {alarm.name} {error}") from error
        alarm.memory.by, alarm.memory.comment = by, comment or alarm.memory.comment

    def _change(self, alarm: ChartAlarm, event: Event, time_ns: int) -> None:
        memory = alarm.memory
        before = memory.state
        alarm.apply(event)
        if event is Event.CLEARED and (memory.first_in or alarm.name not in self._passing):
            self._incidents.cleared(time_ns, memory.incident)
        if memory.state is State.UNACKNOWLEDGED and before is not State.UNACKNOWLEDGED:
            self._kpis.came_up(time_ns, alarm.name, alarm.priority)
            if not memory.incident:
                joins = alarm.name in self._passing and self.has_unexplained
                memory.incident = self._incidents.came_up(time_ns, alarm.name, joins=joins)
                memory.first_in = self._incidents.state.first_in == alarm.name
                if memory.first_in:
                    self._suspects = []
                if not alarm.tells_cause:
                    memory.suspects = list(self._suspects)
        self._note()
        self.changes += 1
        self._kpis_changed = True

    def _note(self) -> None:
        """What is asked for at every row, and changes seldom."""
        alarms = self._alarms.values()
        self._shelved = [alarm for alarm in alarms if alarm.memory.state is State.SHELVED]
        self.has_unexplained = any(alarm.memory.rule.standing and not alarm.tells_cause for alarm in alarms)

    def _publication(self, alarm: ChartAlarm, event: str, time_ns: int) -> Publication:
        return Publication(keys.key(self._config.plant, keys.ALARM, alarm.name), alarm.message(time_ns, event))

    def _figures(self, time_ns: int) -> Publication:
        before = self._told
        if self._kpis_changed or before is None or before.standing or before.alarms_10min:
            counted = [
                Counted(alarm.name, alarm.priority, alarm.memory.state, alarm.memory.raised_ns)
                for alarm in self._alarms.values()
            ]
            told = self._kpis.figures(time_ns, counted, self._incidents.state.number)
        else:  # nothing that time alone would change
            told = AlarmKpis()
            told.CopyFrom(before)
            told.time_ns = time_ns
        self._kpi_minute, self._kpis_changed, self._told = time_ns // MINUTE_NS, False, told
        return Publication(self._kpi_key, told)
