"""The bus as a client of a router has it."""

import contextlib
import secrets
import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from math import isfinite
from typing import Any, NamedTuple

import structlog
import zenoh
import zenoh.ext
from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, encode_message
from reactorwatch.runtime.bus import MOST_GATHERED, Request
from reactorwatch.runtime.bus_zenoh.messages import (
    LONGEST_ENCODING,
    NUMBERED,
    Reader,
    first_line,
    is_of_whole_streams,
    is_wild,
    numbered,
    payload_of,
    spelled,
)
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.delivery.delivery import Delivery, Numbered
from reactorwatch.runtime.delivery.reorder_buffer import Gap, InOrder
from reactorwatch.runtime.delivery.streams import STREAM_PARTS, keys_of, stream_of
from reactorwatch.runtime.security.acl import MEMORY, NOBODY

log = structlog.get_logger()

FLUSH_WITHIN_S = 10.0
HEARTBEAT_S = 0.5
EVERY_ROW = frozenset({keys.SAMPLE, keys.ESTIMATE, keys.RECONSTRUCTION, keys.CHART})
"""Kinds that are published with every row, apart from `SELDOM_CHARTS`. What is published less often would fill
`cache_messages` for days."""
SELDOM_CHARTS = frozenset({"parameters"})
MOST_KEPT_OF_OTHERS = 600
"""Messages kept on each key of another kind: of what is published each plant minute, `history_s` at `--speed 600`."""
LAST_RECOVERY_S = 1.0  # that a bus stays open after its last message, so that who missed it can ask for it
MOST_NEW_KEYS, NEW_KEYS_A_S = 1000, 100
"""Of what is told again and again: keys that are declared at once, and in each second after that."""
GATHER_AGAIN_S = 0.005
LOG_AGAIN_S = 60.0
LARGEST_CHANNEL = 5 * MOST_GATHERED
MOST_GATHERED_BYTES = 1 << 20

HISTORY_WITHIN_S = 10.0
LONGEST_WAY_S = 5.0  # that a message takes to us; what is missing was published so much before what came instead of it
LAST_AGAIN_S = 20.0
"""On a bus with certificates: between two questions for the last number on each key.

Zenoh's subscriber numbers messages by their source, which it reads from the message. A client that forges the source of
another role's publisher, on keys of its own, makes it drop what that publisher sends next, without a sign of it. The
answers of publishers do not pass that subscriber, and show what is missing.
"""
MOST_ASKED = 4  # times for what was before; what was published while the answers came may be missing


@dataclass(frozen=True)
class ZenohRequest:
    """A question from the network."""

    query: zenoh.Query
    question: Encoded

    def reply(self, message: Message) -> None:
        """Answer it."""
        payload, encoding = encode_message(message)
        self.query.reply(self.question.key, payload, encoding=encoding)
        self.query.drop()

    def leave(self) -> None:
        """See `Request`: who asked waits until nobody holds his question any more."""
        self.query.drop()


@dataclass
class _Key:
    """What is published on a key."""

    publisher: zenoh.ext.AdvancedPublisher
    stream: str


class _Answers(NamedTuple):
    """What publishers remember.

    Attributes:
        messages: they have published.
        are_complete: whether every publisher has answered in time.
    """

    messages: list[Numbered]
    are_complete: bool


class ZenohBus:
    """See `reactorwatch.runtime.bus.Bus`."""

    def __init__(
        self,
        session: zenoh.Session,
        config: BusConfig,
        passing: Collection[str] = (),
        voice: zenoh.Session | None = None,
    ) -> None:
        self._session = session
        self._voice = voice or session  # by which all is done but listening to what is published
        self._passing = frozenset(passing)
        self._passing_keys: dict[str, zenoh.Publisher] = {}
        self._new_keys, self._new_keys_at = float(MOST_NEW_KEYS), time.monotonic()  # that may be declared now
        self._config = config
        self._name = secrets.randbits(64)
        self._keys: dict[str, _Key] = {}
        self._numbers: dict[str, int] = {}  # the next one of each stream
        self._publishing = threading.Lock()  # what is numbered first goes out first
        self._published_at: float | None = None
        self._declared: list[Any] = []  # Zenoh undeclares what nobody holds
        self._tokens: dict[str, Any] = {}
        self._deliveries: list[Delivery] = []
        self._wild = 0  # messages on many keys at once
        self._wild_logged_at: float | None = None
        self._closed = threading.Event()
        self._gathering: list[threading.Thread] = []

    def publish(self, message: Encoded) -> None:
        """See `Bus`."""
        if self._passing and message.key.split("/", STREAM_PARTS)[STREAM_PARTS - 1] in self._passing:
            self._pass_on(message)
            return
        with self._publishing:
            key = self._keys.get(message.key)
            if key is None:
                key = self._keys[message.key] = self._declare(message.key)
            number = self._numbers[key.stream]
            self._numbers[key.stream] = number + 1
            attachment = NUMBERED.pack(self._name, number)
            key.publisher.put(message.payload, encoding=message.encoding, attachment=attachment)
            self._published_at = time.monotonic()

    def _pass_on(self, message: Encoded) -> None:
        """Publish what is told again and again; on a new key only if there were not too many of those lately.

        A router with 30,000 keys takes 5 ms for what comes on one that was not declared, and 2 ms for a declaration.
        """
        publisher = self._passing_keys.get(message.key)
        if publisher is None:
            now_s = time.monotonic()
            self._new_keys = min(self._new_keys + NEW_KEYS_A_S * (now_s - self._new_keys_at), MOST_NEW_KEYS)
            self._new_keys_at = now_s
            if self._new_keys < 1:
                return
            self._new_keys -= 1
            publisher = self._passing_keys[message.key] = self._voice.declare_publisher(message.key)
        publisher.put(message.payload, encoding=message.encoding)

    def subscribe(
        self,
        key_expression: str,
        handler: Callable[[Encoded], None],
        *,
        on_gap: Callable[[Gap], None] | None = None,
        history_s: float = 0.0,
        on_told: Callable[[], None] | None = None,
    ) -> None:
        """See `Bus`."""

        def hand_on(messages: list[Encoded]) -> None:
            for message in messages:
                handler(message)

        delivery = self._delivery(key_expression, hand_on, on_gap)

        def on_sample(sample: zenoh.Sample) -> None:
            if is_wild(str(sample.key_expr)):
                self._refuse_wild(str(sample.key_expr))
                return
            came = numbered(sample, time.time_ns())
            if delivery is None or isinstance(came, Encoded):  # or it is of no publisher of ours
                handler(came if isinstance(came, Encoded) else came.message)
            else:
                delivery.receive((came,))

        self._listen(key_expression, on_sample)
        if delivery is not None:
            self._begin(delivery, key_expression, history_s, on_told)
        elif on_told is not None:
            on_told()

    def gather(
        self,
        key_expression: str,
        handler: Callable[[list[Encoded]], None],
        *,
        on_gap: Callable[[Gap], None] | None = None,
        history_s: float = 0.0,
        on_told: Callable[[], None] | None = None,
    ) -> None:
        """See `Bus`.

        Zenoh calls a handler from a thread of its own, and each call waits for Python's lock. Here it puts what comes
        into a channel, and one thread empties it: half the time a message. Having handed on what there was, it waits
        for a moment before it looks again: where much comes, more comes together, and what is alone is not delayed.
        """
        delivery = self._delivery(key_expression, handler, on_gap)
        # Of the channel alone: nobody could undeclare a subscriber that is just being asked.
        channel = self._listen(key_expression, zenoh.handlers.FifoChannel(LARGEST_CHANNEL)).handler

        def empty() -> None:
            reader = Reader()
            with contextlib.suppress(zenoh.ZError):  # it is closed
                while True:
                    sample, now_ns = channel.recv(), time.time_ns()
                    came, others = list[tuple[int, int, Encoded]](), list[Encoded]()
                    left, room = MOST_GATHERED, MOST_GATHERED_BYTES
                    while sample is not None:
                        who, message = reader.read(sample, now_ns)
                        if is_wild(message.key):
                            self._refuse_wild(message.key)
                        elif who is None or delivery is None:
                            others.append(message)
                        else:
                            came.append((*who, message))
                        left, room = left - 1, room - len(message.payload)
                        sample = channel.try_recv() if left and room > 0 else None
                    if others:
                        handler(others)
                    if delivery is not None and came:
                        delivery.receive(came)
                    time.sleep(GATHER_AGAIN_S)

        self._gathering.append(threading.Thread(target=empty, name="gather", daemon=True))
        self._gathering[-1].start()
        if delivery is not None:
            self._begin(delivery, key_expression, history_s, on_told)
        elif on_told is not None:
            on_told()

    def subscribe_live(self, key_expression: str, handler: Callable[[Encoded], None]) -> None:
        """Subscribe to what is published from now on, each message as it comes.

        `subscribe` also gets what publishers remember, which it asks for as soon as it learns that it missed something.
        """

        def on_sample(sample: zenoh.Sample) -> None:
            handler(Reader(sample.encoding).read(sample, time.time_ns())[1])

        self._declared.append(self._session.declare_subscriber(spelled(key_expression), on_sample))

    def _delivery(
        self,
        key_expression: str,
        handler: Callable[[list[Encoded]], None],
        on_gap: Callable[[Gap], None] | None,
    ) -> Delivery | None:
        """What keeps the order of whole streams; None for less than that."""
        if not is_of_whole_streams(key_expression):
            return None
        delivery = Delivery(handler, on_gap or _say_gap, self._asked_again)
        self._deliveries.append(delivery)
        if self._config.ca is not None:
            arguments = (delivery, key_expression)
            threading.Thread(target=self._ask_for_last, args=arguments, name="last numbers", daemon=True).start()
        return delivery

    def _ask_for_last(self, delivery: Delivery, key_expression: str) -> None:
        """See `LAST_AGAIN_S`; ends with the bus."""
        while not self._closed.wait(LAST_AGAIN_S):
            with contextlib.suppress(zenoh.ZError):  # it is being closed
                delivery.receive(self._remembered(key_expression, "_max=1").messages)

    def _listen(self, key_expression: str, handler: Any) -> Any:
        """Subscribe, with a callback or a channel."""
        recovery = zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None)
        subscriber = zenoh.ext.declare_advanced_subscriber(
            self._session, spelled(key_expression), handler, recovery=recovery
        )
        self._declared.append(subscriber)
        return subscriber

    def _begin(
        self, delivery: Delivery, key_expression: str, history_s: float, on_told: Callable[[], None] | None
    ) -> None:
        """Ask for what was before, and let what comes go on."""
        # The subscriber's own question for what was before left out keys that were being published on meanwhile.
        for _ in range(MOST_ASKED):
            answers = self._remembered(key_expression, "_max=1")
            for last in answers.messages:
                delivery.tell_last(last)
            if answers.are_complete:
                break
        began, missing = time.monotonic(), history_s > 0.0
        since_s = history_s
        for _ in range(MOST_ASKED):
            if not missing:
                break
            answers = self._remembered(key_expression, _published_since(since_s))
            for came in answers.messages:
                delivery.tell(came)
            missing = not (answers.are_complete and delivery.is_told())
            waited_s = time.monotonic() - began
            since_s = HEARTBEAT_S + waited_s if answers.are_complete else history_s + waited_s
        if missing or not answers.are_complete:
            log.warning(
                "publishers did not answer in time; what they published before may be missing", keys=key_expression
            )
        # In a thread of its own: the handler may wait for who called us.
        threading.Thread(target=delivery.begin, args=(on_told,), daemon=True).start()

    @property
    def has_router(self) -> bool:
        """See `Bus`."""
        try:
            return all(session.info.routers_zid() for session in (self._session, self._voice))
        except zenoh.ZError:  # it is closed
            return False

    def recall(self, key_expression: str) -> list[Encoded]:
        """See `Bus`."""
        order: InOrder[Encoded] = InOrder(gathering=True)
        with contextlib.suppress(zenoh.ZError):  # it is closed
            for _ in range(MOST_ASKED):
                answers = self._remembered(key_expression, _published_since(self._config.history_s))
                for came in answers.messages:
                    order.tell(came.publisher, came.stream, came.message.key, came.number, came.message)
                if answers.are_complete:
                    break
        told = list(order.gathered(0))
        while (due_ns := order.due_ns()) is not None:  # what is missing is not waited for
            told += order.overdue(due_ns)
        return [item for item in told if isinstance(item, Encoded)]

    def _asked_again(self, stream: str, since_s: float) -> list[Numbered]:
        """What publishers remember of a stream."""
        try:
            return self._remembered(keys_of(stream), _published_since(since_s + LONGEST_WAY_S)).messages
        except zenoh.ZError as error:  # the bus is being closed, for instance
            log.info("cannot ask for what is missing", stream=stream, why=first_line(error))
            return []

    def _remembered(self, key_expression: str, which: str) -> "_Answers":
        """Ask the publishers for what they remember of what they have published."""
        replies = self._session.get(
            f"{spelled(key_expression)}/{MEMORY}?{which}",
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=HISTORY_WITHIN_S,
        )
        messages, complete = list[Numbered](), True
        for reply in replies:
            if reply.ok is None:  # on a busy machine: Zenoh's word that one of them did not answer in time
                complete = False
                continue
            came = numbered(reply.ok, time.time_ns())
            if isinstance(came, Numbered) and not is_wild(came.message.key):
                messages.append(came)
        return _Answers(messages, complete)

    def _refuse_wild(self, key: str) -> None:
        """Count a message on many keys at once, which none of our publishers sends, and log it once a minute."""
        self._wild += 1
        now_s = time.monotonic()
        if self._wild_logged_at is None or now_s - self._wild_logged_at >= LOG_AGAIN_S:
            self._wild_logged_at = now_s
            log.warning("refused: a message must be on one key", key=key[:LONGEST_ENCODING], so_far=self._wild)

    def _declare(self, key: str) -> _Key:
        stream = stream_of(key)
        self._numbers.setdefault(stream, 0)
        # Of the same priority as all else: of a lower one, the word that this was all would overtake the replies.
        again = zenoh.ext.RepliesConfig(congestion_control=zenoh.CongestionControl.BLOCK)
        drop = self._config.congestion == "drop"
        publisher = zenoh.ext.declare_advanced_publisher(
            self._voice,
            key,
            congestion_control=zenoh.CongestionControl.DROP if drop else zenoh.CongestionControl.BLOCK,
            cache=zenoh.ext.CacheConfig(most_kept(key, self._config.cache_messages), replies_config=again),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None),
            publisher_detection=True,
        )
        return _Key(publisher, stream)

    def answer(self, key_expression: str, handler: Callable[[Request], None]) -> None:
        """See `Bus`."""

        def on_query(query: zenoh.Query) -> None:
            payload = query.payload
            data = payload_of(payload) if payload is not None else b""
            question = Encoded(str(query.key_expr), data, str(query.encoding)[:LONGEST_ENCODING])
            handler(ZenohRequest(query, question))

        self._declared.append(self._voice.declare_queryable(spelled(key_expression), on_query))

    def ask(self, question: Encoded, timeout_s: float) -> list[Encoded]:
        """See `Bus`."""
        replies = self._voice.get(question.key, payload=question.payload, encoding=question.encoding, timeout=timeout_s)
        answers = (reply.ok for reply in replies)
        return [
            Encoded(str(answer.key_expr), answer.payload.to_bytes(), str(answer.encoding))
            for answer in answers
            if answer is not None
        ]

    def announce(self, key: str) -> None:
        """See `Bus`."""
        self._tokens[key] = self._voice.liveliness().declare_token(key)

    def withdraw(self, key: str) -> None:
        """See `Bus`."""
        self._tokens.pop(key).undeclare()

    def watch_alive(self, key_expression: str, handler: Callable[[str, bool], None]) -> None:
        """See `Bus`."""

        def on_token(sample: zenoh.Sample) -> None:
            handler(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._declared.append(
            self._voice.liveliness().declare_subscriber(spelled(key_expression), on_token, history=True)
        )

    def close(self) -> None:
        """See `Bus`.

        A question to nobody goes the way of the messages before it, and its end comes back from the router: then they
        are all there. Zenoh's own close was never seen to drop what is queued (neither with the router stopped for a
        second nor under load), but it promises nothing; this does, for one round trip. What was thrown away on a full
        network is told once more by then, and can be asked for as long as this bus is open.
        """
        self._closed.set()
        if self._published_at is not None:
            time.sleep(max(0.0, self._published_at + LAST_RECOVERY_S - time.monotonic()))
        for _ in self._voice.get(NOBODY, timeout=FLUSH_WITHIN_S):
            pass
        # Advanced ones may outlive the session otherwise, and hang the process (eclipse-zenoh/zenoh-python#624).
        for declared in (*self._declared, *self._tokens.values(), *(key.publisher for key in self._keys.values())):
            with contextlib.suppress(zenoh.ZError):
                declared.undeclare()
        self._session.close()
        if self._voice is not self._session:
            self._voice.close()
        for delivery in self._deliveries:
            delivery.close()
        # A thread that is in Zenoh's code when the interpreter ends aborts the process: "exception not rethrown".
        for thread in self._gathering:
            if thread is not threading.current_thread():
                thread.join(FLUSH_WITHIN_S)


def most_kept(key: str, cache_messages: int) -> int:
    """Return how many messages a publisher keeps on a key.

    Args:
        key: The key.
        cache_messages: Messages that are kept on a key that is published with every row.
    """
    topic = keys.parse(key)
    is_of_every_row = topic is not None and topic.kind in EVERY_ROW and topic.name.split("/")[0] not in SELDOM_CHARTS
    return cache_messages if is_of_every_row else min(cache_messages, MOST_KEPT_OF_OTHERS)


def _published_since(seconds: float) -> str:
    """What to ask a publisher's memory for."""
    return f"_time=[now(-{seconds}s)..]" if isfinite(seconds) else ""


def _say_gap(gap: Gap) -> None:
    log.warning("messages lost on the way", stream=gap.stream, messages=gap.messages)
