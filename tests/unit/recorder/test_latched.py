"""Latched messages at the start of a file."""

from google.protobuf.message import Message

from reactorwatch.contract import messages_pb2 as messages
from recorder import RecordedMessage
from recorder.keep import LatchedMessages


def remembered(*told: tuple[str, Message], most: int = 100) -> LatchedMessages:
    head = LatchedMessages(most)
    for number, (key, message) in enumerate(told):
        head.update(RecordedMessage(key, message.SerializeToString(), "?", number, 100 + number), message)
    return head


def test_the_last_message_of_each_model_alarm_and_fault_is_repeated_and_nothing_else() -> None:
    head = remembered(
        ("model/T", messages.ModelSnapshot(reference=True, rows=1)),
        ("model/T", messages.ModelSnapshot(reference=False, rows=2)),
        ("model/T", messages.ModelSnapshot(held=True, rows=2)),
        ("model/T", messages.ModelSnapshot(structure="equations", reference=True)),
        ("alarm/a", messages.Alarm(alarm="a", event="raised")),
        ("sample/T", messages.Sample(value=1.0)),
        ("health/monitor", messages.Health()),
        ("model/T", messages.ModelSnapshot(reference=False, rows=3)),
        ("fault/x", messages.Fault(cause="x")),
        ("alarm/a", messages.Alarm(alarm="a", event="cleared")),
    )
    entries = head.messages(1000)
    assert [entry.publish_time_ns - 100 for entry in entries] == [0, 2, 3, 7, 8, 9]
    assert {(entry.log_time_ns, entry.latched) for entry in entries} == {(1000, True)}


def test_an_incident_is_repeated_until_all_its_alarms_are_normal() -> None:
    """One of which an alarm has returned and was not acknowledged still waits for an operator, with its suspects."""
    first, over = (
        messages.Incident(number=1, alarms=["a"], until_ns=5, state=state)
        for state in (messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED, messages.ALARM_STATE_NORMAL)
    )
    second = messages.Incident(number=2, alarms=["b"], state=messages.ALARM_STATE_UNACKNOWLEDGED)
    active = remembered(("incident/1", first), ("incident/2", second)).messages(1000)
    assert [entry.key for entry in active] == ["incident/1", "incident/2"]
    later = remembered(("incident/1", first), ("incident/2", second), ("incident/1", over)).messages(1000)
    assert [entry.key for entry in later] == ["incident/2"]


def test_of_more_than_it_may_hold_the_oldest_are_forgotten() -> None:
    head = remembered(*((f"alarm/{number % 5}", messages.Alarm()) for number in range(20)), most=3)
    assert [entry.key for entry in head.messages(1000)] == ["alarm/2", "alarm/3", "alarm/4"]
