"""Verify a recording: replay its samples through the monitor's core, and compare the publications.

A monitor's publications follow from its settings, its samples, operators' actions, data timeouts in receive time, and
the row at which the diagnosis of the training changed the model. Actions, timeouts and the change are read from the
recording (`recorded_sessions`). The samples are those of the recording in the
order of receipt, which is the publisher's order for every subscriber. The monitor's first sample is known from its
health messages. If it is not in the recording, the monitor was trained on samples that were not recorded, and cannot be
verified.

A monitor that was restarted without a state starts a new session. One that resumed from a stored state is verified as
if it had never stopped; messages that it published again are ignored.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import islice

from monitor_node.alarms.states import Event
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.replay.message_diff import MessageDiff
from monitor_node.replay.recorded_sessions import Session, find_sessions, is_timeout
from monitor_node.watched_process import load_process, watch_process
from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode
from reactorwatch.contract.messages_pb2 import Alarm, Sample
from reactorwatch.description.process import Process
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS

COMPARED = frozenset(
    {
        *(keys.ESTIMATE, keys.MODEL, keys.CHART, keys.ALARM, keys.ALARM_KPIS, keys.RECONSTRUCTION),
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
    stored: bytes | None = None
    verified = 0
    for session in sessions:
        why = _unknown_history(session, read, config)
        if why:
            found.notes.append(why)
            continue
        replay = _Replay(config, model, session, found.diff)
        if stored is not None:
            replay.monitor.alarms.from_bytes(stored)
        replay.run(read())
        found.diff.finish()
        verified += 1
        if config.alarm_state_file is not None:
            stored = replay.monitor.alarms.to_bytes()
            if session is sessions[0]:
                found.notes.append("the state of alarms before the recording, from alarm_state_file, is not known")
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


def _unknown_history(session: Session, read: Callable[[], Iterable[Encoded]], config: MonitorConfig) -> str:
    """Reason why a session's first samples are unknown; empty if they are known."""
    if session.fresh and not session.heard_from_ns:
        return ""
    missing = dict(session.heard_from_ns)
    for message in islice(read(), session.end) if missing else ():
        topic = keys.parse(message.key)
        if topic is None or topic[:2] != (config.plant, keys.SAMPLE):
            continue
        if topic.name in missing and _time_ns(message) == missing[topic.name]:
            del missing[topic.name]
            if not missing:
                return ""
    unknown = f"the first samples of {', '.join(missing)} that it received are" if missing else "its earlier input is"
    return (
        f"the monitor was running before this recording begins: {unknown} not in it; "
        "verify the folder of all its files, or the file in which it was started"
    )


class _Replay:
    """Replay of one session."""

    def __init__(self, config: MonitorConfig, model: ProcessModel | None, session: Session, diff: MessageDiff) -> None:
        self.monitor = Monitor(config, start_ns=0, model=model)
        for baseline in session.baselines:
            self.monitor.schedule(baseline)
        self._config = config
        self._session = session
        self._diff = diff
        self._waited_for = dict(session.heard_from_ns)
        self._newest: dict[str, dict[bytes, None]] = {}
        signals = (*config.signals, *config.carried_signals)
        self._signals = {keys.key(config.plant, keys.SAMPLE, signal): signal for signal in signals}

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
                    self._diff.add_recorded(message, topic.kind)

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
        self._diff.add_replayed(self.monitor.on_message(message, message.received_ns))
        events = self._session.events
        while events and self._is_due(events[0]):
            self._diff.add_replayed(self._replay_event(events.popleft()))

    def _is_due(self, alarm: Alarm) -> bool:
        """True if an operator's action or a data timeout was before the next row."""
        now_ns = self.monitor.silence.of_plant.deadline_ns() if is_timeout(alarm) else self.monitor.alarms.time_ns
        return now_ns is not None and alarm.time_ns <= now_ns

    def _replay_event(self, alarm: Alarm) -> list[Publication]:
        silence, board = self.monitor.silence, self.monitor.alarms
        if is_timeout(alarm):
            return silence.declare_timeout() if alarm.time_ns == silence.of_plant.deadline_ns() else []
        try:
            if alarm.event == "comment":
                return board.comment(alarm.alarm, alarm.by, alarm.comment)
            if alarm.event == Event.SHELVE:
                minutes = (alarm.shelved_until_ns - alarm.time_ns) / MINUTE_NS
                return board.shelve(alarm.alarm, minutes, alarm.by, alarm.comment)
            return board.act(alarm.alarm, Event(alarm.event), alarm.by, alarm.comment)
        except InputError:
            return []  # the replay then lacks it


def _time_ns(message: Encoded) -> int | None:
    try:
        sample = decode(message.payload, message.encoding)
    except DecodeError:
        return None
    return sample.time_ns if isinstance(sample, Sample) else None
