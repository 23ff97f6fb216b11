"""The recorder's own alarms: it cannot write (`recording/disk`), or a file has no free key (`recording/keys`). Pure.

Their states are a subset of ISA-18.2: unacknowledged, acknowledged, returned unacknowledged, normal. Neither can be
shelved or suppressed: an incomplete recording must stay visible.
"""

from collections.abc import Mapping
from typing import Any

from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import DecodeError, Encoded, Publication
from reactorwatch.contract.commands import check_signature, decode_command
from reactorwatch.contract.messages_pb2 import AlarmCommand, CommandReply, ListAlarms
from reactorwatch.errors import InputError

DISK_ALARM = f"{keys.RECORDING}/disk"
KEYS_ALARM = f"{keys.RECORDING}/keys"
PRIORITIES: Mapping[str, messages.Priority] = {
    DISK_ALARM: messages.PRIORITY_CRITICAL,
    KEYS_ALARM: messages.PRIORITY_HIGH,
}
"""Priority by alarm."""
COMMANDS: Mapping[str, type[Message]] = {
    keys.LIST_RECORDER_ALARMS: ListAlarms,
    keys.ACKNOWLEDGE_RECORDER: AlarmCommand,
}
"""Message type by command."""

_ACTIVE = (messages.ALARM_STATE_UNACKNOWLEDGED, messages.ALARM_STATE_ACKNOWLEDGED)


class OwnAlarms:
    """States of the recorder's alarms.

    Args:
        plant: plant that the alarms are published under.
    """

    def __init__(self, plant: str) -> None:
        self._plant = plant
        self._now = {
            name: messages.Alarm(alarm=name, state=messages.ALARM_STATE_NORMAL, priority=priority)
            for name, priority in PRIORITIES.items()
        }

    @property
    def now(self) -> list[messages.Alarm]:
        """Alarms in their present state."""
        return list(self._now.values())

    def is_active(self, name: str) -> bool:
        """True from raised to cleared."""
        return self._now[name].state in _ACTIVE

    def raise_alarm(self, name: str, text: str, now_ns: int) -> Publication:
        """Raise an alarm."""
        state = messages.ALARM_STATE_UNACKNOWLEDGED
        values = {"state": state, "raised_ns": now_ns, "cleared_ns": 0, "text": text, "by": "", "comment": ""}
        return self._change(name, "raised", now_ns, **values)

    def clear(self, name: str, text: str, now_ns: int) -> Publication:
        """Clear an alarm."""
        acknowledged = self._now[name].state == messages.ALARM_STATE_ACKNOWLEDGED
        state = messages.ALARM_STATE_NORMAL if acknowledged else messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED
        return self._change(name, "cleared", now_ns, state=state, cleared_ns=now_ns, text=text)

    def execute(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        """Execute a command: list the alarms or acknowledge one. A refusal is a reply with the reason."""
        try:
            return self._answer(question, now_ns)
        except (InputError, DecodeError) as error:
            return CommandReply(accepted=False, text=str(error)), []

    def _answer(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        _, command = decode_command(question, COMMANDS)
        if isinstance(command, ListAlarms):
            return CommandReply(accepted=True, text=f"{len(self._now)} alarms", alarms=self.now), []
        assert isinstance(command, AlarmCommand), "the catalogue holds no others"
        change = self._acknowledge(command, now_ns)
        text = f"alarm {command.alarm}: acknowledge"
        return CommandReply(accepted=True, text=text, alarms=[self._now[command.alarm]]), [change]

    def _acknowledge(self, command: AlarmCommand, now_ns: int) -> Publication:
        name = command.alarm
        if name not in self._now:
            raise InputError(f"no alarm {name!r} of the recorder (there are: {', '.join(self._now)})")
        by, comment = check_signature(command.by, command.comment)
        after = {
            messages.ALARM_STATE_UNACKNOWLEDGED: messages.ALARM_STATE_ACKNOWLEDGED,
            messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED: messages.ALARM_STATE_NORMAL,
        }
        state = self._now[name].state
        if state not in after:
            acknowledged = state == messages.ALARM_STATE_ACKNOWLEDGED
            raise InputError(f"alarm {name} {'is acknowledged already' if acknowledged else 'has not come up'}")
        return self._change(name, "acknowledge", now_ns, state=after[state], by=by, comment=comment)

    def _change(self, name: str, event: str, now_ns: int, **values: Any) -> Publication:
        alarm = self._now[name]
        for field, value in {"time_ns": now_ns, "event": event, **values}.items():
            setattr(alarm, field, value)
        published = messages.Alarm()
        published.CopyFrom(alarm)
        return Publication(keys.key(self._plant, keys.ALARM, name), published)
