"""A subscriber receives the history, however old it is and however late publishers answer."""

import contextlib
import math
import threading
from queue import SimpleQueue

import pytest
import zenoh

from benchmarks.harness.site import PATIENCE_S, Router, connect_client
from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime.acl import NO_QUERYABLE
from reactorwatch.runtime.bus_zenoh import bus as bus_module
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.http_pages import free_endpoint

KEYS = ("reactor/cstr/sample/C", "reactor/cstr/sample/T")
SLOW = "reactor/cstr/sample/x/@adv/**"
PUBLISHED = [Encoded(KEYS[number % 2], str(number).encode(), "") for number in range(200)]


class SlowPublisher:
    """A session that leaves the first questions for what was published unanswered, until they time out."""

    def __init__(self, config: BusConfig, unanswered: int) -> None:
        self.asked = 0
        self._unanswered, self._held = unanswered, list[zenoh.Query]()
        settings = zenoh.Config()
        settings.insert_json5("mode", '"client"')
        settings.insert_json5("connect/endpoints", f'["{config.endpoint}"]')
        settings.insert_json5("scouting/multicast/enabled", "false")
        self.session = zenoh.open(settings)
        self._queryable = self.session.declare_queryable(SLOW, self._on_query)

    def _on_query(self, query: zenoh.Query) -> None:
        self.asked += 1
        if self.asked <= self._unanswered:
            self._held.append(query)
        else:
            query.drop()


def publish_to_router(bus: bus_module.ZenohBus) -> None:
    """Publish all messages and wait until the router has routed them: a later subscriber receives none of them live."""
    for message in PUBLISHED:
        bus.publish(message)
    bus.query(Encoded(NO_QUERYABLE, b"", ""), PATIENCE_S)  # ends when all messages before it have arrived


def wait_until_known(bus: bus_module.ZenohBus) -> None:
    """Wait until a session knows of the slow publisher: before that, its queries do not go there."""
    is_known = threading.Event()
    querier = bus._session.declare_querier(SLOW)
    listener = querier.declare_matching_listener(lambda status: is_known.set() if status.matching else None)
    if querier.matching_status.matching:  # type: ignore[attr-defined] # the stub calls the status a bool
        is_known.set()
    assert is_known.wait(PATIENCE_S)
    listener.undeclare()
    querier.undeclare()


@pytest.mark.parametrize("unanswered", [0, 1, 2], ids=["at once", "last numbers late", "history late, too"])
def test_an_answer_that_does_not_come_in_time_is_asked_for_again(
    monkeypatch: pytest.MonkeyPatch, unanswered: int
) -> None:
    """Only the queries that stay unanswered have a short limit: on a busy machine an answer may take that long."""
    limits_s = iter([0.5] * unanswered)

    def query_cache(bus: bus_module.ZenohBus, key_expression: str, which: str) -> object:
        monkeypatch.setattr(bus_module, "HISTORY_WITHIN_S", next(limits_s, PATIENCE_S))
        return answer_of_cache(bus, key_expression, which)

    answer_of_cache = bus_module.ZenohBus._query_cache
    monkeypatch.setattr(bus_module.ZenohBus, "_query_cache", query_cache)
    with (
        contextlib.closing(Router(free_endpoint())) as router,
        contextlib.closing(connect_client(router.config)) as publisher,
        contextlib.closing(connect_client(router.config)) as late,
    ):
        slow = SlowPublisher(router.config, unanswered)
        wait_until_known(late)
        publish_to_router(publisher)
        heard, complete = SimpleQueue[Encoded](), SimpleQueue[bool]()
        late.subscribe(
            "reactor/cstr/sample/**", heard.put, history_s=math.inf, on_history_end=lambda: complete.put(True)
        )
        assert complete.get(timeout=PATIENCE_S)
        assert [heard.get(timeout=PATIENCE_S).payload for _ in PUBLISHED] == [item.payload for item in PUBLISHED]
        assert slow.asked == unanswered + 3
        slow.session.close()


@pytest.mark.parametrize(
    ("lost", "then"),
    [
        (PUBLISHED, []),
        (PUBLISHED[::2], []),
        (PUBLISHED[:150:2], []),
        (PUBLISHED[40:60], []),
        (PUBLISHED[40:60], PUBLISHED),
        (PUBLISHED[40:60], PUBLISHED[::2]),
        (PUBLISHED[40:60], PUBLISHED[40:180]),
    ],
    ids=["all", "a key", "the begin of a key", "a piece", "a piece, then all", "a piece, then a key", "more and more"],
)
def test_replies_that_are_lost_on_their_way_without_notice_are_asked_for_again(
    lost: list[Encoded], then: list[Encoded], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list[str]()
    # neither does the query for what was published meanwhile bring them
    gone = [{message.payload for message in messages} for messages in (lost, lost, then)]

    def query_cache(bus: bus_module.ZenohBus, key_expression: str, which: str) -> object:
        messages, is_complete = answer_of_cache(bus, key_expression, which)
        if bus_module.LAST in which:
            return messages, is_complete
        asked.append(which)
        is_lost = set[bytes]().union(*gone[len(asked) - 1 : len(asked)])
        return [item for item in messages if item.message.payload not in is_lost], is_complete

    answer_of_cache = bus_module.ZenohBus._query_cache
    monkeypatch.setattr(bus_module.ZenohBus, "_query_cache", query_cache)
    with (
        contextlib.closing(Router(free_endpoint())) as router,
        contextlib.closing(connect_client(router.config)) as publisher,
        contextlib.closing(connect_client(router.config)) as late,
    ):
        publish_to_router(publisher)
        heard, complete = SimpleQueue[Encoded](), SimpleQueue[bool]()
        late.subscribe("reactor/cstr/sample/**", heard.put, history_s=60.0, on_history_end=lambda: complete.put(True))
        assert complete.get(timeout=PATIENCE_S)
        assert [heard.get(timeout=PATIENCE_S).payload for _ in PUBLISHED] == [item.payload for item in PUBLISHED]
        assert len(asked) == 3 + bool(then)
