"""Verify a recording: replay its samples through the monitor's core, and compare the publications.

A monitor's publications follow from its settings, its samples, operators' actions, data timeouts in receive time, and
the row at which the diagnosis of the training changed the model. The samples are those of the recording in the order of
receipt, which is the publisher's order for every subscriber. Actions and timeouts are read from the recorded alarms: an
action has the time of the newest row; a timeout in receive time has the time at which the next row was overdue, which
shows after which row it was raised.

A session is from the start of a monitor to its end. Sessions are distinguished by their health messages, which have a
time and an up-time, and the time of each signal's first sample. If that is not in the recording, the monitor was
trained on samples that were not recorded, and cannot be verified. A monitor that was restarted without a state starts a
new session. One that resumed from a stored state continues the session, with the same first samples, and is verified as
if it had never stopped; messages that it published again are ignored.
"""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

from monitor_node.alarms.annunciator import Action
from monitor_node.checks.signal_checks import SilenceCheck
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.replay.message_diff import MessageDiff
from monitor_node.watched_process import load_process, watch_process
from reactorwatch.contract import keys
from reactorwatch.contract.alarm_states import Event
from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode
from reactorwatch.contract.messages_pb2 import Alarm, Baseline, Health, Sample
from reactorwatch.description.process import Process
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS

MONITOR = "monitor"
TIMEOUT_ALARM = keys.chart_name(SilenceCheck.name, "plant")

ACTIONS = frozenset(
    {"comment", *(event.value for event in Event if event not in (Event.RAISED, Event.CLEARED, Event.SHELF_TIME_OVER))}
)
"""Events of operators' actions."""

SAME_START_S = 0.01
"""Tolerance of a start; the time and up-time of a health message are rounded."""


@dataclass
class Session:
    """Session of a monitor.

    Attributes:
        starts_s: times of the start and of restarts, in seconds since 1970-01-01 UTC.
        first: index of the first message of the recording that may belong to the session.
        end: index of the first message that may belong to the next session; None: there is none.
        fresh: True if the first health message was sent before the first sample.
        heard_from_ns: time of the first sample by signal; empty if unknown.
        lost: number of lost samples that the monitor reported.
        events: operators' actions and data timeouts, in order.
        baselines: changes of the baseline, in order.
    """

    starts_s: list[float]
    first: int
    end: int | None = None
    fresh: bool = False
    heard_from_ns: dict[str, int] = field(default_factory=dict)
    lost: int = 0
    events: deque[Alarm] = field(default_factory=deque)
    baselines: list[Baseline] = field(default_factory=list)


def find_sessions(messages: Iterable[Encoded], plant: str) -> list[Session]:
    """Find the sessions of a plant's monitors in a recording, in order.

    Args:
        messages: messages in order of receipt, without latched messages.
        plant: name of the plant.

    Raises:
        InputError: there is no health message of a monitor, or those of two monitors at the same time.
    """
    wanted = {keys.key(plant, kind, MONITOR) for kind in (keys.HEALTH, keys.BASELINE)}
    alarms = keys.key(plant, keys.ALARM, "")
    sessions: list[Session] = []
    before: deque[Alarm] = deque()  # of a monitor without a health message so far
    early: list[Baseline] = []  # of the same
    for number, message in enumerate(messages):
        if message.key not in wanted and not message.key.startswith(alarms):
            continue
        try:
            body: Any = decode(message.payload, message.encoding)
        except DecodeError:
            continue
        if isinstance(body, Health):
            if body.phase == keys.BLOCKED:
                continue  # it had not started
            _report(sessions, body, number)
        elif isinstance(body, Baseline):
            baselines = sessions[-1].baselines if sessions else early
            if body not in baselines:  # a monitor that resumes publishes it again
                baselines.append(body)
        elif isinstance(body, Alarm) and _is_from_monitor(body) and (body.event in ACTIONS or is_timeout(body)):
            (sessions[-1].events if sessions else before).append(body)
    if not sessions:
        raise InputError(f"holds no report of health of a monitor of plant {plant!r}, so there is nothing to verify")
    sessions[0].first = 0
    sessions[0].events = before + sessions[0].events
    sessions[0].baselines[:0] = [item for item in early if item not in sessions[0].baselines]
    return sessions


def _is_from_monitor(alarm: Alarm) -> bool:
    """True if an alarm is the monitor's, and not the recorder's."""
    return not alarm.alarm.startswith(f"{keys.RECORDING}/")


def is_timeout(alarm: Alarm) -> bool:
    """True if an alarm is a raised data timeout of the plant."""
    return alarm.alarm == TIMEOUT_ALARM and alarm.event == Event.RAISED


def _report(sessions: list[Session], health: Health, number: int) -> None:
    start_s = health.time_ns / 1e9 - health.uptime_s
    known = [session for session in sessions if any(abs(item - start_s) <= SAME_START_S for item in session.starts_s)]
    if not known and sessions and _is_resumed(sessions[-1], health):
        sessions[-1].starts_s.append(start_s)
    elif not known:
        if sessions:
            sessions[-1].end = number
        sessions.append(Session([start_s], number, fresh=health.phase == "waiting"))
    elif known[0] is not sessions[-1]:
        raise InputError("holds the reports of two monitors of the plant at the same time; verify takes one")
    sessions[-1].heard_from_ns.update(health.heard_from_ns)
    sessions[-1].lost = health.lost


def _is_resumed(session: Session, health: Health) -> bool:
    """True if the first health message after a start continues a session.

    A new session's first health message has the phase `waiting`. A session too short for a second one has no first
    samples.
    """
    heard_from_ns = dict(health.heard_from_ns)
    return health.phase != "waiting" and (
        heard_from_ns == session.heard_from_ns or (session.fresh and not session.heard_from_ns)
    )


COMPARED = frozenset(
    {
        *(keys.ESTIMATE, keys.MODEL, keys.CHART, keys.ALARM, keys.INCIDENT, keys.ALARM_KPIS, keys.RECONSTRUCTION),
        *(keys.BASELINE, keys.PROMISE),
    }
)
"""Kinds of messages that follow from the samples; health does not."""

MOST_REPEATED = 10_000
"""Messages of a key that a monitor may have published after its last stored state."""


@dataclass
class Verification:
    """Result of a verification.

    Attributes:
        diff: differences between recorded and replayed messages.
        rows: number of replayed rows.
        first_ns: time of the first of them; 0 if there is none.
        notes: notes on the verification.
    """

    diff: MessageDiff
    rows: int = 0
    first_ns: int = 0
    notes: list[str] = field(default_factory=list)

    @property
    def exact(self) -> bool:
        """True if every message is replayed as recorded."""
        return not self.diff.differing


def verify(
    read: Callable[[], Iterable[Encoded]], config: MonitorConfig, process: Process | None = None
) -> Verification:
    """Verify a recording.

    Args:
        read: returns the messages of the recording in order of receipt, without latched messages, at each call.
        config: settings of the recorded monitor.
        process: process of the plant; None: the one that the settings name.

    Raises:
        InputError: nothing in the recording can be verified, or the settings are inconsistent.
    """
    sessions = find_sessions(read(), config.plant)
    config, model = load_process(config) if process is None else watch_process(config, process)
    found = Verification(MessageDiff())
    verified = 0
    for session in sessions:
        replay = _Replay(config, model, session)
        if session.fresh or session.heard_from_ns:
            replay.run(read())
        if replay.unknown:
            found.notes.append(
                f"the monitor was running before this recording begins: {replay.unknown} not in it; "
                "verify the folder of all its files, or the file in which it was started"
            )
            continue
        replay.diff.finish()
        found.diff.add(replay.diff)
        verified += 1
        if session.lost:
            found.notes.append(f"{session.lost} samples did not reach the monitor, by its own account")
        found.rows += replay.monitor.rows
        found.first_ns = found.first_ns or replay.monitor.memory.first_ns or 0
    if not verified:
        raise InputError(f"cannot be verified: {found.notes[0]}")
    if len(sessions) > 1:
        found.notes.append(f"the monitor was started {len(sessions)} times; {verified} of these runs were verified")
    if not any(count.recorded for count in found.diff.counts.values()):
        raise InputError("holds no message of a monitor on its samples, so there is nothing to verify")
    return found


class _Replay:
    """Replay of one session."""

    def __init__(self, config: MonitorConfig, model: ProcessModel | None, session: Session) -> None:
        self.monitor = Monitor(config, start_ns=0, model=model)
        for baseline in session.baselines:
            self.monitor.schedule(baseline)
        self._config = config
        self._session = session
        self.diff = MessageDiff()
        self._newest: dict[str, dict[bytes, None]] = {}
        signals = (*config.signals, *config.carried_signals)
        self._waited_for = {name: time for name, time in session.heard_from_ns.items() if name in signals}
        self._signals = {keys.key(config.plant, keys.SAMPLE, signal): signal for signal in signals}

    @property
    def unknown(self) -> str:
        """Samples of the session that the recording lacks; empty if it begins with the session's first."""
        if self._waited_for:
            return f"the first samples of {', '.join(self._waited_for)} that it received are"
        return "" if self._session.fresh or self._session.heard_from_ns else "its earlier input is"

    def run(self, messages: Iterable[Encoded]) -> None:
        """Replay the recording."""
        session = self._session
        for number, message in enumerate(islice(messages, session.end)):
            if message.key in self._signals:
                if session.heard_from_ns or number >= session.first:
                    self._on_sample(message)
            elif number >= session.first:
                topic = keys.parse(message.key)
                if topic is None or topic.plant != self._config.plant or topic.kind not in COMPARED:
                    continue
                if not (topic.name.startswith(f"{keys.RECORDING}/") or self._is_repeated(message)):
                    self.diff.add_recorded(message, topic.kind)

    def _is_repeated(self, message: Encoded) -> bool:
        """True if a message was published before by a monitor that then resumed from its stored state."""
        if len(self._session.starts_s) == 1:
            return False
        newest = self._newest.setdefault(message.key, {})
        if message.payload in newest:
            return True
        newest[message.payload] = None
        if len(newest) > MOST_REPEATED:
            del newest[next(iter(newest))]
        return False

    def _on_sample(self, message: Encoded) -> None:
        signal = self._signals[message.key]
        if signal in self._waited_for:
            if _time_ns(message) != self._waited_for[signal]:
                return
            del self._waited_for[signal]
        self.diff.add_replayed(self.monitor.on_message(message, message.received_ns))
        events = self._session.events
        while events and self._is_due(events[0]):
            self.diff.add_replayed(self._replay_event(events.popleft()))

    def _is_due(self, alarm: Alarm) -> bool:
        """True if an operator's action or a data timeout was before the next row."""
        if is_timeout(alarm) and self.monitor.silence.is_unusable:
            return True
        silence, alarms = self.monitor.silence.of_plant, self.monitor.alarms.memory
        now_ns = silence.deadline_ns() if is_timeout(alarm) else alarms.time_ns
        return now_ns is not None and alarm.time_ns <= now_ns

    def _replay_event(self, alarm: Alarm) -> list[Publication]:
        silence, board = self.monitor.silence, self.monitor.alarms
        if is_timeout(alarm):
            if silence.is_unusable:
                return silence.declare_unusable(alarm.time_ns)
            if alarm.time_ns != silence.of_plant.deadline_ns():
                return []
            return silence.declare_timeout(alarm.time_ns)
        try:
            action: Action = "comment" if alarm.event == "comment" else Event(alarm.event)
            minutes = (alarm.shelved_until_ns - alarm.time_ns) / MINUTE_NS
            return board.act(alarm.alarm, action, alarm.by, alarm.comment, minutes)
        except InputError:
            return []  # the replay then lacks it


def _time_ns(message: Encoded) -> int | None:
    try:
        sample = decode(message.payload, message.encoding)
    except DecodeError:
        return None
    return sample.time_ns if isinstance(sample, Sample) else None
