"""The real bus: Zenoh. The only file that imports it.

Nodes are clients of a router, because a router does not relay between two peers that don't listen, and because
one address is all that a node then has to know. The router may be this process (`router`), or Zenoh's own.
"""

import json
import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import structlog
import zenoh
from google.protobuf.message import Message

from reactorwatch.contract.codec import Encoded, encode_message
from reactorwatch.errors import InputError
from reactorwatch.runtime.bus import Request
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.serve import StopSignal

log = structlog.get_logger()

FIRST_RETRY_S = 0.1
LONGEST_RETRY_S = 2.0
SAY_AGAIN_S = 30.0
FLUSH_WITHIN_S = 10.0
NOBODY = "reactorwatch/nobody"  # a key that no queryable answers


def _configured(settings: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return config


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


class ZenohBus:
    """See `reactorwatch.runtime.bus.Bus`."""

    def __init__(self, session: zenoh.Session, congestion: str) -> None:
        self._session = session
        self._congestion = zenoh.CongestionControl.BLOCK if congestion == "block" else zenoh.CongestionControl.DROP
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._declared: list[Any] = []  # Zenoh undeclares what nobody holds

    def publish(self, message: Encoded) -> None:
        """See `Bus`."""
        publisher = self._publishers.get(message.key)
        if publisher is None:
            publisher = self._session.declare_publisher(message.key, congestion_control=self._congestion)
            self._publishers[message.key] = publisher
        publisher.put(message.payload, encoding=message.encoding)

    def subscribe(self, key_expression: str, handler: Callable[[Encoded], None]) -> None:
        """See `Bus`."""

        def on_sample(sample: zenoh.Sample) -> None:
            now_ns = time.time_ns()
            handler(Encoded(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding), now_ns))

        self._declared.append(self._session.declare_subscriber(key_expression, on_sample))

    def answer(self, key_expression: str, handler: Callable[[Request], None]) -> None:
        """See `Bus`."""

        def on_query(query: zenoh.Query) -> None:
            payload = query.payload
            question = Encoded(
                str(query.key_expr), payload.to_bytes() if payload is not None else b"", str(query.encoding)
            )
            handler(ZenohRequest(query, question))

        self._declared.append(self._session.declare_queryable(key_expression, on_query))

    def ask(self, question: Encoded, timeout_s: float) -> list[Encoded]:
        """See `Bus`."""
        replies = self._session.get(
            question.key, payload=question.payload, encoding=question.encoding, timeout=timeout_s
        )
        answers = (reply.ok for reply in replies)
        return [
            Encoded(str(answer.key_expr), answer.payload.to_bytes(), str(answer.encoding))
            for answer in answers
            if answer is not None
        ]

    def announce(self, key: str) -> None:
        """See `Bus`."""
        self._declared.append(self._session.liveliness().declare_token(key))

    def watch_alive(self, key_expression: str, handler: Callable[[str, bool], None]) -> None:
        """See `Bus`."""

        def on_token(sample: zenoh.Sample) -> None:
            handler(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._declared.append(self._session.liveliness().declare_subscriber(key_expression, on_token, history=True))

    def close(self) -> None:
        """See `Bus`.

        A question to nobody goes the way of the messages before it, and its end comes back from the router: then they
        are all there. Zenoh's own close was never seen to drop what is queued (neither with the router stopped for a
        second nor under load), but it promises nothing; this does, for one round trip.
        """
        for _ in self._session.get(NOBODY, timeout=FLUSH_WITHIN_S):
            pass
        self._session.close()


def connect(config: BusConfig, node: str, stop: StopSignal) -> ZenohBus | None:
    """Join the bus as a client, waiting for its router as long as it takes.

    Args:
        config: where the router is.
        node: who is waiting, for the log.
        stop: ends the waiting.

    Returns:
        The open bus; None if a stop was asked for before a router was there.

    Raises:
        InputError: the endpoint is not one that Zenoh understands.
    """
    settings = {
        "mode": "client",
        "connect/endpoints": [config.endpoint],
        "connect/retry": _RETRY,
        "connect/timeout_ms": 0,
        "scouting/multicast/enabled": False,
    }
    client = _checked(settings, config.endpoint)
    woken = threading.Event()
    stop.wakes(woken.set)
    retry_s = FIRST_RETRY_S
    said_at = -SAY_AGAIN_S
    while not stop.is_set:
        try:
            session = zenoh.open(client)
        except zenoh.ZError as error:
            if time.monotonic() - said_at >= SAY_AGAIN_S:
                said_at = time.monotonic()
                log.info("waiting for a router", node=node, endpoint=config.endpoint, why=_first_line(error))
            woken.wait(retry_s)
            retry_s = min(2 * retry_s, LONGEST_RETRY_S)
            continue
        log.info("connected", node=node, endpoint=config.endpoint)
        return ZenohBus(session, config.congestion)
    return None


def router(config: BusConfig) -> ZenohBus:
    """Be the router, in this process, until the bus is closed.

    Raises:
        InputError: nothing can listen at the endpoint: it is malformed or taken.
    """
    settings = {
        "mode": "router",
        "listen/endpoints": [config.endpoint],
        "listen/timeout_ms": 0,
        "listen/exit_on_failure": True,
        "scouting/multicast/enabled": False,
    }
    try:
        session = zenoh.open(_checked(settings, config.endpoint))
    except zenoh.ZError as error:
        raise InputError(
            f"no router can listen at {config.endpoint!r}: {_first_line(error)}; "
            f"is another router running there? Choose another with --endpoint"
        ) from error
    return ZenohBus(session, config.congestion)


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
