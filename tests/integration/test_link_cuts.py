"""No published message is lost: links are cut, routers killed, subscribers late, blocked or restarted.

Thirty seconds and every pair of link and manner: `make cuts`.
"""

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path
from queue import Empty, SimpleQueue

import pytest

from benchmarks.harness.site import (
    BATCHES_PER_S,
    PATIENCE_S,
    SIGNALS,
    Heard,
    Manner,
    Proxy,
    Publisher,
    Router,
    Tokens,
    connect_client,
    recorder_process,
)
from benchmarks.losses import Whose, cut, kill_router, read_content, stick
from reactorwatch.cli.info import info_text
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, decode
from reactorwatch.contract.messages_pb2 import Sample
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.http_pages import free_endpoint
from recorder.files.recording import Recording
from recorder.tools.inspect import inspect

RATE_PER_S = 1000
"""A machine that has much else to do cannot keep up with the five thousand of `make cuts`."""
KEPT = 60_000
"""On a key: what is published in five minutes, more than any cut lasts, also where processes are slow to start."""


FLUSHED_BYTES = 20_000
"""More than the beginning of a recording."""


def wait_for_a_flush(folder: Path, publisher: Publisher) -> None:
    """Wait until a file that is being written holds more than its beginning."""
    while max((part.stat().st_size for part in folder.glob("*.part")), default=0) < FLUSHED_BYTES:
        publisher.wait(publisher.sequence + BATCHES_PER_S // 10)


@pytest.fixture
def router() -> Iterator[Router]:
    with contextlib.closing(Router(free_endpoint())) as running:
        yield running


@pytest.mark.parametrize(
    ("whose", "manner", "span_s"),
    [
        ("recorder", "closed", 1.0),
        ("publisher", "stalled", 1.0),
        ("publisher", "closed", 2.0),
        ("recorder", "stalled", 5.0),
    ],
)
def test_a_cut_link_costs_no_sample_and_none_its_place(
    tmp_path: Path, whose: Whose, manner: Manner, span_s: float
) -> None:
    found = cut(tmp_path, whose, manner, span_s, cache_messages=KEPT, rate_per_s=RATE_PER_S)
    assert found.published > RATE_PER_S * span_s
    assert (found.missing, found.twice, found.out_of_order) == (0, 0, 0)


def test_a_router_that_is_killed_and_started_again_costs_no_sample(tmp_path: Path) -> None:
    found = kill_router(tmp_path, 2.0, cache_messages=KEPT, rate_per_s=RATE_PER_S)
    assert (found.missing, found.twice, found.out_of_order) == (0, 0, 0)


def test_the_first_messages_on_keys_are_received_though_the_router_was_down_when_they_were_published(
    router: Router,
) -> None:
    """Of streams that are new, and of one that is known: nobody has heard of these keys before the router is back."""
    listener, publisher = connect_client(router.config), connect_client(router.config)
    seen: SimpleQueue[bool] = SimpleQueue()
    received: SimpleQueue[str] = SimpleQueue()
    listener.subscribe("reactor/*/alarm/**", lambda message: received.put(message.key))
    publisher.subscribe_liveliness("reactor/known/alive/publisher", lambda _, is_alive: seen.put(is_alive))
    publisher.declare_token("reactor/known/alive/publisher")
    publisher.publish(Encoded("reactor/known/alarm/first", b"", ""))
    assert (received.get(timeout=PATIENCE_S), seen.get(timeout=PATIENCE_S)) == ("reactor/known/alarm/first", True)
    router.kill()
    assert not seen.get(timeout=PATIENCE_S)
    published = [f"reactor/{plant}/alarm/{name}" for name in "xyz" for plant in ("known", "new", "newer")]
    for key in published:
        publisher.publish(Encoded(key, b"", ""))
    router.restart()
    assert sorted(received.get(timeout=PATIENCE_S) for _ in published) == sorted(published)
    publisher.close()
    listener.close()


def test_a_stream_that_starts_while_the_link_of_a_subscriber_is_cut_is_received_from_its_start(router: Router) -> None:
    """A stream that is new, and new keys of one that is known; both go on when the link is back."""
    proxy = Proxy(router.config.endpoint)
    listener, publisher = connect_client(BusConfig(endpoint=proxy.endpoint)), connect_client(router.config)
    received: SimpleQueue[tuple[str, bytes]] = SimpleQueue()
    listener.subscribe("reactor/*/chart/**", lambda message: received.put((message.key, message.payload)))
    published, arrived = list[tuple[str, bytes]](), list[tuple[str, bytes]]()

    def publish(*names: str) -> None:
        for name in names:
            published.append((f"reactor/{name}", b"%d" % len(published)))
            publisher.publish(Encoded(*published[-1], ""))

    publish("known/chart/old")
    arrived.append(received.get(timeout=PATIENCE_S))
    new = ("known/chart/old", "known/chart/new", "new/chart/T", "new/chart/C")
    with proxy.cut("closed"):
        for _ in range(50):
            publish(*new)
    while len(arrived) == 1:
        publish(*new)
        with contextlib.suppress(Empty):
            arrived.append(received.get(timeout=0.01))
    while len(arrived) < len(published):
        arrived.append(received.get(timeout=PATIENCE_S))
    for plant in ("known", "new"):  # each in its order
        of_plant = [[item for item in items if item[0].split("/")[1] == plant] for items in (arrived, published)]
        assert of_plant[0] == of_plant[1]
    publisher.close()
    listener.close()
    proxy.close()


@pytest.mark.parametrize("whose", ["recorder", pytest.param("publisher", marks=pytest.mark.slow)])
def test_what_could_not_be_recovered_is_counted_and_named_in_the_file_and_by_info(tmp_path: Path, whose: Whose) -> None:
    """The publisher remembers a tenth of what was published while the link was down."""
    kept = RATE_PER_S // SIGNALS // 10
    found = cut(tmp_path, whose, "closed", 1.0, cache_messages=kept, rate_per_s=RATE_PER_S)
    seen = inspect(tmp_path / "run.mcap")
    assert found.missing > 0
    assert {gap.stream for gap in seen.gaps} == {"reactor/cstr/sample"}
    assert sum(gap.messages for gap in seen.gaps) == seen.overview.lost == found.missing
    assert found.out_of_order == 0
    assert f"lost on the way: {found.missing} messages of reactor/cstr/sample" in info_text(seen, tmp_path / "run.mcap")


def test_a_late_subscriber_receives_the_history(tmp_path: Path, router: Router) -> None:
    bus, received, enough = connect_client(router.config), list[int](), threading.Event()
    publisher = Publisher(bus, RATE_PER_S)
    publisher.wait(300)
    late = connect_client(router.config)

    def receive(message: Encoded) -> None:
        sample = decode(message.payload, message.encoding)
        assert isinstance(sample, Sample)
        received.append(sample.sequence)
        if len(received) >= 600 * SIGNALS:
            enough.set()

    late.subscribe(keys.all_keys("cstr", keys.SAMPLE), receive, history_s=60.0)
    assert enough.wait(PATIENCE_S)
    publisher.close()
    late.close()
    bus.close()
    assert received == [number // SIGNALS for number in range(len(received))]


@pytest.mark.slow
@pytest.mark.parametrize("killed", [False, True], ids=["stopped", "killed"])
def test_a_restarted_recorder_loses_nothing_and_repeats_nothing(tmp_path: Path, router: Router, killed: bool) -> None:
    bus = connect_client(BusConfig(endpoint=router.config.endpoint, cache_messages=KEPT))
    tokens, received = Tokens(bus), Heard(bus)
    publisher = Publisher(bus, RATE_PER_S)
    try:
        with recorder_process(tmp_path, router.config.endpoint, tokens) as first:
            wait_for_a_flush(tmp_path, publisher)
            if killed:
                first.kill()
        publisher.wait(publisher.sequence + 200)
        with recorder_process(tmp_path, router.config.endpoint, tokens):
            publisher.wait(publisher.sequence + 200)
            publisher.close()
            assert received.wait(publisher.sequence * SIGNALS), "the recorder does not keep up"
    finally:
        publisher.close()
        bus.close()
    files = Recording(tmp_path).files
    assert len(files) == 2
    found = read_content(files, publisher)
    assert (found.missing, found.twice, found.out_of_order) == (0, 0, 0)


@pytest.mark.slow
def test_a_stuck_recorder_costs_another_nothing_and_gets_it_all_later(tmp_path: Path) -> None:
    """Its process is stopped for longer than it takes until a link that takes nothing is closed; the other hears on."""
    for found in stick(tmp_path, 3.0, cache_messages=KEPT, rate_per_s=RATE_PER_S):
        assert (found.missing, found.twice, found.out_of_order) == (0, 0, 0)


def test_a_handler_that_blocks_holds_up_neither_the_publisher_nor_another_listener(router: Router) -> None:
    """Until the other has heard all, the handler does not return; then it hears the same."""
    rows, released = 3000, threading.Event()
    bus, stuck, quick = (connect_client(router.config) for _ in range(3))
    received: dict[str, list[int]] = {"stuck": [], "quick": []}
    complete = {name: threading.Event() for name in received}

    def receive(name: str, message: Encoded) -> None:
        sample = decode(message.payload, message.encoding)
        assert isinstance(sample, Sample)
        received[name].append(sample.sequence)
        if len(received[name]) == rows * SIGNALS:
            complete[name].set()

    def receive_and_block(message: Encoded) -> None:
        receive("stuck", message)
        released.wait(PATIENCE_S)

    everything = keys.all_keys("cstr", keys.SAMPLE)
    stuck.subscribe(everything, receive_and_block)
    quick.subscribe(everything, lambda message: receive("quick", message))
    publisher = Publisher(bus, 5 * RATE_PER_S)
    try:
        publisher.wait(rows)
        assert complete["quick"].wait(PATIENCE_S)
        assert len(received["stuck"]) == 1
        released.set()
        assert complete["stuck"].wait(PATIENCE_S)
    finally:
        released.set()
        publisher.close()
        for each in (stuck, quick, bus):
            each.close()
    assert received["stuck"][: rows * SIGNALS] == received["quick"][: rows * SIGNALS]
