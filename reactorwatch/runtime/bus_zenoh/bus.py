"""A client of the bus."""

import contextlib
import secrets
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from math import inf
from typing import Any, Unpack

import structlog
import zenoh
import zenoh.ext

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime.acl import CACHE_SUFFIX, NO_QUERYABLE
from reactorwatch.runtime.bus import MAX_BATCH, Request, SubscribeOptions
from reactorwatch.runtime.bus_zenoh.messages import (
    MAX_ENCODING,
    SEQUENCE_ATTACHMENT,
    WILDCARD,
    ReadSample,
    SampleReader,
    ZenohRequest,
    cache_size,
    first_line,
    history_selector,
    matches_whole_streams,
    read_batch,
    truncated_payload,
    zenoh_expression,
)
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.delivery import STREAM_PARTS, Delivery, SequencedMessage, keys_of, stream_of
from reactorwatch.runtime.reorder_buffer import Gap, ReorderBuffer

log = structlog.get_logger()

HEARTBEAT_S = 0.5  # of a publisher, by which a subscriber notices that the last messages are missing
PRIORITY = zenoh.Priority.DATA_HIGH
"""Above Zenoh's default, so that publishers that are no nodes do not fill the queues of a link."""
MAX_INCIDENTS = 100
"""Incidents of a plant whose last message is cached: each is a key of its own, and a plant goes on for years."""
MAX_NEW_KEYS, NEW_KEYS_PER_S = 1000, 100
"""Keys of uncached kinds that are declared at once, and in each second after that."""

LAST = "_max=1"
"""Selector of the last message that a publisher caches on each key."""
HISTORY_WITHIN_S = 10.0  # in which Zenoh, too, gives a query up
LAST_QUERY_PERIOD_S = 20.0
"""Period of queries for the last number on each key, on a bus with certificates.

Zenoh's subscriber counts messages by their source, which it reads from the message. A client that forges the source of
another role's publisher, on its own keys, makes the subscriber silently drop that publisher's next messages. The
replies of publishers bypass the subscriber, and show which are missing.
"""
MAX_QUERIES = 4  # of caches, while a publisher does not reply in time


class ZenohBus:
    """See `reactorwatch.runtime.bus.Bus`."""

    def __init__(
        self,
        session: zenoh.Session,
        config: BusConfig,
        uncached: Collection[str] = (),
        voice: zenoh.Session | None = None,
    ) -> None:
        self._session = session
        self._voice = voice or session  # the session for all but subscriptions
        self._uncached = frozenset(uncached)
        self._uncached_publishers: dict[str, zenoh.Publisher] = {}
        self._new_keys, self._new_keys_at = float(MAX_NEW_KEYS), time.monotonic()  # token bucket of declarations
        self._config = config
        self._name = secrets.randbits(64)
        self._publishers: dict[str, tuple[zenoh.ext.AdvancedPublisher, str]] = {}  # and their streams, by key
        self._numbers = Counter[str]()  # next number of each stream
        self._publishing = threading.Lock()  # messages are sent in the order of their numbers
        self._published_at: float | None = None
        self._declared: list[Any] = []  # Zenoh undeclares objects without a reference
        self._tokens: dict[str, Any] = {}
        self._deliveries: list[Delivery] = []
        self._wildcards = 0  # messages published on many keys at once
        self._wildcard_logged_at: float | None = None
        self._closed = threading.Event()
        self._batch_threads: list[threading.Thread] = []

    def publish(self, message: Encoded) -> None:
        """See `Bus`."""
        if self._uncached and message.key.split("/", STREAM_PARTS)[STREAM_PARTS - 1] in self._uncached:
            self._publish_uncached(message)
            return
        with self._publishing:
            if message.key not in self._publishers:
                stream = stream_of(message.key)
                self._forget_incidents(stream)
                self._publishers[message.key] = self._declare_publisher(message.key), stream
            publisher, stream = self._publishers[message.key]
            number = self._numbers[stream]
            self._numbers[stream] = number + 1
            attachment = SEQUENCE_ATTACHMENT.pack(self._name, number)
            publisher.put(message.payload, encoding=message.encoding, attachment=attachment)
            self._published_at = time.monotonic()

    def _forget_incidents(self, stream: str) -> None:
        """Undeclare the oldest publishers of a plant's incidents before another is declared, see `MAX_INCIDENTS`."""
        if stream.endswith(f"/{keys.INCIDENT}"):
            declared = [key for key, (_, of) in self._publishers.items() if of == stream]
            for key in declared[: max(0, 1 + len(declared) - MAX_INCIDENTS)]:
                self._publishers.pop(key)[0].undeclare()

    def _publish_uncached(self, message: Encoded) -> None:
        """Publish without cache and number; on a new key only if there were not too many new ones lately.

        A router with 30,000 keys takes 5 ms for a message on an undeclared key, and 2 ms for a declaration.
        """
        publisher = self._uncached_publishers.get(message.key)
        if publisher is None:
            now_s = time.monotonic()
            self._new_keys = min(self._new_keys + NEW_KEYS_PER_S * (now_s - self._new_keys_at), MAX_NEW_KEYS)
            self._new_keys_at = now_s
            if self._new_keys < 1:
                return
            self._new_keys -= 1
            publisher = self._uncached_publishers[message.key] = self._voice.declare_publisher(message.key)
        publisher.put(message.payload, encoding=message.encoding)

    def subscribe(
        self, key_expression: str, handler: Callable[[Encoded], None], **options: Unpack[SubscribeOptions]
    ) -> None:
        """See `Bus`."""

        def handle_each(messages: list[Encoded]) -> None:
            for message in messages:
                handler(message)

        delivery = self._make_delivery(key_expression, handle_each, options)

        def on_sample(sample: zenoh.Sample) -> None:
            self._sort_out([SampleReader(sample.encoding).read(sample, time.time_ns())], delivery, handle_each)

        self._declare_subscriber(key_expression, on_sample)
        self._start(delivery, key_expression, options)

    def subscribe_batched(
        self, key_expression: str, handler: Callable[[list[Encoded]], None], **options: Unpack[SubscribeOptions]
    ) -> None:
        """See `Bus`.

        Zenoh calls a handler from a thread of its own, and each call waits for Python's lock. Here it puts messages
        into a channel that one thread empties, in half the time a message. After each batch the thread pauses: under
        load batches get larger, and a single message is not delayed.
        """
        delivery = self._make_delivery(key_expression, handler, options)
        # The thread holds the channel alone: a subscriber in use cannot be undeclared.
        channel = self._declare_subscriber(key_expression, zenoh.handlers.FifoChannel(5 * MAX_BATCH)).handler

        def empty() -> None:
            reader = SampleReader()
            with contextlib.suppress(zenoh.ZError):  # it is closed
                while True:
                    self._sort_out(read_batch(channel, reader), delivery, handler)
                    time.sleep(0.005)

        self._batch_threads.append(threading.Thread(target=empty, name="gather", daemon=True))
        self._batch_threads[-1].start()
        self._start(delivery, key_expression, options)

    def _sort_out(
        self, read: Iterable[ReadSample], delivery: Delivery | None, handler: Callable[[list[Encoded]], None]
    ) -> None:
        """Deliver numbered messages in order, and hand over others at once."""
        numbered, others = list[tuple[int, int, Encoded]](), list[Encoded]()
        for origin, message in read:
            if WILDCARD in message[0]:
                self._refuse_wildcard(message.key)
            elif origin is None or delivery is None:  # its publisher does not number messages
                others.append(message)
            else:
                numbered.append((origin[0], origin[1], message))
        if others:
            handler(others)
        if delivery is not None and numbered:
            delivery.receive(numbered)

    def subscribe_uncached(self, key_expression: str, handler: Callable[[Encoded], None]) -> None:
        """Subscribe to live messages only, each as it arrives.

        `subscribe` also queries publishers' caches as soon as a message is missing.
        """

        def on_sample(sample: zenoh.Sample) -> None:
            message = SampleReader(sample.encoding).read(sample, time.time_ns())[1]
            if WILDCARD in message.key:
                self._refuse_wildcard(message.key)
            else:
                handler(message)

        self._declared.append(self._session.declare_subscriber(zenoh_expression(key_expression), on_sample))

    def _make_delivery(
        self, key_expression: str, handler: Callable[[list[Encoded]], None], options: SubscribeOptions
    ) -> Delivery | None:
        """Ordered delivery for an expression that matches whole streams; None for another."""
        if not matches_whole_streams(key_expression):
            return None
        late_rows = options.get("late_rows", inf)
        delivery = Delivery(handler, options.get("on_gap") or _log_gap, self._query_stream, late_rows)
        self._deliveries.append(delivery)
        if self._config.ca is not None:
            arguments = (delivery, key_expression)
            threading.Thread(target=self._query_last_numbers, args=arguments, name="last numbers", daemon=True).start()
        return delivery

    def _query_last_numbers(self, delivery: Delivery, key_expression: str) -> None:
        """See `LAST_QUERY_PERIOD_S`; ends with the bus."""
        while not self._closed.wait(LAST_QUERY_PERIOD_S):
            with contextlib.suppress(zenoh.ZError):  # it is being closed
                delivery.receive(self._query_cache(key_expression, LAST)[0])

    def _declare_subscriber(self, key_expression: str, handler: Any) -> Any:
        """Subscribe, with a callback or a channel."""
        recovery = zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None)
        subscriber = zenoh.ext.declare_advanced_subscriber(
            self._session, zenoh_expression(key_expression), handler, recovery=recovery
        )
        self._declared.append(subscriber)
        return subscriber

    def _start(self, delivery: Delivery | None, key_expression: str, options: SubscribeOptions) -> None:
        """Query the history and start delivery."""
        on_history_end, history_s = options.get("on_history_end"), options.get("history_s", 0.0)
        if delivery is None:
            if on_history_end is not None:
                on_history_end()
            return
        # The subscriber's own query of the history left out keys that were being published on meanwhile.
        is_complete = False
        for newest, all_replied in self._query_caches(key_expression, lambda _waited_s: LAST):
            is_complete = all_replied
            for last in newest:
                delivery.set_last(last)
        if history_s > 0.0:  # half of it: these messages are recent enough for the queries that follow, too
            for last in self._query_cache(key_expression, f"{LAST};{history_selector(0.5 * history_s)}")[0]:
                delivery.set_last(last, is_recent=True)
        started, missing, most = time.monotonic(), history_s > 0.0, Counter[str]()
        for number in range(MAX_QUERIES if missing else 0):
            # Mostly only a message is missing that was published during the first query.
            since_s = HEARTBEAT_S if number == 1 and is_complete else history_s
            selector = history_selector(since_s + time.monotonic() - started)
            history, is_complete = self._query_cache(key_expression, selector)
            new = sum([delivery.add_history(earlier) for earlier in history])
            counts = Counter(earlier.message.key for earlier in history)
            # What a second query of all does not bring either, publishers do not have: unless replies were lost again.
            is_all = number > 1 and not new and counts >= most
            most |= counts
            missing = not (is_complete and (delivery.history_complete() or is_all))
            if not missing:
                break
        if missing or not is_complete:
            log.warning(
                "publishers did not answer in time; what they published before may be missing", keys=key_expression
            )
        # In a thread of its own: the handler may wait for the caller.
        threading.Thread(target=delivery.start, args=(on_history_end,), daemon=True).start()

    def flush_deliveries(self) -> None:
        """See `Bus`."""
        for delivery in self._deliveries:
            delivery.flush_deliveries()

    @property
    def has_router(self) -> bool:
        """See `Bus`."""
        try:
            return all(session.info.routers_zid() for session in (self._session, self._voice))
        except zenoh.ZError:  # it is closed
            return False

    def query_history(self, key_expression: str) -> list[Encoded]:
        """See `Bus`."""
        buffer: ReorderBuffer[Encoded] = ReorderBuffer(await_history=True)
        with contextlib.suppress(zenoh.ZError):  # it is closed
            selector = history_selector(self._config.history_s)
            for messages, _ in self._query_caches(key_expression, lambda _waited_s: selector):
                for sent in messages:
                    buffer.add_history(sent.publisher, sent.stream, sent.message.key, sent.number, sent.message)
        released = list(buffer.end_history(0))
        while (due_ns := buffer.due_ns()) is not None:  # missing messages are not waited for
            released += buffer.release_overdue(due_ns)
        return [item for item in released if isinstance(item, Encoded)]

    def _query_stream(self, stream: str, since_s: float) -> list[SequencedMessage]:
        """Messages of a stream from publishers' caches."""
        messages = list[SequencedMessage]()
        try:
            for replies, _ in self._query_caches(
                # a missing message was published at most 5 s before its predecessor arrived
                keys_of(stream),
                lambda waited_s: history_selector(since_s + waited_s + 5.0),
            ):
                messages += replies
        except zenoh.ZError as error:  # the bus is being closed, for instance
            log.info("cannot query missing messages", stream=stream, why=first_line(error))
        return messages

    def _query_caches(
        self, key_expression: str, selector: Callable[[float], str]
    ) -> Iterator[tuple[list[SequencedMessage], bool]]:
        """Yield replies until all publishers reply in time; `selector` depends on the seconds waited."""
        started = time.monotonic()
        for _ in range(MAX_QUERIES):
            replies, is_complete = self._query_cache(key_expression, selector(time.monotonic() - started))
            yield replies, is_complete
            if is_complete:
                return

    def _query_cache(self, key_expression: str, which: str) -> tuple[list[SequencedMessage], bool]:
        """Query the publishers' caches once; returns their messages, and True if every publisher replied in time."""
        replies = self._session.get(
            f"{zenoh_expression(key_expression)}/{CACHE_SUFFIX}?{which}",
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=HISTORY_WITHIN_S,
        )
        messages, is_complete = list[SequencedMessage](), True
        for reply in replies:
            if reply.ok is None:  # Zenoh: a publisher did not reply in time, on a busy machine
                is_complete = False
                continue
            origin, message = SampleReader(reply.ok.encoding).read(reply.ok, time.time_ns())
            if origin is not None and WILDCARD not in message.key:
                messages.append(SequencedMessage(*origin, message))
        return messages, is_complete

    def _refuse_wildcard(self, key: str) -> None:
        """Count a message on many keys at once, which no node sends, and log it once a minute."""
        self._wildcards += 1
        now_s = time.monotonic()
        if self._wildcard_logged_at is None or now_s - self._wildcard_logged_at >= 60.0:
            self._wildcard_logged_at = now_s
            log.warning("refused: a message must be on one key", key=key[:MAX_ENCODING], so_far=self._wildcards)

    def _declare_publisher(self, key: str) -> zenoh.ext.AdvancedPublisher:
        # Not below the priority of the end of a reply, which would overtake the replies.
        replies = zenoh.ext.RepliesConfig(congestion_control=zenoh.CongestionControl.BLOCK, priority=PRIORITY)
        drop = self._config.congestion == "drop"
        return zenoh.ext.declare_advanced_publisher(
            self._voice,
            key,
            congestion_control=zenoh.CongestionControl.DROP if drop else zenoh.CongestionControl.BLOCK,
            priority=PRIORITY,
            cache=zenoh.ext.CacheConfig(cache_size(key, self._config.cache_messages), replies_config=replies),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None),
            publisher_detection=True,
        )

    def declare_queryable(self, key_expression: str, handler: Callable[[Request], None]) -> None:
        """See `Bus`."""

        def on_query(query: zenoh.Query) -> None:
            payload = query.payload
            data = truncated_payload(payload) if payload is not None else b""
            question = Encoded(str(query.key_expr), data, str(query.encoding)[:MAX_ENCODING])
            handler(ZenohRequest(query, question))

        self._declared.append(self._voice.declare_queryable(zenoh_expression(key_expression), on_query))

    def query(self, question: Encoded, timeout_s: float) -> list[Encoded]:
        """See `Bus`."""
        replies = self._voice.get(question.key, payload=question.payload, encoding=question.encoding, timeout=timeout_s)
        answers = (reply.ok for reply in replies)
        return [
            Encoded(str(answer.key_expr), answer.payload.to_bytes(), str(answer.encoding))
            for answer in answers
            if answer is not None
        ]

    def declare_token(self, key: str) -> None:
        """See `Bus`."""
        self._tokens[key] = self._voice.liveliness().declare_token(key)

    def undeclare_token(self, key: str) -> None:
        """See `Bus`."""
        self._tokens.pop(key).undeclare()

    def query_tokens(self, key_expression: str) -> list[str]:
        """See `Bus`."""
        replies = self._voice.liveliness().get(zenoh_expression(key_expression), timeout=HISTORY_WITHIN_S)
        return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)

    def subscribe_liveliness(self, key_expression: str, handler: Callable[[str, bool], None]) -> None:
        """See `Bus`."""

        def on_token(sample: zenoh.Sample) -> None:
            handler(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._declared.append(
            self._voice.liveliness().declare_subscriber(zenoh_expression(key_expression), on_token, history=True)
        )

    def close(self) -> None:
        """See `Bus`.

        A query without a queryable takes the way of the messages before it, and the router ends it: then they have all
        arrived. Zenoh's own close was never seen to drop queued messages (neither with the router stopped for a second
        nor under load), but does not guarantee it; this does, for one round trip. Subscribers have learnt by then of
        messages dropped on a congested network, and can recover them as long as this bus is open.
        """
        self._closed.set()
        if self._published_at is not None:
            time.sleep(max(0.0, self._published_at + 1.0 - time.monotonic()))
        for _ in self._voice.get(NO_QUERYABLE, timeout=10.0):
            pass
        # Advanced ones may outlive the session otherwise, and hang the process (eclipse-zenoh/zenoh-python#624).
        for declared in (
            *self._declared,
            *self._tokens.values(),
            *(publisher for publisher, _ in self._publishers.values()),
        ):
            with contextlib.suppress(zenoh.ZError):
                declared.undeclare()
        self._session.close()
        if self._voice is not self._session:
            self._voice.close()
        for delivery in self._deliveries:
            delivery.close()
        # A thread that is in Zenoh's code when the interpreter ends aborts the process: "exception not rethrown".
        for thread in self._batch_threads:
            if thread is not threading.current_thread():
                thread.join(10.0)


def _log_gap(gap: Gap) -> None:
    log.warning("messages lost on the way", stream=gap.stream, messages=gap.messages)
