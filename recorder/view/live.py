"""Live dashboard of a running plant: messages of the bus, streamed to a viewer, and the history before it joined.

The viewer is a process of its own and stores the data; memory here does not grow with the run. The set of views becomes
known in the first seconds of a run, so the layout is sent again with each new view.

Publishers store only the last minute. So the nodes that raise alarms are queried for those of the run before, and the
monitor's health report holds the time of the first sample.
"""

import threading
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import rerun as rr

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Encoded, Publication, encode, encode_message, encoding_of
from reactorwatch.contract.messages_pb2 import Alarm
from reactorwatch.description.process import Process
from reactorwatch.runtime.bus import Bus, Node
from recorder.columns import LISTED, SEGMENT_MESSAGES, RunReader
from recorder.panels import PANELS
from recorder.samples import content_of
from recorder.view.drawing import Renderer

_ALARM = encoding_of(Alarm)

DRAW_INTERVAL_NS = 500_000_000
"""Twice a second looks live; to draw message by message costs more than a viewer can take of a fast plant."""
ZERO_TIMEOUT_NS = 15_000_000_000
"""Three times the usual period of health reports."""
MAX_REMEMBERED = 10_000
"""Stored changes of alarms, so that a listed one is not drawn twice; bounded, as a run has no end."""

REPLY_TIMEOUT_S, RETRY_S = 5.0, 1.0
"""A node replies within milliseconds; one that has just been started may need some seconds, and is asked again."""
COMMANDS = {"monitor": "list_alarms", "recorder": keys.LIST_RECORDER_ALARMS}
"""Commands that list alarms, by the node that replies."""


class RunHistory(NamedTuple):
    """Alarms and zero of a run before a viewer joined it.

    Attributes:
        alarms: messages of the changes that led to the present state of the alarms, and of their incidents.
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
        for reply in map(content_of, bus.query(question, REPLY_TIMEOUT_S)):
            if isinstance(reply, messages.CommandReply):
                listed += reply.alarms
                answered.add(node)
    zeros_ns = [zero_of(message) for message in bus.query_history(keys.all_keys(plant, keys.HEALTH))]
    zero_ns = next((zero_ns for zero_ns in reversed(zeros_ns) if zero_ns is not None), None)
    alarms = [Publication(keys.key(plant, keys.ALARM, item.alarm), item) for item in alarm_changes(listed)]
    alarms += [Publication(keys.key(plant, keys.INCIDENT, str(item.number)), item) for item in incidents_of(listed)]
    return RunHistory(tuple(map(encode, alarms)), zero_ns, frozenset(answered))


class HistoryQuery:
    """Repeats a query when a node that lists alarms appears and has not replied before; never blocks."""

    def __init__(self, query: Callable[[], RunHistory], answered: frozenset[str] = frozenset()) -> None:
        self._query = query
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._waiting, self._answered = set[str](), set(answered)
        self._thread: threading.Thread | None = None
        self._answers: list[RunHistory] = []

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

    def answers(self) -> list[RunHistory]:
        """Replies since the last call."""
        with self._lock:
            answers, self._answers = self._answers, []
        return answers

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
            with self._lock:
                self._answers.append(past)
                self._answered |= past.answered & self._waiting
                self._waiting -= past.answered
                if not self._waiting:
                    self._thread = None
                    return
            self._ended.wait(RETRY_S)


def zero_of(message: Encoded) -> int | None:
    """Time of the first sample of a run, if the message is a health report of a monitor that holds it."""
    health = content_of(message)
    return min(health.heard_from_ns.values(), default=None) if isinstance(health, messages.Health) else None


def alarm_changes(listed: Iterable[messages.Alarm]) -> Iterator[messages.Alarm]:
    """Changes that led to the present state of alarms, as far as a list of alarms determines them.

    An alarm holds the times at which it was raised and cleared. The time of an acknowledgement or shelving is unknown,
    so it is dated now.
    """
    for alarm in listed:
        if alarm.state == messages.ALARM_STATE_NORMAL:
            continue
        if alarm.raised_ns:
            yield _change(alarm, alarm.raised_ns, "raised", messages.ALARM_STATE_UNACKNOWLEDGED)
        if alarm.cleared_ns and alarm.state == messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED:
            yield _change(alarm, alarm.cleared_ns, "cleared", alarm.state)
        elif alarm.state != messages.ALARM_STATE_UNACKNOWLEDGED:
            yield _change(alarm, alarm.time_ns, LISTED, alarm.state)


def incidents_of(listed: Iterable[messages.Alarm]) -> Iterator[messages.Incident]:
    """Incidents of listed alarms with their suspects, which are those of the last alarm, dated when it was raised."""
    last: dict[int, messages.Alarm] = {}
    for alarm in listed:
        is_shown = alarm.state != messages.ALARM_STATE_NORMAL and alarm.raised_ns and alarm.suspects
        if is_shown and alarm.raised_ns >= last.get(alarm.incident, alarm).raised_ns:
            last[alarm.incident] = alarm
    for number, alarm in last.items():
        yield messages.Incident(time_ns=alarm.raised_ns, number=number, suspects=alarm.suspects)


def _change(alarm: messages.Alarm, time_ns: int, event: str, state: messages.AlarmState) -> messages.Alarm:
    change = messages.Alarm()
    change.CopyFrom(alarm)
    change.time_ns, change.event, change.state = time_ns, event, state
    return change


class LiveDashboard(Node):
    """Draws received messages.

    Args:
        recording: stream to a viewer.
        is_closed: returns True once the viewer is closed.
        now_ns: clock reading.
        past: history of the run before the subscription.
        query: query for the history when a node appears; None never repeats it.
        process: process of the plant; None: unknown.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        is_closed: Callable[[], bool],
        now_ns: int,
        past: RunHistory = RunHistory(),  # noqa: B008 (it is frozen)
        query: HistoryQuery | None = None,
        process: Process | None = None,
    ) -> None:
        self._recording = recording
        self._is_closed = is_closed
        self._drawing = Renderer(recording)
        self._reader = RunReader(past.zero_ns, process)
        self._has_zero = past.zero_ns is not None
        # a fleet's monitor stores no health report: the next one holds the zero
        self._zero_within_ns = now_ns + (ZERO_TIMEOUT_NS if not self._has_zero and "monitor" in past.answered else 0)
        self._query = query
        self._known: dict[tuple[str, int, str], None] = {}  # changes of alarms, oldest first
        self._count = 0
        self._add(*past.alarms)
        self._next_ns = now_ns + DRAW_INTERVAL_NS

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """Collect a message until the next drawing."""
        if now_ns < self._zero_within_ns and not self._has_zero and (zero_ns := zero_of(message)) is not None:
            self._reader.set_zero(zero_ns)
            self._has_zero = True
        self._add(message)
        if self._count >= SEGMENT_MESSAGES or now_ns >= self._next_ns:
            self._draw(now_ns)
        return []

    def on_alive(self, token: str, is_alive: bool, _now_ns: int) -> list[Publication]:
        """Query a node that appears for its alarms."""
        if self._query is not None:
            self._query.on_alive(token, is_alive)
        return []

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Draw the collected messages."""
        for past in self._query.answers() if self._query is not None else ():
            self._add(*past.alarms)
        self._draw(now_ns)
        return []

    def next_tick_ns(self) -> int:
        """Time of the next drawing."""
        return self._next_ns

    @property
    def finished(self) -> bool:
        """True once the viewer is closed."""
        return self._is_closed()

    def on_stop(self, now_ns: int) -> list[Publication]:
        """Draw the last messages."""
        if self._query is not None:
            self._query.end()
        self._draw(now_ns)
        return []

    def _add(self, *received: Encoded) -> None:
        """Add messages, but those that repeat a change of an alarm, which was listed or received before."""
        for message in received:
            if (change := _alarm_change_key(message)) is not None:
                if change in self._known:
                    continue
                self._known[change] = None
                if len(self._known) > MAX_REMEMBERED:
                    del self._known[next(iter(self._known))]
            self._reader.add(message)
            self._count += 1

    def _draw(self, now_ns: int) -> None:
        self._next_ns = now_ns + DRAW_INTERVAL_NS
        has_samples = self._reader.has_samples
        is_waiting = not self._has_zero and (now_ns < self._zero_within_ns or not has_samples)
        if not self._count or (is_waiting and self._count < SEGMENT_MESSAGES):
            return
        self._count = 0
        run = self._reader.next_segment()
        if not (self._has_zero or has_samples):
            return  # the zero of the run is its first sample
        self._drawing.draw(run, PANELS)
        self._zero_within_ns = 0  # minutes of drawn data cannot change
        if self._drawing.layout.changed:
            self._recording.send_blueprint(self._drawing.layout.blueprint(live=True))


def _alarm_change_key(message: Encoded) -> tuple[str, int, str] | None:
    """Key, time and event of a change of an alarm; None for other messages."""
    if message.encoding != _ALARM:
        return None
    alarm = content_of(message)
    return (message.key, alarm.time_ns, alarm.event) if isinstance(alarm, Alarm) else None
