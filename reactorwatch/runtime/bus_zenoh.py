"""The real bus: Zenoh. The only file that imports it.

Nodes are clients of a router, because a router does not relay between two peers that don't listen, and because
one address is all that a node then has to know. The router may be this process (`router`), or Zenoh's own.

Nothing that was published is lost on the way as long as its publisher lives and remembers it. Each publisher keeps its
last messages on each key (`cache_messages`) and tells twice a second which was its last; a subscriber that finds one
missing asks for it, and one that comes late may ask for what was published before (`history_s`). This is Zenoh's
advanced publisher and subscriber. What it cannot do is keep the order across keys: see `in_order`.

So publishers need not wait for a network that takes no more: they throw away (`drop`), and what a subscriber thereby
misses it gets later. A subscriber that is stuck then holds nobody up. Only what somebody asked for again is sent
with waiting, for else a long recovery would be thrown away in part; and a link that takes nothing for `STUCK_S` is
closed.
"""

import contextlib
import json
import re
import secrets
import struct
import threading
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import structlog
import zenoh
import zenoh.ext
from google.protobuf.message import Message

from reactorwatch.contract.codec import LARGEST_PAYLOAD, Encoded, encode_message
from reactorwatch.errors import InputError
from reactorwatch.runtime.access import MEMORY, NOBODY
from reactorwatch.runtime.bus import MOST_GATHERED, Request
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.delivery import Delivery, Numbered
from reactorwatch.runtime.identity import ROUTER_FILES, TLS, client_settings
from reactorwatch.runtime.in_order import Gap, InOrder
from reactorwatch.runtime.serve import StopSignal

log = structlog.get_logger()

FIRST_RETRY_S = 0.1
LONGEST_RETRY_S = 2.0
SAY_AGAIN_S = 30.0
FLUSH_WITHIN_S = 10.0
HEARTBEAT_S = 0.5
LAST_RECOVERY_S = 1.0  # that a bus stays open after its last message, so that who missed it can ask for it
STUCK_S = 1.0
LONGEST_ENCODING = 1000
GATHER_AGAIN_S = 0.005
LARGEST_CHANNEL = 5 * MOST_GATHERED
MOST_GATHERED_BYTES = 1 << 20
STREAM_PARTS = 3  # of a key: root, plant and kind

HISTORY_WITHIN_S = 10.0
LONGEST_WAY_S = 5.0  # that a message takes to us; what is missing was published so much before what came instead of it
MOST_ASKED = 4  # times for what was before; what was published while the answers came may be missing

_NUMBERED = struct.Struct("<QQ")  # who published it, and its number in the stream


def _configured(settings: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return config


_STUCK = {"transport/link/tx/queue/congestion_control/block/wait_before_close": round(STUCK_S * 1e6)}
_RETRY = {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 1.5}


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
        self._config = config
        self._name = secrets.randbits(64)
        self._keys: dict[str, _Key] = {}
        self._numbers: dict[str, int] = {}  # the next one of each stream
        self._publishing = threading.Lock()  # what is numbered first goes out first
        self._published_at: float | None = None
        self._declared: list[Any] = []  # Zenoh undeclares what nobody holds
        self._tokens: dict[str, Any] = {}
        self._deliveries: list[Delivery] = []

    def publish(self, message: Encoded) -> None:
        """See `Bus`."""
        if self._passing and message.key.split("/", STREAM_PARTS)[STREAM_PARTS - 1] in self._passing:
            self._voice.put(message.key, message.payload, encoding=message.encoding)
            return
        with self._publishing:
            key = self._keys.get(message.key)
            if key is None:
                key = self._keys[message.key] = self._declare(message.key)
            number = self._numbers[key.stream]
            self._numbers[key.stream] = number + 1
            attachment = _NUMBERED.pack(self._name, number)
            key.publisher.put(message.payload, encoding=message.encoding, attachment=attachment)
            self._published_at = time.monotonic()

    def subscribe(
        self,
        key_expression: str,
        handler: Callable[[Encoded], None],
        *,
        on_gap: Callable[[Gap], None] | None = None,
        history: bool = False,
        on_told: Callable[[], None] | None = None,
    ) -> None:
        """See `Bus`."""

        def hand_on(messages: list[Encoded]) -> None:
            for message in messages:
                handler(message)

        delivery = self._delivery(key_expression, hand_on, on_gap)

        def on_sample(sample: zenoh.Sample) -> None:
            came = _numbered(sample, time.time_ns())
            if delivery is None or isinstance(came, Encoded):  # or it is of no publisher of ours
                handler(came if isinstance(came, Encoded) else came.message)
            else:
                delivery.receive((came,))

        self._listen(key_expression, on_sample)
        if delivery is not None:
            self._begin(delivery, key_expression, history=history, on_told=on_told)
        elif on_told is not None:
            on_told()

    def gather(
        self,
        key_expression: str,
        handler: Callable[[list[Encoded]], None],
        *,
        on_gap: Callable[[Gap], None] | None = None,
        history: bool = False,
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

        def hand_on(came: list[Numbered | Encoded]) -> None:
            others = (
                [item if isinstance(item, Encoded) else item.message for item in came]
                if delivery is None
                else [item for item in came if isinstance(item, Encoded)]
            )
            if others:
                handler(others)
            if delivery is not None and len(others) < len(came):
                delivery.receive(item for item in came if isinstance(item, Numbered))

        def empty() -> None:
            with contextlib.suppress(zenoh.ZError):  # it is closed
                while True:
                    sample, now_ns = channel.recv(), time.time_ns()
                    came, room = list[Numbered | Encoded](), MOST_GATHERED_BYTES
                    while sample is not None:
                        item = _numbered(sample, now_ns)
                        came.append(item)
                        room -= len(item.payload if isinstance(item, Encoded) else item.message.payload)
                        sample = channel.try_recv() if len(came) < MOST_GATHERED and room > 0 else None
                    hand_on(came)
                    time.sleep(GATHER_AGAIN_S)

        threading.Thread(target=empty, name="gather", daemon=True).start()
        if delivery is not None:
            self._begin(delivery, key_expression, history=history, on_told=on_told)
        elif on_told is not None:
            on_told()

    def _delivery(
        self,
        key_expression: str,
        handler: Callable[[list[Encoded]], None],
        on_gap: Callable[[Gap], None] | None,
    ) -> Delivery | None:
        """What keeps the order of whole streams; None for less than that."""
        if not _is_of_whole_streams(key_expression):
            return None
        delivery = Delivery(handler, on_gap or _say_gap, self._asked_again)
        self._deliveries.append(delivery)
        return delivery

    def _listen(self, key_expression: str, handler: Any) -> Any:
        """Subscribe, with a callback or a channel."""
        recovery = zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None)
        subscriber = zenoh.ext.declare_advanced_subscriber(
            self._session, _spelled(key_expression), handler, recovery=recovery
        )
        self._declared.append(subscriber)
        return subscriber

    def _begin(
        self, delivery: Delivery, key_expression: str, *, history: bool, on_told: Callable[[], None] | None
    ) -> None:
        """Ask for what was before, and let what comes go on."""
        # The subscriber's own question for what was before left out keys that were being published on meanwhile.
        for last in self._remembered(key_expression, "_max=1"):
            delivery.tell_last(last)
        if history:
            began, since_s = time.monotonic(), self._config.history_s
            for _ in range(MOST_ASKED):
                for came in self._remembered(key_expression, f"_time=[now(-{since_s}s)..]"):
                    delivery.tell(came)
                if delivery.is_told():
                    break
                since_s = time.monotonic() - began + HEARTBEAT_S
        # In a thread of its own: the handler may wait for who called us.
        threading.Thread(target=delivery.begin, args=(on_told,), daemon=True).start()

    def recall(self, key_expression: str) -> list[Encoded]:
        """See `Bus`."""
        order: InOrder[Encoded] = InOrder(gathering=True)
        lately = f"_time=[now(-{self._config.history_s}s)..]"
        with contextlib.suppress(zenoh.ZError):  # it is closed
            for publisher, stream, number, message in self._remembered(key_expression, lately):
                order.tell(publisher, stream, message.key, number, message)
        told = list(order.gathered(0))
        while (due_ns := order.due_ns()) is not None:  # what is missing is not waited for
            told += order.overdue(due_ns)
        return [item for item in told if isinstance(item, Encoded)]

    def _asked_again(self, stream: str, since_s: float) -> list[Numbered]:
        """What publishers remember of a stream."""
        try:
            return list(self._remembered(f"{stream}/**", f"_time=[now(-{since_s + LONGEST_WAY_S}s)..]"))
        except zenoh.ZError as error:  # the bus is being closed, for instance
            log.info("cannot ask for what is missing", stream=stream, why=_first_line(error))
            return []

    def _remembered(self, key_expression: str, which: str) -> Iterator[Numbered]:
        """What publishers remember of what they have published."""
        replies = self._session.get(
            f"{_spelled(key_expression)}/{MEMORY}?{which}",
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=HISTORY_WITHIN_S,
        )
        for reply in replies:
            came = _numbered(reply.ok, time.time_ns()) if reply.ok is not None else None
            if isinstance(came, Numbered):
                yield came

    def _declare(self, key: str) -> _Key:
        stream = _stream(key)
        self._numbers.setdefault(stream, 0)
        # Of the same priority as all else: of a lower one, the word that this was all would overtake the replies.
        again = zenoh.ext.RepliesConfig(congestion_control=zenoh.CongestionControl.BLOCK)
        drop = self._config.congestion == "drop"
        publisher = zenoh.ext.declare_advanced_publisher(
            self._voice,
            key,
            congestion_control=zenoh.CongestionControl.DROP if drop else zenoh.CongestionControl.BLOCK,
            cache=zenoh.ext.CacheConfig(self._config.cache_messages, replies_config=again),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None),
            publisher_detection=True,
        )
        return _Key(publisher, stream)

    def answer(self, key_expression: str, handler: Callable[[Request], None]) -> None:
        """See `Bus`."""

        def on_query(query: zenoh.Query) -> None:
            payload = query.payload
            data = _bytes(payload) if payload is not None else b""
            question = Encoded(str(query.key_expr), data, str(query.encoding)[:LONGEST_ENCODING])
            handler(ZenohRequest(query, question))

        self._declared.append(self._voice.declare_queryable(_spelled(key_expression), on_query))

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
            self._voice.liveliness().declare_subscriber(_spelled(key_expression), on_token, history=True)
        )

    def close(self) -> None:
        """See `Bus`.

        A question to nobody goes the way of the messages before it, and its end comes back from the router: then they
        are all there. Zenoh's own close was never seen to drop what is queued (neither with the router stopped for a
        second nor under load), but it promises nothing; this does, for one round trip. What was thrown away on a full
        network is told once more by then, and can be asked for as long as this bus is open.
        """
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


def connect(
    config: BusConfig, node: str, stop: StopSignal, *, passing: Collection[str] = (), crowded: bool = False
) -> ZenohBus | None:
    """Join the bus as a client, waiting for its router as long as it takes.

    Args:
        config: where the router is.
        node: who is waiting, for the log.
        stop: ends the waiting.
        passing: kinds of which nothing is remembered, nor counted, when we publish them: what is told again and again
            of thousands of plants. Who is cut off misses them.
        crowded: whether we publish, or show tokens, on keys of hundreds of plants. A session looks through those it has
            for each message that comes (a hundred make it four times slower), so another one listens then.

    Returns:
        The open bus; None if a stop was asked for before a router was there.

    Raises:
        InputError: the endpoint is not one that Zenoh understands.
    """
    client = _client(config)
    woken = threading.Event()
    stop.wakes(woken.set)
    retry_s = FIRST_RETRY_S
    said_at = -SAY_AGAIN_S
    while not stop.is_set:
        try:
            session = zenoh.open(client)
            voice = zenoh.open(client) if crowded else None
        except zenoh.ZError as error:
            if time.monotonic() - said_at >= SAY_AGAIN_S:
                said_at = time.monotonic()
                log.info("waiting for a router", node=node, endpoint=config.endpoint, why=_first_line(error))
            woken.wait(retry_s)
            retry_s = min(2 * retry_s, LONGEST_RETRY_S)
            continue
        log.info("connected", node=node, endpoint=config.endpoint)
        return ZenohBus(session, config, passing, voice)
    return None


def connect_now(config: BusConfig) -> ZenohBus:
    """Join the bus as a client, if its router is there and lets us in.

    Raises:
        ConnectionError: it is not, or does not; with what Zenoh says.
        InputError: the endpoint is not one that Zenoh understands.
    """
    try:
        return ZenohBus(zenoh.open(_client(config)), config)
    except zenoh.ZError as error:
        raise ConnectionError(_first_line(error)) from error


def _client(config: BusConfig) -> zenoh.Config:
    settings = {
        "mode": "client",
        "connect/endpoints": [config.endpoint],
        "connect/retry": _RETRY,
        "connect/timeout_ms": 0,
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,  # by which the age of what was published is known
        **_STUCK,
        **client_settings(config),
    }
    return _checked(settings, config.endpoint)


def router(config: BusConfig) -> ZenohBus:
    """Be the router, in this process, until the bus is closed.

    Raises:
        InputError: nothing can listen at the endpoint: it is malformed or taken, or needs a router's certificate.
    """
    if config.ca is not None:
        raise InputError(
            f"no router can listen at {config.endpoint!r} with the certificate of a node; "
            "name the site with --site, or start its router: `reactorwatch router SITE/router/router.json5`"
        )
    settings = {
        "mode": "router",
        "listen/endpoints": [config.endpoint],
        "listen/timeout_ms": 0,
        "listen/exit_on_failure": True,
        "connect/endpoints": list(config.routers),
        "connect/retry": _RETRY,
        "connect/timeout_ms": {"router": -1},
        "connect/exit_on_failure": {"router": False},
        "scouting/multicast/enabled": False,
        **_STUCK,
    }
    try:
        session = zenoh.open(_checked(settings, config.endpoint))
    except zenoh.ZError as error:
        raise InputError(
            f"no router can listen at {config.endpoint!r}: {_first_line(error)}; "
            f"is another router running there? Choose another with --endpoint"
        ) from error
    return ZenohBus(session, config)


def router_from_file(path: Path) -> ZenohBus:
    """Be the router that a file of Zenoh's own settings describes, as `certify` writes it for a site.

    Args:
        path: the file, JSON5; files that it names are relative to its folder.

    Raises:
        InputError: it cannot be read or makes no sense, or nothing can listen where it says.
    """
    try:
        config = zenoh.Config.from_file(str(path))
        for name in ROUTER_FILES:
            file = json.loads(config.get_json(f"{TLS}/{name}"))
            if file is not None:
                config.insert_json5(f"{TLS}/{name}", json.dumps(str(path.parent / file)))
        return ZenohBus(zenoh.open(config), BusConfig())
    except zenoh.ZError as error:
        raise InputError(f"router settings {path}: {_first_line(error)}") from error


def _stream(key: str) -> str:
    """The stream that a key is in."""
    return "/".join(key.split("/", STREAM_PARTS)[:STREAM_PARTS])


def _bytes(payload: zenoh.ZBytes) -> bytes:
    """A payload; one that is too large for any message of ours is cut to a size that still is, so that it is refused.

    What waits for a node is counted in messages, and would otherwise be as large as a stranger likes.
    """
    data = payload.to_bytes()
    return data if len(data) <= LARGEST_PAYLOAD else data[: LARGEST_PAYLOAD + 1]


def _numbered(sample: zenoh.Sample, now_ns: int) -> Numbered | Encoded:
    """A message that has come, as its publisher numbered it; without a number if it did not."""
    message = Encoded(str(sample.key_expr), _bytes(sample.payload), str(sample.encoding)[:LONGEST_ENCODING], now_ns)
    attachment = sample.attachment
    if attachment is None:
        return message
    numbered = attachment.to_bytes()
    if len(numbered) != _NUMBERED.size:
        return message
    publisher, number = _NUMBERED.unpack(numbered)
    return Numbered(publisher, _stream(message.key), number, message)


def _spelled(key_expression: str) -> str:
    """As Zenoh writes it: a `*` that is only a part of a part is `$*` there."""
    return "/".join(part if part in ("*", "**") else part.replace("*", "$*") for part in key_expression.split("/"))


def _is_of_whole_streams(key_expression: str) -> bool:
    """Whether who listens to it hears all of any stream that it hears anything of."""
    *parts, last = key_expression.split("/")
    return last == "**" and len(parts) <= STREAM_PARTS


def _say_gap(gap: Gap) -> None:
    log.warning("messages lost on the way", stream=gap.stream, messages=gap.messages)


def _checked(settings: dict[str, Any], endpoint: str) -> zenoh.Config:
    try:
        return _configured(settings)
    except zenoh.ZError as error:
        raise InputError(
            f"endpoint must be like 'tcp/127.0.0.1:7447', got {endpoint!r}: {_first_line(error)}"
        ) from error


def _first_line(error: Exception) -> str:
    """What Zenoh says, without the places in its source where it said so."""
    line = str(error).splitlines()[0] if str(error) else type(error).__name__
    return re.sub(r" at /\S+\.rs:\d+\.?", "", line).rstrip(". ")
