"""The recorder's own alarm, `recording/disk`: it cannot write. Pure.

Its states are those of ISA-18.2 that a person needs of it: raised, acknowledged, gone again before anybody said that he
saw it, normal. Nothing else can be done to it: a recorder that cannot write should not be put out of sight.
"""

from collections.abc import Mapping
from typing import Any

from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import DecodeError, Encoded, Publication
from reactorwatch.contract.commands import command_in, signed
from reactorwatch.contract.messages_pb2 import AlarmCommand, CommandReply, ListAlarms
from reactorwatch.errors import InputError

DISK_ALARM = f"{keys.RECORDING}/disk"
COMMANDS: Mapping[str, type[Message]] = {
    keys.LIST_RECORDER_ALARMS: ListAlarms,
    keys.ACKNOWLEDGE_RECORDER: AlarmCommand,
}
"""The recorder's commands and what they carry."""


class DiskAlarm:
    """The alarm and its state.

    Args:
        plant: the plant that it is published under.
    """

    def __init__(self, plant: str) -> None:
        self._key = keys.key(plant, keys.ALARM, DISK_ALARM)
        self._now = messages.Alarm(
            alarm=DISK_ALARM, state=messages.ALARM_STATE_NORMAL, priority=messages.PRIORITY_CRITICAL
        )

    @property
    def now(self) -> messages.Alarm:
        """The alarm as it is."""
        return self._now

    def come_up(self, why: str, now_ns: int) -> Publication:
        """The file cannot be written."""
        text = f"recording stopped: {why}; it goes on when there is room"
        state = messages.ALARM_STATE_UNACKNOWLEDGED
        return self._change("raised", now_ns, state=state, raised_ns=now_ns, cleared_ns=0, text=text, by="", comment="")

    def go(self, missing: int, now_ns: int) -> Publication:
        """There is a file again; so many messages are missing so far."""
        seen = self._now.state == messages.ALARM_STATE_ACKNOWLEDGED
        state = messages.ALARM_STATE_NORMAL if seen else messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED
        text = f"recording goes on; {missing} messages are missing so far"
        return self._change("cleared", now_ns, state=state, cleared_ns=now_ns, text=text)

    def obey(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        """Tell the alarm as it is, or take note that somebody has seen it; or say why not."""
        try:
            return self._answer(question, now_ns)
        except (InputError, DecodeError) as error:
            return CommandReply(accepted=False, text=str(error)), []

    def _answer(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        _, command = command_in(question, COMMANDS)
        if isinstance(command, ListAlarms):
            return CommandReply(accepted=True, text="1 alarm", alarms=[self._now]), []
        assert isinstance(command, AlarmCommand), "the catalogue holds no others"
        told = self._acknowledge(command, now_ns)
        return CommandReply(accepted=True, text=f"alarm {DISK_ALARM}: acknowledge", alarms=[self._now]), [told]

    def _acknowledge(self, command: AlarmCommand, now_ns: int) -> Publication:
        if command.alarm != DISK_ALARM:
            raise InputError(f"no alarm {command.alarm!r} of the recorder (there is: {DISK_ALARM})")
        by, comment = signed(command.by, command.comment)
        after = {
            messages.ALARM_STATE_UNACKNOWLEDGED: messages.ALARM_STATE_ACKNOWLEDGED,
            messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED: messages.ALARM_STATE_NORMAL,
        }
        if self._now.state not in after:
            seen = self._now.state == messages.ALARM_STATE_ACKNOWLEDGED
            why = "is acknowledged already" if seen else "has not come up"
            raise InputError(f"alarm {DISK_ALARM} {why}")
        return self._change("acknowledge", now_ns, state=after[self._now.state], by=by, comment=comment)

    def _change(self, event: str, now_ns: int, **values: Any) -> Publication:
        for name, value in {"time_ns": now_ns, "event": event, **values}.items():
            setattr(self._now, name, value)
        told = messages.Alarm()
        told.CopyFrom(self._now)
        return Publication(self._key, told)
