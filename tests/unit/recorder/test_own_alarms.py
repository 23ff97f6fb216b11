"""The recorder's own alarms can be seen and acknowledged, and nothing else."""

import pytest
from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Encoded, Publication, encode_message
from reactorwatch.contract.messages_pb2 import Alarm, AlarmCommand, CommandReply, ListAlarms
from recorder.core import DISK_ALARM, PRIORITIES, OwnAlarms

NORMAL, RAISED = messages.ALARM_STATE_NORMAL, messages.ALARM_STATE_UNACKNOWLEDGED
SEEN, GONE = messages.ALARM_STATE_ACKNOWLEDGED, messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED
EACH = pytest.mark.parametrize("name", list(PRIORITIES))


def by_ada(name: str) -> AlarmCommand:
    return AlarmCommand(alarm=name, by="Ada", comment="I make room")


def ask(alarms: OwnAlarms, command: str, message: Message) -> tuple[CommandReply, list[Publication]]:
    return alarms.execute(Encoded(keys.key("cstr", keys.COMMAND, command), *encode_message(message)), 7)


def now(alarms: OwnAlarms, name: str) -> Alarm:
    listed = ask(alarms, keys.LIST_RECORDER_ALARMS, ListAlarms())[0].alarms
    return next(alarm for alarm in listed if alarm.alarm == name)


@EACH
def test_each_goes_through_the_states_that_any_alarm_does_and_the_others_stay_as_they_are(name: str) -> None:
    """ISA-18.2: raised, acknowledged, cleared; and raised, cleared, acknowledged."""
    alarms = OwnAlarms("cstr")
    others = [alarm for alarm in PRIORITIES if alarm != name]
    assert now(alarms, name).state == NORMAL
    alarms.raise_alarm(name, "no space left", 1)
    assert (now(alarms, name).state, now(alarms, name).raised_ns, now(alarms, name).cleared_ns) == (RAISED, 1, 0)
    assert now(alarms, name).priority == PRIORITIES[name]
    ask(alarms, keys.ACKNOWLEDGE_RECORDER, by_ada(name))
    assert now(alarms, name).state == SEEN
    assert alarms.is_active(name)
    alarms.clear(name, "there is room", 2)
    assert (now(alarms, name).state, now(alarms, name).cleared_ns) == (NORMAL, 2)
    alarms.raise_alarm(name, "no space left", 3)
    assert (now(alarms, name).state, now(alarms, name).by) == (RAISED, "")
    alarms.clear(name, "there is room", 4)
    assert now(alarms, name).state == GONE
    ask(alarms, keys.ACKNOWLEDGE_RECORDER, by_ada(name))
    assert now(alarms, name).state == NORMAL
    assert {now(alarms, other).state for other in others} == {NORMAL}


@EACH
def test_an_acknowledgement_is_published_with_the_person_and_the_comment(name: str) -> None:
    alarms = OwnAlarms("cstr")
    alarms.raise_alarm(name, "no space left", 1)
    reply, (published,) = ask(alarms, keys.ACKNOWLEDGE_RECORDER, by_ada(name))
    assert reply.accepted
    assert published.key == f"reactor/cstr/alarm/{name}"
    message = published.message
    assert isinstance(message, Alarm)
    assert reply.alarms[0] == message == now(alarms, name)
    assert (message.event, message.by, message.comment, message.time_ns) == ("acknowledge", "Ada", "I make room", 7)


@pytest.mark.parametrize(
    ("command", "message", "text"),
    [
        (keys.ACKNOWLEDGE_RECORDER, AlarmCommand(alarm=DISK_ALARM), "by must name the person"),
        (keys.ACKNOWLEDGE_RECORDER, AlarmCommand(alarm="ewma/T", by="Ada"), "no alarm 'ewma/T' of the recorder"),
        (keys.ACKNOWLEDGE_RECORDER, AlarmCommand(alarm=DISK_ALARM, by="A", comment="x" * 1001), "at most 1000"),
        (keys.ACKNOWLEDGE_RECORDER, ListAlarms(), "command acknowledge_recorder must carry"),
        ("shelve", by_ada(DISK_ALARM), "unknown command 'shelve' (valid: list_recorder_alarms, acknowledge_recorder)"),
    ],
)
def test_what_cannot_be_done_is_refused_with_the_reason(command: str, message: Message, text: str) -> None:
    alarms = OwnAlarms("cstr")
    alarms.raise_alarm(DISK_ALARM, "no space left", 1)
    reply, published = ask(alarms, command, message)
    assert (reply.accepted, published) == (False, [])
    assert text in reply.text
    assert now(alarms, DISK_ALARM).state == RAISED


@EACH
def test_each_is_acknowledged_once_and_not_before_it_is_raised(name: str) -> None:
    alarms = OwnAlarms("cstr")
    assert "is normal, there is nothing to acknowledge" in ask(alarms, keys.ACKNOWLEDGE_RECORDER, by_ada(name))[0].text
    alarms.raise_alarm(name, "no space left", 1)
    assert ask(alarms, keys.ACKNOWLEDGE_RECORDER, by_ada(name))[0].accepted
    assert "is acknowledged already" in ask(alarms, keys.ACKNOWLEDGE_RECORDER, by_ada(name))[0].text
