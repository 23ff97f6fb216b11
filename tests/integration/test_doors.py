"""Access control: real sessions on loopback, against the router's settings that `certify` writes.

What is refused is refused in silence. So each test also shows the like that is let in, and looks once whatever was
sent before has come through: a session that leaves has a question answered by the router first.
"""

import itertools
import json
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import pytest
import zenoh

from benchmarks.harness.site import Proxy
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, decode, encode_message
from reactorwatch.contract.messages_pb2 import AlarmCommand, CommandReply
from reactorwatch.runtime.bus import Request
from reactorwatch.runtime.bus_zenoh import connect
from reactorwatch.runtime.config import BusConfig

from .site import WITHIN_S, OneAttempt, Site, make, settings

SAMPLE = "reactor/cstr/sample/T"
ALARM = "application/protobuf;reactorwatch.v1.AlarmCommand"
PEOPLE = ("operator", "engineer", "viewer")
OTHERS = ("cstr/monitor", "cstr/recorder", "cstr/operator", "cstr/engineer", "cstr/viewer", "other/plant")


def sample(payload: bytes) -> Encoded:
    return Encoded(SAMPLE, payload, "")


def tls_client(endpoint: str, **tls: str | bool) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("connect/timeout_ms", "0")
    config.insert_json5("scouting/multicast/enabled", "false")
    for name, value in tls.items():
        config.insert_json5(f"transport/link/tls/{name}", json.dumps(value))
    return config


def test_a_client_with_a_certificate_of_the_site_is_admitted(site: Site) -> None:
    for who in (*OTHERS, "cstr/plant"):
        site.join(who)


def test_a_client_without_a_certificate_is_rejected(site: Site) -> None:
    ca = str(site.folder / "cstr" / "viewer" / "ca.pem")
    with pytest.raises(zenoh.ZError):
        zenoh.open(tls_client(site.endpoint, root_ca_certificate=ca))


def test_a_client_with_a_certificate_of_another_authority_is_rejected(site: Site, tmp_path: Path) -> None:
    make(tmp_path / "foreign", site.endpoint)
    foreign = tmp_path / "foreign" / "cstr" / "plant"
    ca = str(site.folder / "cstr" / "plant" / "ca.pem")  # so that it is not the client that turns away
    with pytest.raises(zenoh.ZError):
        zenoh.open(
            tls_client(
                site.endpoint,
                root_ca_certificate=ca,
                connect_certificate=str(foreign / "certificate.pem"),
                connect_private_key=str(foreign / "key.pem"),
                enable_mtls=True,
            )
        )


def test_a_router_of_another_authority_is_not_trusted(site: Site, tmp_path: Path) -> None:
    make(tmp_path / "foreign", site.endpoint)
    assert connect(settings(tmp_path / "foreign", "cstr/plant"), "plant", OneAttempt()) is None


def test_a_client_s_certificate_makes_no_router(tmp_path: Path) -> None:
    """Its holder listens with it where the router should be."""
    endpoint = make(tmp_path)
    viewer = tmp_path / "cstr" / "viewer"
    config = zenoh.Config.from_file(str(tmp_path / "router" / "router.json5"))
    names = {"root_ca_certificate": "ca", "listen_certificate": "certificate", "listen_private_key": "key"}
    for name, file in names.items():
        config.insert_json5(f"transport/link/tls/{name}", json.dumps(str(viewer / f"{file}.pem")))
    with zenoh.open(config):
        assert connect(settings(tmp_path, "cstr/plant"), "plant", OneAttempt()) is None
    assert endpoint == settings(tmp_path, "cstr/plant").endpoint


def test_plain_tcp_is_not_let_in(site: Site) -> None:
    plain = BusConfig(endpoint=site.endpoint.replace("tls/", "tcp/"))
    assert connect(plain, "plant", OneAttempt()) is None


def test_only_the_plant_publishes_its_samples(site: Site) -> None:
    intruders = [site.join(who) for who in OTHERS]
    for who, intruder in zip(OTHERS, intruders, strict=True):
        intruder.publish(sample(who.encode()))
    site.leave(*intruders)
    site.join("cstr/plant").publish(sample(b"measured"))
    received = site.received_until(lambda message: message.payload == b"measured")
    assert [message.payload for message in received] == [b"measured"]


def test_a_recorder_that_uses_the_monitor_s_numbers_suppresses_none_of_its_alarms(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    received: list[Encoded] = []
    monkeypatch.setattr("secrets.randbits", lambda _: 7)  # both publishers get the same name
    viewer, monitor, recorder = (site.join(f"cstr/{who}") for who in ("viewer", "monitor", "recorder"))
    viewer.subscribe("reactor/cstr/alarm/**", received.append)
    monitor.publish(Encoded("reactor/cstr/alarm/ewma/T", b"0", ""))
    for _ in range(200):
        recorder.publish(Encoded("reactor/cstr/alarm/recording/zz", b"forged", ""))
    site.leave(recorder)
    for number in range(1, 6):
        monitor.publish(Encoded("reactor/cstr/alarm/ewma/T", b"%d" % number, ""))
    site.leave(monitor)
    site.close_readers()
    assert [item.payload for item in received if item.payload != b"forged"] == [b"%d" % number for number in range(6)]


def test_the_monitor_does_not_publish_the_recorder_s_alarms(site: Site) -> None:
    received: list[tuple[str, bytes]] = []
    forged = ("recording/disk", "recording/zz", "recording/disk/@adv/pub/x/_")
    for name in ("*", *forged):
        site.router.subscribe(
            f"reactor/cstr/alarm/{name}", lambda message: received.append((message.key, message.payload))
        )
    monitor = site.join("cstr/monitor")
    for name in forged:
        monitor._session.put(f"reactor/cstr/alarm/{name}", b"forged")
    monitor.publish(Encoded("reactor/cstr/alarm/x", b"raised", ""))
    site.leave(monitor)
    recorder = site.join("cstr/recorder")
    for name in forged[:2]:
        recorder.publish(Encoded(f"reactor/cstr/alarm/{name}", b"full", ""))
    site.leave(recorder)
    full = [(f"reactor/cstr/alarm/{name}", b"full") for name in forged[:2]]
    assert sorted(received) == [*full, ("reactor/cstr/alarm/x", b"raised")]


WILD = ("sample/*", "sample/**", "sample/T$*", "sample/$*T")


@pytest.mark.parametrize("gathered", [False, True], ids=["one by one", "gathered"])
def test_a_message_on_many_keys_at_once_is_taken_by_no_subscriber(
    site: Site, plain_log: None, capsys: pytest.CaptureFixture[str], *, gathered: bool
) -> None:
    """A router's rules cannot tell `sample/*` from `sample/T`, so subscribers refuse the message and log it once."""
    received, last = list[bytes](), threading.Event()

    def on_messages(messages: list[Encoded]) -> None:
        received.extend(message.payload for message in messages)
        if b"measured" in received:
            last.set()

    if gathered:
        site.router.subscribe_batched("reactor/cstr/sample/**", on_messages)
    else:
        site.router.subscribe("reactor/cstr/sample/**", lambda message: on_messages([message]))
    plant = site.join("cstr/plant")
    for key in WILD:
        plant._session.put(f"reactor/cstr/{key}", b"made up")
    plant.publish(sample(b"measured"))
    assert last.wait(WITHIN_S)
    assert received == [b"measured"]
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "must be on one key" in line]
    assert "reactor/cstr/sample/*" in line


def test_a_recorder_that_forges_the_monitor_s_source_suppresses_none_of_its_alarms_for_long(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Zenoh's subscriber drops them; publishers are asked for the last they have published, past it."""
    monkeypatch.setattr("reactorwatch.runtime.bus_zenoh.bus.LAST_QUERY_PERIOD_S", 0.5)
    key, changed, numbers = "reactor/cstr/alarm/ewma/T", threading.Condition(), itertools.count()
    received: list[bytes] = []
    sources: dict[bytes, zenoh.SourceInfo] = {}

    def receive(message: Encoded) -> None:
        with changed:
            received.append(message.payload)
            changed.notify_all()

    def note(sample: zenoh.Sample) -> None:
        with changed:
            if sample.source_info is not None:
                sources[sample.payload.to_bytes()] = sample.source_info
            changed.notify_all()

    def wait_for(is_so: Callable[[], bool]) -> None:
        with changed:
            assert changed.wait_for(is_so, WITHIN_S), (received, sources)

    def publish() -> bytes:
        payload = b"%d" % next(numbers)
        monitor.publish(Encoded(key, payload, ""))
        return payload

    viewer, monitor, recorder = (site.join(f"cstr/{who}") for who in ("viewer", "monitor", "recorder"))
    viewer.subscribe("reactor/cstr/alarm/**", receive)
    spy = recorder._session.declare_subscriber("reactor/cstr/alarm/**", note)
    while not sources:  # a subscriber misses what is published before its publisher knows of it
        wait_for(partial(received.__contains__, publish()))
    newest = publish()
    wait_for(lambda: newest in received and newest in sources)
    for ahead in range(1, 51):
        forged = zenoh.SourceInfo(sources[newest].source_id, sources[newest].source_sn + ahead)
        recorder._session.put("reactor/cstr/alarm/recording/zz", b"forged", source_info=forged)
    wait_for(lambda: received.count(b"forged") == 50)
    last = [publish() for _ in range(5)][-1]
    wait_for(lambda: last in received)
    spy.undeclare()
    assert [payload for payload in received if payload != b"forged"] == [
        b"%d" % number for number in range(int(last) + 1)
    ]


def test_the_author_of_a_command_cannot_be_forged(site: Site) -> None:
    intruders = [site.join(who) for who in ("cstr/engineer", "cstr/monitor", "other/plant")]
    for intruder in intruders:
        intruder.publish(Encoded("reactor/cstr/audit/set_input", b"forged", ""))
    site.leave(*intruders)
    site.join("cstr/plant").publish(Encoded("reactor/cstr/audit/set_input", b"recorded", ""))
    received = site.received_until(lambda message: message.payload == b"recorded")
    assert [message.payload for message in received] == [b"recorded"]


HOLDERS = tuple(f"{plant}/{who}" for plant in ("cstr", "other") for who in ("plant", "monitor", "recorder", *PEOPLE))


def answered(
    site: Site, node: str, command: str, *, holders: Sequence[str] = HOLDERS, listened_to: bool = True
) -> set[str]:
    """Holders that get an answer to a command that a node answers, once the router knows that it does."""
    asked, found = [], set[str]()

    def answer(request: Request) -> None:
        asked.append(request)
        request.reply(CommandReply(accepted=True))

    key = f"reactor/cstr/command/{command}"
    site.join(f"cstr/{node}").declare_queryable(key, answer)
    question = Encoded(key, *encode_message(AlarmCommand(alarm="shewhart/T", by="Anna")))
    engineer, latest = site.join("cstr/engineer"), time.monotonic() + WITHIN_S
    while listened_to and not engineer.query(question, WITHIN_S):
        assert time.monotonic() < latest, "an engineer may tell it everything, and is not answered"
    for who in holders:
        asked.clear()
        replies = site.join(who).query(question, WITHIN_S)
        assert bool(asked) == bool(replies), who
        found |= {who} if replies else set()
    return found


@pytest.mark.parametrize(
    ("node", "command", "may"),
    [
        ("monitor", "acknowledge", {"cstr/operator", "cstr/engineer"}),
        ("monitor", "suppress", {"cstr/engineer"}),
        ("monitor", "baseline", {"cstr/engineer"}),
        ("plant", "set_input", {"cstr/engineer"}),
        ("plant", "inject_fault", {"cstr/engineer"}),
    ],
)
def test_only_operators_and_engineers_of_the_plant_command_it(
    site: Site, node: str, command: str, may: set[str]
) -> None:
    assert answered(site, node, command) == may


@pytest.mark.parametrize(("node", "command"), [("monitor", "list_alarms"), ("recorder", "list_recorder_alarms")])
def test_a_viewer_may_ask_what_alarms_there_are(site: Site, node: str, command: str) -> None:
    assert answered(site, node, command, holders=["cstr/viewer"])


def test_a_node_that_pretends_to_be_another_is_not_asked(site: Site) -> None:
    """The plant's certificate cannot answer for the monitor."""
    assert not answered(site, "plant", "acknowledge", holders=["cstr/operator"], listened_to=False)


def test_a_viewer_reads_its_own_plant_and_no_other(site: Site) -> None:
    own: list[Encoded] = []
    foreign: list[Encoded] = []
    wide: list[Encoded] = []
    site.join("cstr/viewer").subscribe("reactor/cstr/**", own.append)
    site.join("other/viewer").subscribe("reactor/cstr/**", foreign.append)
    site.join("other/viewer").subscribe("reactor/**", wide.append)
    plant, stranger = site.join("cstr/plant"), site.join("other/plant")
    plant.publish(sample(b"measured"))
    stranger.publish(Encoded("reactor/other/sample/T", b"not yours", ""))
    site.leave(plant)
    site.leave(stranger)
    site.close_readers()
    assert [message.payload for message in own] == [b"measured"]
    assert not foreign
    assert not wide


def test_a_recorder_of_the_whole_plant_receives_the_history(site: Site) -> None:
    """It asks for that below a wider key than any that the plant publishes on."""
    received: list[Encoded] = []
    site.join("cstr/plant").publish(sample(b"measured"))
    site.received_until(lambda message: message.payload == b"measured")
    site.join("cstr/recorder").subscribe("reactor/cstr/**", received.append, history_s=60.0)
    site.close_readers()
    assert [message.payload for message in received] == [b"measured"]


@pytest.mark.parametrize("whose", ["plant", "recorder"])
def test_what_is_published_while_a_link_is_cut_is_recovered_past_the_rules(site: Site, whose: str) -> None:
    proxy = Proxy(site.endpoint)
    around = {whose: proxy.endpoint.replace("tcp/", "tls/")}
    received: list[bytes] = []
    changed = threading.Condition()

    def receive(message: Encoded) -> None:
        with changed:
            received.append(message.payload)
            changed.notify_all()

    def wait_for(count: int) -> None:
        with changed:
            assert changed.wait_for(lambda: len(received) >= count, WITHIN_S), f"{len(received)} of {count}"

    site.join("cstr/recorder", around.get("recorder")).subscribe("reactor/cstr/**", receive)
    plant = site.join("cstr/plant", around.get("plant"))
    for number in range(50):
        plant.publish(sample(b"%d" % number))
    wait_for(50)
    with proxy.cut("closed"):
        for number in range(50, 100):
            plant.publish(sample(b"%d" % number))
    wait_for(100)
    proxy.close()
    assert received == [b"%d" % number for number in range(100)]


def test_the_history_of_a_plant_is_not_sent_to_a_reader_of_another(site: Site) -> None:
    own: list[Encoded] = []
    foreign: list[Encoded] = []
    site.join("cstr/plant").publish(sample(b"measured"))
    site.received_until(lambda message: message.payload == b"measured")
    site.join("cstr/viewer").subscribe("reactor/cstr/sample/**", own.append, history_s=60.0)
    site.join("other/viewer").subscribe("reactor/cstr/sample/**", foreign.append, history_s=60.0)
    site.close_readers()
    assert [message.payload for message in own] == [b"measured"]
    assert not foreign


def test_liveliness_is_visible_to_readers_of_the_plant_and_cannot_be_forged(site: Site) -> None:
    alive: list[str] = []
    foreign: list[str] = []
    intruder = site.join("cstr/viewer")
    intruder.declare_token("reactor/cstr/alive/monitor")
    intruder.query(
        Encoded("reactor/cstr/command/list_alarms", b"", ALARM), WITHIN_S
    )  # after which the token was judged
    site.join("cstr/monitor").declare_token("reactor/cstr/alive/monitor")
    site.join("cstr/plant").declare_token("reactor/cstr/alive/plant")
    site.join("cstr/operator").subscribe_liveliness("reactor/cstr/alive/**", lambda key, _: alive.append(key))
    site.join("other/operator").subscribe_liveliness("reactor/cstr/alive/**", lambda key, _: foreign.append(key))
    site.close_readers()
    assert sorted(alive) == ["reactor/cstr/alive/monitor", "reactor/cstr/alive/plant"]
    assert not foreign


def test_two_monitors_of_a_plant_notice_each_other_and_cannot_be_feigned(site: Site) -> None:
    changed, seen = threading.Condition(), dict[str, set[str]]()

    def watch(who: str, name: str) -> None:
        def on_token(token: str, is_alive: bool) -> None:
            with changed:
                (seen[name].add if is_alive else seen[name].discard)(token.rpartition("/")[2])
                changed.notify_all()

        seen[name] = set()
        bus = site.join(who)
        bus.subscribe_liveliness(keys.monitor_token("cstr", "*"), on_token)
        bus.declare_token(keys.monitor_token("cstr", name))

    watch("cstr/recorder", "feigned")
    watch("cstr/monitor", "a")
    watch("cstr/monitor", "b")
    with changed:
        assert changed.wait_for(lambda: all(names >= {"a", "b"} for names in seen.values()), WITHIN_S)
    assert seen["a"] | seen["b"] == {"a", "b"}


def test_a_reply_states_the_action_taken(site: Site) -> None:
    """The whole way of a command and its reply, over TLS."""
    site.join("cstr/monitor").declare_queryable(
        "reactor/cstr/command/acknowledge", lambda request: request.reply(CommandReply(accepted=True, text="seen"))
    )
    question = Encoded("reactor/cstr/command/acknowledge", *encode_message(AlarmCommand(alarm="a", by="Anna")))
    (answer,) = site.join("cstr/operator").query(question, WITHIN_S)
    assert decode(answer.payload, answer.encoding) == CommandReply(accepted=True, text="seen")


WILDCARDS = ("sample/*", "sample/**", "sample/T$*", "sample/$*T", "**", "*/T")


def test_a_message_on_many_keys_at_once_reaches_no_node(site: Site) -> None:
    """A router refuses what leaves the rights of its publisher; what does not is refused by the nodes."""
    viewer, plant = site.join("cstr/viewer"), site.join("cstr/plant")
    came, last = list[str](), threading.Semaphore(0)

    def note(message: Encoded) -> None:
        came.append(message.key)
        if message.key.endswith("/last"):
            last.release()

    def note_all(messages: list[Encoded]) -> None:
        for message in messages:
            note(message)

    viewer.subscribe("reactor/cstr/**", note)
    viewer.subscribe_batched("reactor/cstr/sample/**", note_all)
    viewer.subscribe_uncached("reactor/cstr/sample/*", note)
    plant.publish(Encoded("reactor/cstr/sample/first", b"", ""))
    for wildcard in WILDCARDS:
        plant._session.put(f"reactor/cstr/{wildcard}", b"made up")
    plant.publish(Encoded("reactor/cstr/sample/last", b"", ""))
    for _ in range(3):
        assert last.acquire(timeout=WITHIN_S)
    assert set(came) == {"reactor/cstr/sample/first", "reactor/cstr/sample/last"}
