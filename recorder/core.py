"""Core of the recorder: decode, count and time-stamp received messages. Pure: no file, no bus, no clock.

Every message is recorded, unreadable ones too: a recording serves to find out what went wrong. An unreadable message
is recorded without a schema, so that it stops no reader, and is counted as refused.

The recorder has alarms of its own: it cannot write (`recording/disk`), or a file has no free key (`recording/keys`).
Their states follow the table of every alarm. There is no command to shelve or suppress one: an incomplete recording
must stay visible.
"""

from collections import Counter
from collections.abc import Collection, Mapping
from typing import Any

import structlog
from google.protobuf.message import DecodeError as ProtobufDecodeError
from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.alarm_states import CODES, Event, State, next_state
from reactorwatch.contract.codec import (
    MAX_PAYLOAD,
    DecodeError,
    Encoded,
    Publication,
    check_signature,
    decode,
    decode_command,
    encoding_of,
)
from reactorwatch.contract.messages_pb2 import AlarmCommand, CommandReply, ListAlarms
from reactorwatch.errors import InputError
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.runtime.reorder_buffer import Gap
from reactorwatch.version import version
from recorder import Channel, StoredMessage
from recorder.keep import MAX_KEYS, channel_of
from recorder.samples import SequenceCounter

log = structlog.get_logger()

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

NODE = "recorder"

_SAMPLE = encoding_of(messages.Sample)


class ReceivedMessage(StoredMessage, gc=False):
    """A received message with its decoded content; None for a sample, and if it is not what its encoding names."""

    message: Message | None = None


def fingerprint(key: str, payload: bytes) -> int:
    """Hash of a message; differs between processes."""
    return hash((key, payload))


class Recorder:
    """Decodes and counts messages, and holds the recorder's alarms.

    Args:
        plant: plant that health is reported under.
        start_ns: clock reading at the start.
        fingerprints: hashes of messages in earlier files, which the bus may deliver once more.
        fingerprints_until_ns: time after which `fingerprints` are dropped.

    Attributes:
        alarms: alarms of the recorder itself.
        is_stopped: True while no file can be written.
    """

    def __init__(
        self, plant: str, start_ns: int, fingerprints: Collection[int] = (), fingerprints_until_ns: int = 0
    ) -> None:
        self._fingerprints = set(fingerprints)
        self._fingerprints_until_ns = fingerprints_until_ns
        self._unrecovered = 0
        self._plant = plant
        self._start_ns = start_ns
        self._last_ns = start_ns
        self._received = 0
        self._reports = 0
        self._longest_lag_ns = 0
        self._refused: Counter[str] = Counter()
        self.is_stopped = False
        self.alarms = OwnAlarms(plant)
        self._counters: dict[str, tuple[Channel, SequenceCounter]] = {}  # by key, the least recently used first
        self._sample = messages.Sample()  # samples are decoded into it, as none is held
        self._evicted = SequenceCounter()  # counts of evicted keys
        self._no_room_ns = 0  # time of the last rejected message
        self._logged_ns: int | None = None  # time of the last log line about it

    def on_message(self, message: Encoded, now_ns: int) -> ReceivedMessage | None:
        """Decode and count a message; None if an earlier file holds it.

        The time of receipt never decreases, even if the clock is set back: the order in the file is the order of
        receipt.
        """
        key, payload, encoding, received_ns = message
        self._received += 1
        if not received_ns:
            received_ns = now_ns
        elif now_ns - received_ns > self._longest_lag_ns:
            self._longest_lag_ns = now_ns - received_ns
        is_recorded = self._fingerprints and self._is_recorded(key, payload, now_ns)
        if received_ns < self._last_ns:
            received_ns = self._last_ns
        self._last_ns = received_ns
        counters, counted = self._counters, None
        if encoding == _SAMPLE and len(payload) <= MAX_PAYLOAD:
            counted = counters.pop(key, None) or self._new_counter(key)
        if counted is None:
            return None if is_recorded else self._receive_other(key, payload, encoding, received_ns)
        counters[key] = counted
        channel, counter = counted
        # a message that is decoded into another frees nothing that it held: a new one for some, and for large payloads
        if not self._received % 1000 or len(payload) > 256:
            self._sample = messages.Sample()
        sample = self._sample
        try:
            sample.ParseFromString(payload)
        except ProtobufDecodeError:
            return None if is_recorded else self._receive_other(key, payload, encoding, received_ns)
        time_ns, sequence = sample.time_ns, sample.sequence
        is_valid = time_ns >= 0 and sample.quality  # 0: it is unspecified
        if is_valid:  # one that an earlier file holds as well: those around it in this file are not lost
            counter.update(sequence, time_ns)
        if is_recorded:
            return None
        if time_ns < 0:
            time_ns = self._correct_time(received_ns)
        elif not is_valid:
            self._refused["payload"] += 1
        return ReceivedMessage(channel, sequence, received_ns, time_ns, payload)

    def _receive_other(self, key: str, payload: bytes, encoding: str, received_ns: int) -> ReceivedMessage:
        """Decode a message that is not a sample of the product, or not one that can be read."""
        try:
            decoded: Any = decode(payload, encoding)
        except DecodeError as error:
            self._refused[error.reason] += 1
            channel = channel_of(key, encoding, is_readable=False)
            return ReceivedMessage(channel, 0, received_ns, received_ns, payload)
        channel = channel_of(key, encoding, is_readable=True)
        if not channel.is_product:
            self._refused["key"] += 1
        time_ns, sequence = getattr(decoded, "time_ns", received_ns), 0
        if isinstance(decoded, messages.Sample):
            sequence = decoded.sequence
            if time_ns >= 0 and not decoded.quality:  # protobuf reads 0 out of bytes that hold something else
                self._refused["payload"] += 1
        if time_ns < 0:
            time_ns = self._correct_time(received_ns)
        return ReceivedMessage(channel, sequence, received_ns, time_ns, payload, decoded)

    def _correct_time(self, received_ns: int) -> int:
        """Count a time before 1970, which MCAP cannot represent; the time of receipt replaces it."""
        self._refused["time"] += 1
        return received_ns

    def _new_counter(self, key: str) -> tuple[Channel, SequenceCounter] | None:
        """Channel and counter of a new key of samples; None if it is not one of the product.

        With a counter for each of `MAX_KEYS` keys, the least recently used one is evicted.
        """
        channel = channel_of(key, _SAMPLE, is_readable=True)
        if not channel.is_product:
            return None
        if len(self._counters) >= MAX_KEYS:
            _, evicted = self._counters.pop(next(iter(self._counters)))
            self._evicted.lost += evicted.lost
            self._evicted.duplicated += evicted.duplicated
            self._evicted.out_of_order += evicted.out_of_order
        return channel, SequenceCounter()

    def _is_recorded(self, key: str, payload: bytes, now_ns: int) -> bool:
        """True if an earlier file holds the message; each fingerprint matches once."""
        if now_ns > self._fingerprints_until_ns:
            self._fingerprints.clear()
        name = fingerprint(key, payload)
        if name not in self._fingerprints:
            return False
        self._fingerprints.remove(name)
        return True

    def on_gap(self, gap: Gap) -> None:
        """Count messages lost on the bus; lost samples are counted by their sequence numbers instead."""
        if keys.parse(f"{gap.stream}/x") is None or gap.stream.split("/")[2] != keys.SAMPLE:
            self._unrecovered += gap.messages

    def monotonic_ns(self, now_ns: int) -> int:
        """Time of receipt for messages that the recorder adds: not before any recorded message."""
        self._last_ns = max(self._last_ns, now_ns)
        return self._last_ns

    def count_unrecorded(self, count: int) -> None:
        """Count messages that were received but not recorded, because no file could be written."""
        self._refused["disk"] += count

    def reject_key(self, received: ReceivedMessage, now_ns: int) -> list[Publication]:
        """Count a message whose key has no channel in the file, and raise the alarm."""
        self._refused["too many keys"] += 1
        self._no_room_ns = now_ns
        key = received.channel.key[:200]  # publishers control it
        kind = "of this software" if received.channel.is_product else "of other programs"
        if self._logged_ns is None or now_ns - self._logged_ns >= MINUTE_NS:
            self._logged_ns = now_ns
            log.warning("not recorded: too many keys", example=key, keys=kind, messages=self._refused["too many keys"])
        if self.alarms.is_active(KEYS_ALARM):
            return []
        text = f"not everything is recorded: a file has no room for more keys {kind}, {key!r} for instance"
        return [self.alarms.raise_alarm(KEYS_ALARM, text, now_ns), self.health(now_ns)]

    def clear_keys_alarm(self, now_ns: int) -> list[Publication]:
        """Clear the alarm about keys once no message was rejected for a minute."""
        if not self.alarms.is_active(KEYS_ALARM) or now_ns - self._no_room_ns < MINUTE_NS:
            return []
        text = f"everything is recorded again; {self._refused['too many keys']} messages are missing so far"
        return [self.alarms.clear(KEYS_ALARM, text, now_ns)]

    def stop_recording(self, why: str, now_ns: int) -> list[Publication]:
        """Raise the alarm that no file can be written."""
        self.is_stopped = True
        text = f"recording stopped: {why}; it resumes when a file can be written"
        raised = [] if self.alarms.is_active(DISK_ALARM) else [self.alarms.raise_alarm(DISK_ALARM, text, now_ns)]
        return [*raised, self.health(now_ns)]

    def resume_recording(self, now_ns: int) -> list[Publication]:
        """Clear the alarm that no file can be written."""
        self.is_stopped = False
        text = f"recording resumed; {self._refused['disk']} messages are missing so far"
        return [self.alarms.clear(DISK_ALARM, text, now_ns), self.health(now_ns)]

    def health(self, now_ns: int, phase: str = "") -> Publication:
        """Health report; the lag is the longest from receipt to processing since the last call.

        Args:
            now_ns: clock reading.
            phase: phase to report; empty derives it from the state.
        """
        phase = phase or ("not recording" if self.is_stopped else "recording")
        checks = [self._evicted, *(counter for _, counter in self._counters.values())]
        self._reports += 1
        health = messages.Health(
            time_ns=now_ns,
            node=NODE,
            version=version(),
            phase=phase,
            uptime_s=(now_ns - self._start_ns) / 1e9,
            received=self._received,
            # a sequence number may be any nonsense, and the sum of what it skips must fit the field
            lost=min(sum(check.lost for check in checks) + self._unrecovered, 2**64 - 1),
            duplicated=sum(check.duplicated for check in checks),
            out_of_order=sum(check.out_of_order for check in checks),
            refused=self._refused.total(),
            refused_by_reason=self._refused,
            lag_ms=self._longest_lag_ns / 1e6,
            published=self._reports,
        )
        self._longest_lag_ns = 0
        return Publication(keys.key(self._plant, keys.HEALTH, NODE), health)


class OwnAlarms:
    """States of the recorder's alarms.

    Args:
        plant: plant that the alarms are published under.
    """

    def __init__(self, plant: str) -> None:
        self._plant = plant
        self._states = dict.fromkeys(PRIORITIES, State.NORMAL)
        self._now = {
            name: messages.Alarm(alarm=name, state=CODES[State.NORMAL], priority=priority)
            for name, priority in PRIORITIES.items()
        }

    @property
    def now(self) -> list[messages.Alarm]:
        """Alarms in their present state."""
        return list(self._now.values())

    def is_active(self, name: str) -> bool:
        """True from raised to cleared."""
        return self._states[name] in (State.UNACKNOWLEDGED, State.ACKNOWLEDGED)

    def raise_alarm(self, name: str, text: str, now_ns: int) -> Publication:
        """Raise an alarm that is not active."""
        return self._change(name, Event.RAISED, now_ns, raised_ns=now_ns, cleared_ns=0, text=text, by="", comment="")

    def clear(self, name: str, text: str, now_ns: int) -> Publication:
        """Clear an active alarm."""
        return self._change(name, Event.CLEARED, now_ns, cleared_ns=now_ns, text=text)

    def execute(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        """Execute a command: list the alarms or acknowledge one. A refusal is a reply with the reason."""
        try:
            _, command = decode_command(question, COMMANDS)
            if not isinstance(command, AlarmCommand):
                return CommandReply(accepted=True, text=f"{len(self._now)} alarms", alarms=self.now), []
            by, comment = check_signature(command.by, command.comment)
            change = self._change(command.alarm, Event.ACKNOWLEDGE, now_ns, by=by, comment=comment)
        except (InputError, DecodeError) as error:
            return CommandReply(accepted=False, text=str(error)), []
        text = f"alarm {command.alarm}: acknowledge"
        return CommandReply(accepted=True, text=text, alarms=[self._now[command.alarm]]), [change]

    def _change(self, name: str, event: Event, now_ns: int, **values: Any) -> Publication:
        if name not in self._now:
            raise InputError(f"no alarm {name!r} of the recorder (there are: {', '.join(self._now)})")
        try:
            state = self._states[name] = next_state(self._states[name], event, active=event is Event.RAISED)
        except InputError as error:
            raise InputError(f"alarm {name} {error}") from error
        alarm = self._now[name]
        for field, value in {"time_ns": now_ns, "event": event.value, "state": CODES[state], **values}.items():
            setattr(alarm, field, value)
        published = messages.Alarm()
        published.CopyFrom(alarm)
        return Publication(keys.key(self._plant, keys.ALARM, name), published)
