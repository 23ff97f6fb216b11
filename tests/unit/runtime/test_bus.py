"""The bus within a process behaves like the real one: the same keys reach the same ears."""

import pytest

from reactorwatch.contract.codec import Encoded
from reactorwatch.contract.keys import matches
from reactorwatch.contract.messages_pb2 import CommandReply
from reactorwatch.runtime.bus import Request
from tests.memory_bus import Exchange, MemoryBus


@pytest.mark.parametrize(
    ("expression", "key", "expected"),
    [
        ("a/b", "a/b", True),
        ("a/*", "a/b", True),
        ("a/*", "a/b/c", False),
        ("a/**", "a/b/c", True),
        ("a/**", "a", True),
        ("**", "a/b", True),
        ("a/**/c", "a/c", True),
        ("a/**/c", "a/b/b/c", True),
        ("a/**/c", "a/b", False),
        ("a/b*", "a/bc", True),
        ("a.b/c", "aXb/c", False),
    ],
)
def test_key_expressions_match_as_in_zenoh(expression: str, key: str, expected: bool) -> None:
    """https://zenoh.io/docs/manual/abstractions/#key-expression."""
    import zenoh

    assert matches(expression, key) is expected
    if "b*" not in expression:  # Zenoh writes a part of a part as $*
        assert zenoh.KeyExpr(expression).intersects(zenoh.KeyExpr(key)) is expected


def test_the_others_receive_what_one_publishes() -> None:
    exchange, heard = Exchange(), list[Encoded]()
    listener, speaker = MemoryBus(exchange), MemoryBus(exchange)
    listener.subscribe("reactor/*/sample/**", heard.append)
    message = Encoded("reactor/cstr/sample/T", b"1", "x")
    speaker.publish(message)
    speaker.publish(Encoded("reactor/cstr/health/plant", b"2", "x"))
    assert heard == [message]
    listener.close()
    speaker.publish(message)
    assert heard == [message]


def test_a_query_is_answered_by_the_queryable_on_its_key() -> None:
    exchange = Exchange()
    server, client = MemoryBus(exchange), MemoryBus(exchange)

    def reply(request: Request) -> None:
        request.reply(CommandReply(accepted=True, text=request.question.key))

    server.declare_queryable("reactor/cstr/command/*", reply)
    (answer,) = client.query(Encoded("reactor/cstr/command/set_input", b"", ""), 1.0)
    assert CommandReply.FromString(answer.payload).text == "reactor/cstr/command/set_input"
    assert client.query(Encoded("reactor/other/command/set_input", b"", ""), 1.0) == []


def test_a_queryable_that_does_not_answer_within_the_time_is_not_waited_for_longer() -> None:
    exchange = Exchange()
    server, client = MemoryBus(exchange), MemoryBus(exchange)
    server.declare_queryable("a/*", lambda request: None)
    server.declare_queryable("a/b", lambda request: request.reply(CommandReply(accepted=True, text="here")))
    (answer,) = client.query(Encoded("a/b", b"", ""), 0.01)
    assert CommandReply.FromString(answer.payload).text == "here"


def test_a_late_subscriber_sees_a_token_and_the_token_ends_with_its_bus() -> None:
    exchange, seen = Exchange(), list[tuple[str, bool]]()
    node, watcher = MemoryBus(exchange), MemoryBus(exchange)
    node.declare_token("reactor/cstr/alive/monitor")
    watcher.subscribe_liveliness("reactor/cstr/alive/*", lambda key, alive: seen.append((key, alive)))
    node.close()
    assert seen == [("reactor/cstr/alive/monitor", True), ("reactor/cstr/alive/monitor", False)]


def test_a_queryable_that_leaves_the_answer_to_others_is_not_waited_for() -> None:
    exchange = Exchange()
    server, client = MemoryBus(exchange), MemoryBus(exchange)
    server.declare_queryable("a/*", lambda request: request.decline())
    server.declare_queryable("a/b", lambda request: request.reply(CommandReply(accepted=True, text="here")))
    assert len(client.query(Encoded("a/b", b"", ""), 3600.0)) == 1


def test_a_token_can_be_withdrawn() -> None:
    exchange, seen = Exchange(), list[tuple[str, bool]]()
    node, watcher = MemoryBus(exchange), MemoryBus(exchange)
    node.declare_token("reactor/x/alive/monitor")
    watcher.subscribe_liveliness("reactor/*/alive/*", lambda key, alive: seen.append((key, alive)))
    node.undeclare_token("reactor/x/alive/monitor")
    assert seen == [("reactor/x/alive/monitor", True), ("reactor/x/alive/monitor", False)]
