"""Does a recording replay? The monitor's core over the samples of a recording, held against what was recorded of it.

What a monitor says follows from its settings, the samples that it heard, what people did to its alarms, and whether
the clock of receipt told a silence of the plant. The last two are read off the recording (`recorded_sessions`); the
samples are those of the recording in the order of their receipt, which is the order in which the plant published
them for every subscriber. The first sample that the monitor heard is known from its reports of health. If it is not in
the recording, the monitor had learned from what nobody recorded, and nothing it said can be verified.

A monitor that was started anew while the recording was made is verified from there on as another. One that went on from
a stored state is verified as if it had never stopped; what it then said once more is passed over.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import islice

from monitor_node.alarms.states import Event
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.replay.message_diff import Comparison
from monitor_node.replay.recorded_sessions import Life, is_silence, lives_in
from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode
from reactorwatch.contract.messages_pb2 import Alarm, Sample
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.runtime.model_file import read_model_on_bus_clock

COMPARED = frozenset({keys.ESTIMATE, keys.MODEL, keys.CHART, keys.ALARM, keys.ALARM_KPIS, keys.RECONSTRUCTION})
"""The kinds of messages that follow from the samples; health does not."""

MOST_REPEATED = 10_000
"""On a key: what may have been said between the last time that a monitor was stored and its end."""


@dataclass
class Verification:
    """What came of it.

    Attributes:
        comparison: of what was recorded with what is said again.
        rows: that were judged again.
        first_ns: time of the first of them; 0 if there is none.
        notes: what people have to know of it.
    """

    comparison: Comparison
    rows: int = 0
    first_ns: int = 0
    notes: list[str] = field(default_factory=list)

    @property
    def exact(self) -> bool:
        """Whether everything is said again as it was recorded."""
        return not self.comparison.differing


def verify(read: Callable[[], Iterable[Encoded]], config: MonitorConfig) -> Verification:
    """Hold a recording against itself.

    Args:
        read: gives the messages of the recording in the order of their receipt, each time it is called, without what a
            file says again of the one before it.
        config: of the monitor that watched.

    Raises:
        InputError: there is nothing in it that could be verified, or the settings cannot be used.
    """
    lives = lives_in(read(), config.plant)
    model = read_model_on_bus_clock(config.model)
    found = Verification(Comparison())
    stored: bytes | None = None
    verified = 0
    for life in lives:
        why = _unknown(life, read, config)
        if why:
            found.notes.append(why)
            continue
        replay = _Replay(config, model, life, found.comparison)
        if stored is not None:
            replay.monitor.alarms.from_bytes(stored)
        replay.run(read())
        found.comparison.finish()
        verified += 1
        if config.alarm_state_file is not None:
            stored = replay.monitor.alarms.to_bytes()
            if life is lives[0]:
                found.notes.append("the state of alarms before the recording, from alarm_state_file, is not known")
        if life.lost:
            found.notes.append(f"{life.lost} samples did not reach the monitor, by its own account")
        found.rows += replay.monitor.rows
        found.first_ns = found.first_ns or replay.monitor.first_ns or 0
    if not verified:
        raise InputError(f"cannot be verified: {found.notes[0]}")
    if len(lives) > 1:
        found.notes.append(f"the monitor was started {len(lives)} times; {verified} of these runs were verified")
    if not any(count.recorded for count in found.comparison.counts.values()):
        raise InputError("holds nothing that a monitor said of its samples, so there is nothing to verify")
    return found


def _unknown(life: Life, read: Callable[[], Iterable[Encoded]], config: MonitorConfig) -> str:
    """Why it is not known what a monitor had heard; empty if it is."""
    if life.fresh and not life.heard_from_ns:
        return ""
    missing = dict(life.heard_from_ns)
    for message in islice(read(), life.end) if missing else ():
        topic = keys.parse(message.key)
        if topic is None or topic[:2] != (config.plant, keys.SAMPLE):
            continue
        if topic.name in missing and _time_ns(message) == missing[topic.name]:
            del missing[topic.name]
            if not missing:
                return ""
    heard = f"the first samples of {', '.join(missing)} that it heard are" if missing else "what it had heard is"
    return (
        f"the monitor was running before this recording begins: {heard} not in it, nor what it learned from them; "
        "verify the folder of all its files, or the file in which it was started"
    )


class _Replay:
    """One life of a monitor once more."""

    def __init__(self, config: MonitorConfig, model: ProcessModel | None, life: Life, comparison: Comparison) -> None:
        self.monitor = Monitor(config, start_ns=0, model=model)
        self._config = config
        self._life = life
        self._comparison = comparison
        self._waited_for = dict(life.heard_from_ns)
        self._newest: dict[str, dict[bytes, None]] = {}
        signals = (config.input, *config.outputs)
        self._signals = {keys.key(config.plant, keys.SAMPLE, signal): signal for signal in signals}

    def run(self, messages: Iterable[Encoded]) -> None:
        """Go through the recording."""
        life = self._life
        for number, message in enumerate(islice(messages, life.end)):
            if message.key in self._signals:
                if life.heard_from_ns or number >= life.first:
                    self._hear(message)
            elif number >= life.first:
                topic = keys.parse(message.key)
                if topic is None or topic.plant != self._config.plant or topic.kind not in COMPARED:
                    continue
                if not (topic.name.startswith(f"{keys.RECORDING}/") or self._is_repeated(message)):
                    self._comparison.recorded(message, topic.kind)

    def _is_repeated(self, message: Encoded) -> bool:
        """Whether it was said before, by a monitor that since then went on from what it had stored."""
        if len(self._life.starts_s) == 1:
            return False
        newest = self._newest.setdefault(message.key, {})
        if message.payload in newest:
            return True
        newest[message.payload] = None
        if len(newest) > MOST_REPEATED:
            del newest[next(iter(newest))]
        return False

    def _hear(self, message: Encoded) -> None:
        signal = self._signals[message.key]
        if signal in self._waited_for:
            if _time_ns(message) != self._waited_for[signal]:
                return
            del self._waited_for[signal]
        self._comparison.again(self.monitor.on_message(message, message.received_ns))
        told = self._life.told
        while told and self._has_come(told[0]):
            self._comparison.again(self._what_no_sample_told(told.popleft()))

    def _has_come(self, alarm: Alarm) -> bool:
        """Whether it was before the next row that the clock, or a person, made the monitor say this."""
        now_ns = self.monitor.silent_from_ns if is_silence(alarm) else self.monitor.alarms.time_ns
        return now_ns is not None and alarm.time_ns <= now_ns

    def _what_no_sample_told(self, alarm: Alarm) -> list[Publication]:
        if is_silence(alarm):
            return self.monitor.fall_silent() if alarm.time_ns == self.monitor.silent_from_ns else []
        return self._act(alarm)

    def _act(self, alarm: Alarm) -> list[Publication]:
        board = self.monitor.alarms
        try:
            if alarm.event == "comment":
                return board.comment(alarm.alarm, alarm.by, alarm.comment)
            if alarm.event == Event.SHELVE:
                minutes = (alarm.shelved_until_ns - alarm.time_ns) / MINUTE_NS
                return board.shelve(alarm.alarm, minutes, alarm.by, alarm.comment)
            return board.act(alarm.alarm, Event(alarm.event), alarm.by, alarm.comment)
        except InputError:
            return []  # it is then missing in what is said again


def _time_ns(message: Encoded) -> int | None:
    try:
        sample = decode(message.payload, message.encoding)
    except DecodeError:
        return None
    return sample.time_ns if isinstance(sample, Sample) else None
