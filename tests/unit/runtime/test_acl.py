"""Rules of access: a number counts only among messages of one role, and commands are published for audit.

No role can use up the numbers of another role's publisher; the record of a command has its author and result.
"""

import itertools
import threading
from functools import cache

import pytest
from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, decode, encode_message
from reactorwatch.contract.keys import matches
from reactorwatch.contract.messages_pb2 import (
    AlarmCommand,
    Audit,
    BaselineCommand,
    ClearFault,
    CommandReply,
    InjectFault,
    ListAlarms,
    SetInput,
    ShelveAlarm,
)
from reactorwatch.runtime.acl import ROLES, access_control, audit
from reactorwatch.runtime.delivery import MAX_CACHED, Delivery, SequencedMessage, keys_of, role_of_key, stream_of
from reactorwatch.runtime.event_loop import EventLoop, StopSignal
from reactorwatch.runtime.reorder_buffer import Gap
from tests.memory_bus import Exchange, MemoryBus
from tests.running import WITHIN_S, running

ROOT = "reactor/cstr"
KINDS = (
    *(keys.SAMPLE, keys.ESTIMATE, keys.MODEL, keys.CHART, keys.ALARM, keys.ALARM_KPIS, keys.RECONSTRUCTION),
    *(keys.HEALTH, keys.FAULT, keys.AUDIT, "weather"),
)
NODES = [node for role in ROLES for node in role.nodes]
COMMANDS = [command for role in ROLES for command in role.answers]
NAMES = ("T", "ewma/T", "zz", "recording", "recording/disk", "recording/zz/a", "@doctor/x", *NODES, *COMMANDS)
KEYS = [f"{ROOT}/{kind}" for kind in KINDS] + [f"{ROOT}/{kind}/{name}" for kind in KINDS for name in NAMES]
PUBLISHERS = [role.name for role in ROLES if role.nodes]


@cache
def publishers(key: str) -> frozenset[str]:
    """The roles that the router lets publish on a key, by its rules, with certificates for the plant or for all."""
    rules = access_control(("cstr", "fleet"))["rules"]
    found = set()
    for name, plant in itertools.product(PUBLISHERS, ("cstr", "@fleet")):
        own = [rule for rule in rules if rule["id"].startswith(f"{plant}.{name}:") and "put" in rule["messages"]]
        permissions = {rule["permission"] for rule in own if any(matches(each, key) for each in rule["key_exprs"])}
        if permissions == {"allow"}:
            found.add(name)
    return frozenset(found)


def test_the_rules_let_one_role_alone_publish_on_a_key_but_for_doctor_s_proofs() -> None:
    for key in KEYS:
        assert len(publishers(key)) <= 1 or "@doctor" in key, key
    assert set().union(*map(publishers, KEYS)) == set(PUBLISHERS)


def test_all_keys_of_a_stream_are_of_the_same_role() -> None:
    by_stream = itertools.groupby(sorted(KEYS, key=stream_of), key=stream_of)
    for stream, group in by_stream:
        roles = {publishers(key) for key in group if "@doctor" not in key}
        assert len(roles) <= 1, (stream, roles)


def test_proofs_of_doctor_and_keys_of_no_role_are_in_no_role_s_stream() -> None:
    of_roles = {stream_of(key) for key in KEYS if publishers(key) and "@doctor" not in key}
    assert of_roles.isdisjoint(stream_of(key) for key in KEYS if "@doctor" in key or not publishers(key))


def test_all_that_one_node_publishes_of_one_kind_is_one_stream() -> None:
    """Else a row of samples, or the alarms of one moment, would have no order after a cut."""
    published = [key for key in KEYS if "@doctor" not in key]
    for role, kind in itertools.product(PUBLISHERS, KINDS):
        streams = {stream_of(key) for key in published if publishers(key) == {role} and key.split("/")[2] == kind}
        assert len(streams) <= 1


def test_publishers_are_asked_again_for_all_keys_of_a_stream() -> None:
    assert all(matches(keys_of(stream_of(key)), key) for key in KEYS if "@doctor" not in key)


@pytest.mark.parametrize("intruder", PUBLISHERS)
@pytest.mark.parametrize("told_before", [False, True])
def test_numbers_that_another_role_uses_up_suppress_no_message(intruder: str, *, told_before: bool) -> None:
    """On each of its keys it sends 30 messages with the publisher's name and its next numbers, and as its last ones."""
    own = [key for key in KEYS if intruder in publishers(key)]
    for victim_key in (key for key in KEYS if publishers(key) and intruder not in publishers(key)):
        heard: list[Encoded] = []
        gaps: list[Gap] = []
        delivery = Delivery(heard.extend, gaps.append)
        near = [key for key in own if key.split("/")[2] == victim_key.split("/")[2]]
        forged = [(1, 1 + number, Encoded(key, b"forged", "")) for key in near for number in range(30)]
        if told_before:
            delivery.receive([(1, 0, Encoded(victim_key, b"", ""))])
            for publisher, number, message in forged:
                delivery.set_last(SequencedMessage(publisher, number, message))
            delivery.start()
        else:
            delivery.start()
            delivery.receive([(1, 0, Encoded(victim_key, b"", ""))])
        delivery.receive(forged)
        delivery.receive([(1, number, Encoded(victim_key, b"", "")) for number in range(1, 6)])
        delivery.close()
        assert [item.key for item in heard].count(victim_key) == 6, victim_key
        assert stream_of(victim_key) not in {gap.stream for gap in gaps}


def test_of_keys_without_number_a_thousand_names_are_kept_and_of_plants_none() -> None:
    """A key may have 65,535 characters, and its sender chooses them."""
    role_of_key.cache_clear()
    for number in range(2 * MAX_CACHED):
        assert stream_of(f"reactor/p{number}/sample/T") == f"reactor/p{number}/sample"
    assert role_of_key.cache_info().currsize == 1
    for number in range(2 * MAX_CACHED):
        assert stream_of(f"reactor/cstr/sample/x{number}") == "reactor/cstr/sample"
    assert role_of_key.cache_info().currsize == MAX_CACHED == 1000


def asked(name: str, command: Message) -> Encoded:
    return Encoded(f"reactor/cstr/command/{name}", *encode_message(command))


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("set_input", SetInput(signal="qc", value=100.0, by="Anna")),
        ("inject_fault", InjectFault(specification="coolant_flow:step:-0.05", by="Anna")),
        ("clear_fault", ClearFault(cause="coolant_flow", by="Anna")),
        ("acknowledge", AlarmCommand(alarm="shewhart/T", by="Anna")),
        ("shelve", ShelveAlarm(alarm="shewhart/T", by="Anna", minutes=5.0)),
        ("baseline", BaselineCommand(what="relearn", by="Anna", why="new pump")),
    ],
)
def test_every_command_that_changes_something_is_recorded_with_its_author(name: str, command: Message) -> None:
    found = audit(asked(name, command), CommandReply(accepted=True, text="done"), 7)
    assert found is not None
    assert found.key == f"reactor/cstr/audit/{name}"
    record = found.message
    assert isinstance(record, Audit)
    assert (record.time_ns, record.command, record.by, record.accepted, record.text) == (7, name, "Anna", True, "done")
    assert 'by: "Anna"' in record.request


def test_what_was_refused_is_recorded_as_such() -> None:
    found = audit(asked("set_input", SetInput(signal="x")), CommandReply(accepted=False, text="no such input"), 7)
    assert found is not None
    assert isinstance(found.message, Audit)
    assert (found.message.accepted, found.message.text) == (False, "no such input")


def test_what_cannot_be_read_is_recorded_without_its_content() -> None:
    question = Encoded("reactor/cstr/command/set_input", b"\xff", "application/json")
    found = audit(question, CommandReply(accepted=False, text="encoding must be"), 7)
    assert found is not None
    assert isinstance(found.message, Audit)
    assert (found.message.by, found.message.request) == ("", "")


def test_a_question_that_changes_nothing_is_not_recorded() -> None:
    assert audit(asked("list_alarms", ListAlarms()), CommandReply(accepted=True), 7) is None
    assert audit(asked("baseline", BaselineCommand(what="list")), CommandReply(accepted=True), 7) is None


class Obedient:
    """A node that does nothing but what it is told."""

    finished = False

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        return []

    def on_tick(self, now_ns: int) -> list[Publication]:
        return []

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        return CommandReply(accepted=True, text="done"), []

    def next_tick_ns(self) -> int:
        return 10**19

    def on_stop(self, now_ns: int) -> list[Publication]:
        return []


def test_a_node_s_loop_publishes_the_record_after_the_answer() -> None:
    exchange, stop, recorded = Exchange(), StopSignal(), threading.Event()
    heard: list[Encoded] = []

    def on_record(message: Encoded) -> None:
        heard.append(message)
        recorded.set()

    MemoryBus(exchange).subscribe("reactor/cstr/audit/**", on_record)
    loop = EventLoop(Obedient(), MemoryBus(exchange), stop)
    loop.accept_commands("reactor/cstr/command/clear_fault")
    with running(loop.run, stop):
        MemoryBus(exchange).query(asked("clear_fault", ClearFault(by="Anna")), WITHIN_S)
        assert recorded.wait(WITHIN_S)
    record = decode(heard[0].payload, heard[0].encoding)
    assert isinstance(record, Audit)
    assert (record.by, record.text) == ("Anna", "done")
