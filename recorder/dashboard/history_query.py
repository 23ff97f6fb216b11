"""Query the history of a run that a viewer joins late: its active alarms, and the time that minutes count from.

Publishers store only the last minute. So the nodes that raise alarms are queried for them, and the monitor's health
report holds the time of the first sample.
"""

import contextlib
import threading
from collections.abc import Callable, Iterable, Iterator
from queue import Empty, SimpleQueue
from typing import NamedTuple

from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode, encode, encode_message
from reactorwatch.runtime.bus import Bus
from recorder.columns.run_reader import LISTED, SUSPECTED

REPLY_TIMEOUT_S = 5.0
RETRY_S = 1.0
COMMANDS = {"monitor": "list_alarms", "recorder": keys.LIST_RECORDER_ALARMS}
"""Commands that list alarms, by the node that replies."""


class RunHistory(NamedTuple):
    """Alarms and zero of a run before a viewer joined it.

    Attributes:
        alarms: messages of the changes that led to the present state of the alarms.
        zero_ns: time of the first sample of the run; None if no monitor reports it.
        answered: nodes that listed their alarms.
    """

    alarms: tuple[Encoded, ...] = ()
    zero_ns: int | None = None
    answered: frozenset[str] = frozenset()


def query_history(bus: Bus, plant: str) -> RunHistory:
    """Query the nodes of a plant for its history, without waiting for absent nodes."""
    listed, answered = list[messages.Alarm](), set[str]()
    for node, command in COMMANDS.items():
        question = Encoded(keys.key(plant, keys.COMMAND, command), *encode_message(messages.ListAlarms()))
        for reply in _decode_all(bus.query(question, REPLY_TIMEOUT_S)):
            if isinstance(reply, messages.CommandReply):
                listed += reply.alarms
                answered.add(node)
    zero_ns: int | None = None
    for message in bus.query_history(keys.all_keys(plant, keys.HEALTH)):
        reported_ns = zero_of(message)
        zero_ns = zero_ns if reported_ns is None else reported_ns
    alarms = (encode(Publication(keys.key(plant, keys.ALARM, item.alarm), item)) for item in alarm_changes(listed))
    return RunHistory(tuple(alarms), zero_ns, frozenset(answered))


class HistoryQuery:
    """Repeats the query when a node that lists alarms appears, until it replies; never blocks.

    Args:
        query: `query_history`.
        answered: nodes that have replied before.
    """

    def __init__(self, query: Callable[[], RunHistory], answered: frozenset[str] = frozenset()) -> None:
        self._query = query
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._waiting, self._answered = set[str](), set(answered)
        self._thread: threading.Thread | None = None
        self._answers: SimpleQueue[RunHistory] = SimpleQueue()

    def on_alive(self, token: str, is_alive: bool) -> None:
        """Process that a node appeared or disappeared; one that appears again, as after a restart, is queried again."""
        topic = keys.parse(token)
        if topic is None or topic.name not in COMMANDS:
            return
        with self._lock:
            if not is_alive:
                self._answered.discard(topic.name)
                self._waiting.discard(topic.name)
            elif topic.name not in self._answered:
                self._waiting.add(topic.name)
                if self._thread is None:
                    self._thread = threading.Thread(target=self._query_until_answered, name="past", daemon=True)
                    self._thread.start()

    def answers(self) -> Iterator[RunHistory]:
        """Replies since the last call."""
        with contextlib.suppress(Empty):
            while True:
                yield self._answers.get_nowait()

    def end(self) -> None:
        """Stop querying, before the bus is closed."""
        self._ended.set()
        with self._lock:
            thread = self._thread
        if thread is not None:
            thread.join()

    def _query_until_answered(self) -> None:
        while not self._ended.is_set():
            past = self._query()
            self._answers.put(past)
            with self._lock:
                self._answered |= past.answered & self._waiting
                self._waiting -= past.answered
                if not self._waiting:
                    self._thread = None
                    return
            self._ended.wait(RETRY_S)


def zero_of(message: Encoded) -> int | None:
    """Time of the first sample of a run, if the message is a health report of a monitor that holds it."""
    for health in _decode_all([message]):
        if isinstance(health, messages.Health) and health.heard_from_ns:
            return min(health.heard_from_ns.values())
    return None


def alarm_changes(listed: Iterable[messages.Alarm]) -> Iterator[messages.Alarm]:
    """Changes that led to the present state of alarms, as far as a list of alarms determines them.

    An alarm holds the times at which it was raised and cleared. The time of an acknowledgement or shelving is unknown,
    so it is dated now. The suspects of an incident are those of its last alarm.
    """
    last: dict[int, messages.Alarm] = {}  # of each incident
    for alarm in listed:
        if alarm.state == messages.ALARM_STATE_NORMAL:
            continue
        if alarm.raised_ns:
            yield _change(alarm, alarm.raised_ns, "raised", messages.ALARM_STATE_UNACKNOWLEDGED)
            if alarm.suspects and alarm.raised_ns >= last.get(alarm.incident, alarm).raised_ns:
                last[alarm.incident] = alarm
        if alarm.cleared_ns and alarm.state == messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED:
            yield _change(alarm, alarm.cleared_ns, "cleared", alarm.state)
        elif alarm.state != messages.ALARM_STATE_UNACKNOWLEDGED:
            yield _change(alarm, alarm.time_ns, LISTED, alarm.state)
    for alarm in last.values():
        yield _change(alarm, alarm.raised_ns, SUSPECTED, messages.ALARM_STATE_UNACKNOWLEDGED)


def _change(alarm: messages.Alarm, time_ns: int, event: str, state: messages.AlarmState) -> messages.Alarm:
    change = messages.Alarm()
    change.CopyFrom(alarm)
    change.time_ns, change.event, change.state = time_ns, event, state
    return change


def _decode_all(encoded: Iterable[Encoded]) -> Iterator[Message]:
    for item in encoded:
        with contextlib.suppress(DecodeError):
            yield decode(item.payload, item.encoding)
