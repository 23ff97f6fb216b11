"""The recorder's own alarm can be seen and acknowledged, and nothing else."""

import pytest
from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Encoded, Publication, encode_message
from reactorwatch.contract.messages_pb2 import Alarm, AlarmCommand, CommandReply, ListAlarms
from recorder.disk_alarm import DISK_ALARM, DiskAlarm

NORMAL, RAISED = messages.ALARM_STATE_NORMAL, messages.ALARM_STATE_UNACKNOWLEDGED
SEEN, GONE = messages.ALARM_STATE_ACKNOWLEDGED, messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED

BY_ADA = AlarmCommand(alarm=DISK_ALARM, by="Ada", comment="I make room")


def ask(alarm: DiskAlarm, name: str, message: Message) -> tuple[CommandReply, list[Publication]]:
    return alarm.obey(Encoded(keys.key("cstr", keys.COMMAND, name), *encode_message(message)), 7)


def now(alarm: DiskAlarm) -> Alarm:
    (listed,) = ask(alarm, keys.LIST_RECORDER_ALARMS, ListAlarms())[0].alarms
    return listed


def test_it_goes_through_the_states_that_any_alarm_does() -> None:
    """ISA-18.2: raised, seen, gone; and raised, gone, seen."""
    alarm = DiskAlarm("cstr")
    assert now(alarm).state == NORMAL
    alarm.come_up("no space left", 1)
    assert (now(alarm).state, now(alarm).raised_ns, now(alarm).cleared_ns) == (RAISED, 1, 0)
    ask(alarm, keys.ACKNOWLEDGE_RECORDER, BY_ADA)
    assert now(alarm).state == SEEN
    alarm.go(3, 2)
    assert (now(alarm).state, now(alarm).cleared_ns) == (NORMAL, 2)
    alarm.come_up("no space left", 3)
    assert (now(alarm).state, now(alarm).by) == (RAISED, "")
    alarm.go(3, 4)
    assert now(alarm).state == GONE
    ask(alarm, keys.ACKNOWLEDGE_RECORDER, BY_ADA)
    assert now(alarm).state == NORMAL


def test_who_saw_it_is_told_to_who_asks_and_to_all() -> None:
    alarm = DiskAlarm("cstr")
    alarm.come_up("no space left", 1)
    reply, (told,) = ask(alarm, keys.ACKNOWLEDGE_RECORDER, BY_ADA)
    assert reply.accepted
    assert told.key == "reactor/cstr/alarm/recording/disk"
    assert isinstance(told.message, Alarm)
    assert reply.alarms[0] == told.message == now(alarm)
    assert (told.message.event, told.message.by, told.message.comment, told.message.time_ns) == (
        "acknowledge",
        "Ada",
        "I make room",
        7,
    )


@pytest.mark.parametrize(
    ("name", "message", "said"),
    [
        (keys.ACKNOWLEDGE_RECORDER, AlarmCommand(alarm=DISK_ALARM), "by must name the person"),
        (keys.ACKNOWLEDGE_RECORDER, AlarmCommand(alarm="ewma/T", by="Ada"), "no alarm 'ewma/T' of the recorder"),
        (keys.ACKNOWLEDGE_RECORDER, AlarmCommand(alarm=DISK_ALARM, by="A", comment="x" * 1001), "at most 1000"),
        (keys.ACKNOWLEDGE_RECORDER, ListAlarms(), "command acknowledge_recorder must carry"),
        ("shelve", BY_ADA, "unknown command 'shelve' (valid: list_recorder_alarms, acknowledge_recorder)"),
    ],
)
def test_what_cannot_be_done_is_refused_with_the_reason(name: str, message: Message, said: str) -> None:
    alarm = DiskAlarm("cstr")
    alarm.come_up("no space left", 1)
    reply, told = ask(alarm, name, message)
    assert (reply.accepted, told) == (False, [])
    assert said in reply.text
    assert now(alarm).state == RAISED


def test_it_is_acknowledged_once_and_not_before_it_comes_up() -> None:
    alarm = DiskAlarm("cstr")
    assert "has not come up" in ask(alarm, keys.ACKNOWLEDGE_RECORDER, BY_ADA)[0].text
    alarm.come_up("no space left", 1)
    assert ask(alarm, keys.ACKNOWLEDGE_RECORDER, BY_ADA)[0].accepted
    assert "is acknowledged already" in ask(alarm, keys.ACKNOWLEDGE_RECORDER, BY_ADA)[0].text
