"""Commands are published for audit, with their author and result."""

import threading

import pytest
from google.protobuf.message import Message

from reactorwatch.contract.codec import Encoded, Publication, decode, encode_message
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
from reactorwatch.runtime.acl import audit
from reactorwatch.runtime.event_loop import EventLoop, StopSignal
from tests.memory_bus import Exchange, MemoryBus
from tests.running import WITHIN_S, running


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
