"""The past of a run that a viewer joins late: its active alarms, and the time that its minutes count from.

Publishers remember the last minute only. So the nodes that raise alarms are asked for them, and the monitor's report of
health says when the run's first sample came.
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

ANSWER_WITHIN_S = 5.0
AGAIN_S = 1.0
COMMANDS = {"monitor": "list_alarms", "recorder": keys.LIST_RECORDER_ALARMS}
"""Commands that list alarms, by the node that answers them."""


class Past(NamedTuple):
    """Alarms and zero of a run before a viewer joined it.

    Attributes:
        alarms: messages of the changes that led to the alarms' present state.
        zero_ns: the time of the run's first sample; None: no monitor says it.
        answered: the nodes that listed their alarms.
    """

    alarms: tuple[Encoded, ...] = ()
    zero_ns: int | None = None
    answered: frozenset[str] = frozenset()


def ask_for_past(bus: Bus, plant: str) -> Past:
    """Ask the nodes of a plant for its past; nodes that are not there are not waited for."""
    listed, answered = list[messages.Alarm](), set[str]()
    for node, command in COMMANDS.items():
        question = Encoded(keys.key(plant, keys.COMMAND, command), *encode_message(messages.ListAlarms()))
        for reply in _decoded(bus.query(question, ANSWER_WITHIN_S)):
            if isinstance(reply, messages.CommandReply):
                listed += reply.alarms
                answered.add(node)
    zero_ns: int | None = None
    for message in bus.query_history(keys.all_keys(plant, keys.HEALTH)):
        said_ns = zero_of(message)
        zero_ns = zero_ns if said_ns is None else said_ns
    alarms = (encode(Publication(keys.key(plant, keys.ALARM, item.alarm), item)) for item in changes(listed))
    return Past(tuple(alarms), zero_ns, frozenset(answered))


class PastQuery:
    """Asks for the past of a plant again when a node that lists alarms appears, until it answers; never blocks.

    Args:
        ask: what is asked: `ask_for_past`.
        answered: nodes that have answered before.
    """

    def __init__(self, ask: Callable[[], Past], answered: frozenset[str] = frozenset()) -> None:
        self._ask = ask
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._waiting, self._answered = set[str](), set(answered)
        self._thread: threading.Thread | None = None
        self._answers: SimpleQueue[Past] = SimpleQueue()

    def on_alive(self, token: str, is_alive: bool) -> None:
        """Take note that a node came or went; one that came again, as after a restart, is asked again."""
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
                    self._thread = threading.Thread(target=self._ask_until_answered, name="past", daemon=True)
                    self._thread.start()

    def answers(self) -> Iterator[Past]:
        """The answers that came since the last call."""
        with contextlib.suppress(Empty):
            while True:
                yield self._answers.get_nowait()

    def end(self) -> None:
        """Ask no more, before the bus is closed."""
        self._ended.set()
        with self._lock:
            thread = self._thread
        if thread is not None:
            thread.join()

    def _ask_until_answered(self) -> None:
        while not self._ended.is_set():
            past = self._ask()
            self._answers.put(past)
            with self._lock:
                self._answered |= past.answered & self._waiting
                self._waiting -= past.answered
                if not self._waiting:
                    self._thread = None
                    return
            self._ended.wait(AGAIN_S)


def zero_of(message: Encoded) -> int | None:
    """The time of a run's first sample, if a message is a monitor's report of health that says it."""
    for health in _decoded([message]):
        if isinstance(health, messages.Health) and health.heard_from_ns:
            return min(health.heard_from_ns.values())
    return None


def changes(listed: Iterable[messages.Alarm]) -> Iterator[messages.Alarm]:
    """The changes that led to the present state of alarms, as far as a list of them tells.

    An alarm was raised, and perhaps cleared, when it says; that it is acknowledged or shelved is known from now on. The
    suspects of an incident stand at its last alarm.
    """
    last: dict[int, messages.Alarm] = {}  # of each incident
    for alarm in listed:
        if alarm.state == messages.ALARM_STATE_NORMAL:
            continue
        if alarm.raised_ns:
            yield _changed(alarm, alarm.raised_ns, "raised", messages.ALARM_STATE_UNACKNOWLEDGED)
            if alarm.suspects and alarm.raised_ns >= last.get(alarm.incident, alarm).raised_ns:
                last[alarm.incident] = alarm
        if alarm.cleared_ns and alarm.state == messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED:
            yield _changed(alarm, alarm.cleared_ns, "cleared", alarm.state)
        elif alarm.state != messages.ALARM_STATE_UNACKNOWLEDGED:
            yield _changed(alarm, alarm.time_ns, LISTED, alarm.state)
    for alarm in last.values():
        yield _changed(alarm, alarm.raised_ns, SUSPECTED, messages.ALARM_STATE_UNACKNOWLEDGED)


def _changed(alarm: messages.Alarm, time_ns: int, event: str, state: messages.AlarmState) -> messages.Alarm:
    change = messages.Alarm()
    change.CopyFrom(alarm)
    change.time_ns, change.event, change.state = time_ns, event, state
    return change


def _decoded(came: Iterable[Encoded]) -> Iterator[Message]:
    for item in came:
        with contextlib.suppress(DecodeError):
            yield decode(item.payload, item.encoding)
