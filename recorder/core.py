"""What the recorder makes of the messages it receives. Pure: no file, no bus, no clock.

Everything is kept, also what cannot be read: a recording is for finding out what went wrong. What cannot be read is
kept without a schema, so that it spoils no reader's day, and is counted as refused.
"""

from collections import Counter
from collections.abc import Collection
from functools import lru_cache
from typing import Any, NamedTuple

import structlog
from google.protobuf.message import Message

from reactorwatch import __version__
from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode
from reactorwatch.contract.messages_pb2 import CommandReply
from reactorwatch.runtime.delivery.reorder_buffer import Gap
from recorder.columns.sequences import SequenceCheck
from recorder.message import Entry
from recorder.policy.own_alarms import DISK_ALARM, KEYS_ALARM, OwnAlarms
from recorder.policy.room import Channel

log = structlog.get_logger()

NODE = "recorder"
MOST_CHECKS = 60_000
"""Keys of samples whose numbers are followed; of more, that key is forgotten whose last sample is the oldest."""
NO_ROOM_NS = 60_000_000_000
"""The alarm about keys clears when, for so long, nothing was left out."""
LOG_AGAIN_NS = 60_000_000_000
LONGEST_QUOTE = 200
"""Letters of a key in a text: publishers choose them."""

_NO_SAMPLE = messages.QUALITY_UNSPECIFIED  # which protobuf reads out of bytes that hold something else
_LARGEST_COUNT = 2**64 - 1  # a sequence number may be any nonsense; the sum of what it skips must still fit its field


class Kept(NamedTuple):
    """An entry for the file, and the message that it holds; None if it is not the one that its encoding names.

    Attributes:
        entry: the entry.
        message: the message.
        has_known_key: whether the key is a key of the product.
    """

    entry: Entry
    message: Message | None
    has_known_key: bool = True

    @property
    def readable(self) -> bool:
        """Whether it is."""
        return self.message is not None

    @property
    def channel(self) -> Channel:
        """The channel in the file that it needs."""
        return Channel(self.entry.key, self.entry.encoding, self.readable and self.has_known_key)


def fingerprint(key: str, payload: bytes) -> int:
    """What a message is known by, within this process."""
    return hash((key, payload))


@lru_cache(maxsize=MOST_CHECKS)
def is_key(key: str) -> bool:
    """True for a key of the product."""
    return keys.parse(key) is not None


class Recorder:
    """Turns messages into entries and counts what it sees.

    Args:
        plant: the plant that health is reported under.
        start_ns: the clock reading at which it begins.
        known: fingerprints of what the files before hold, and the bus may tell once more.
        known_until_ns: when they are forgotten.
    """

    def __init__(self, plant: str, start_ns: int, known: Collection[int] = (), known_until_ns: int = 0) -> None:
        self._known = set(known)
        self._known_until_ns = known_until_ns
        self._unrecovered = 0
        self._plant = plant
        self._start_ns = start_ns
        self._last_ns = start_ns
        self._received = 0
        self._reports = 0
        self._longest_lag_ns = 0
        self._refused: Counter[str] = Counter()
        self._stopped = False
        self._alarms = OwnAlarms(plant)
        self._checks: dict[str, SequenceCheck] = {}  # by key, in the order of their last samples
        self._forgotten = SequenceCheck()  # the counts of keys that are followed no longer
        self._no_room_ns = 0  # when a message was left out last
        self._logged_ns: int | None = None  # when the log said so last

    def on_message(self, message: Encoded, now_ns: int) -> Kept | None:
        """The entry for a message; None if it is in a file already.

        The time of receipt never runs backwards, though a clock that is set may: the order in the file is the order
        in which things came.
        """
        key, payload, encoding, received_ns = message
        self._received += 1
        if self._known and self._is_known(key, payload, now_ns):
            return None
        received_ns = received_ns or now_ns
        self._longest_lag_ns = max(self._longest_lag_ns, now_ns - received_ns)
        self._last_ns = received_ns = max(received_ns, self._last_ns)
        has_known_key = is_key(key)
        try:
            decoded: Any = decode(payload, encoding)
        except DecodeError as error:
            self._refused[error.reason] += 1
            return Kept(Entry(key, payload, encoding, received_ns, received_ns), None, has_known_key)
        if not has_known_key:
            self._refused["key"] += 1
        time_ns = getattr(decoded, "time_ns", received_ns)
        if time_ns < 0:  # before 1970, which a file has no way to say
            self._refused["time"] += 1
            time_ns = received_ns
        elif isinstance(decoded, messages.Sample):
            if decoded.quality == _NO_SAMPLE:
                self._refused["payload"] += 1
            elif has_known_key:
                self._check(key).update(decoded.sequence, time_ns)
        return Kept(Entry(key, payload, encoding, received_ns, time_ns), decoded, has_known_key)

    def _check(self, key: str) -> SequenceCheck:
        """The count of a key's samples."""
        check = self._checks.pop(key, None)
        if check is None:
            check = SequenceCheck()
            if len(self._checks) >= MOST_CHECKS:
                forgotten = self._checks.pop(next(iter(self._checks)))
                self._forgotten.lost += forgotten.lost
                self._forgotten.duplicated += forgotten.duplicated
                self._forgotten.out_of_order += forgotten.out_of_order
        self._checks[key] = check
        return check

    def _is_known(self, key: str, payload: bytes, now_ns: int) -> bool:
        """Whether it is in a file already; it is passed over once."""
        if now_ns > self._known_until_ns:
            self._known.clear()
        name = fingerprint(key, payload)
        if name not in self._known:
            return False
        self._known.remove(name)
        return True

    def on_gap(self, gap: Gap) -> None:
        """Count what was lost on the way. Samples count themselves, by the numbers that they carry."""
        if keys.parse(f"{gap.stream}/x") is None or gap.stream.split("/")[2] != keys.SAMPLE:
            self._unrecovered += gap.messages

    def moment(self, now_ns: int) -> int:
        """A time of receipt for what the recorder itself adds: nothing that comes later is recorded before it."""
        self._last_ns = max(self._last_ns, now_ns)
        return self._last_ns

    def unrecorded(self, count: int) -> None:
        """So many messages were received and are not in a file, because it could not be written."""
        self._refused["disk"] += count

    def leave_out(self, kept: Kept, now_ns: int) -> list[Publication]:
        """Count a message for whose key the file has no room, and raise the alarm."""
        self._refused["too many keys"] += 1
        self._no_room_ns = now_ns
        key = kept.entry.key[:LONGEST_QUOTE]
        kind = "of this software" if kept.channel.is_of_product else "of other programs"
        if self._logged_ns is None or now_ns - self._logged_ns >= LOG_AGAIN_NS:
            self._logged_ns = now_ns
            log.warning("not recorded: too many keys", example=key, keys=kind, messages=self._refused["too many keys"])
        if self._alarms.is_active(KEYS_ALARM):
            return []
        text = f"not everything is recorded: a file has no room for more keys {kind}, {key!r} for instance"
        return [self._alarms.raise_alarm(KEYS_ALARM, text, now_ns), self.health(now_ns)]

    def see_to_room(self, now_ns: int) -> list[Publication]:
        """Clear the alarm about keys, if it is due."""
        if not self._alarms.is_active(KEYS_ALARM) or now_ns - self._no_room_ns < NO_ROOM_NS:
            return []
        text = f"everything is recorded again; {self._refused['too many keys']} messages are missing so far"
        return [self._alarms.clear(KEYS_ALARM, text, now_ns)]

    def stop_recording(self, why: str, now_ns: int) -> list[Publication]:
        """The file cannot be written: raise the alarm."""
        self._stopped = True
        text = f"recording stopped: {why}; it goes on when a file can be written"
        return [self._alarms.raise_alarm(DISK_ALARM, text, now_ns), self.health(now_ns)]

    def resume_recording(self, now_ns: int) -> list[Publication]:
        """There is a file again: clear the alarm."""
        self._stopped = False
        text = f"recording goes on; {self._refused['disk']} messages are missing so far"
        return [self._alarms.clear(DISK_ALARM, text, now_ns), self.health(now_ns)]

    @property
    def is_stopped(self) -> bool:
        """Whether what is received cannot be written."""
        return self._stopped

    @property
    def alarms(self) -> list[messages.Alarm]:
        """Its alarms in their present state."""
        return self._alarms.now

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        """Carry out a command about its alarms."""
        return self._alarms.obey(question, now_ns)

    def health(self, now_ns: int, phase: str = "") -> Publication:
        """How it does; the lag is the longest between receipt and work since the last call.

        Args:
            now_ns: the moment.
            phase: in a word; empty: by whether it can write.
        """
        phase = phase or ("not recording" if self._stopped else "recording")
        checks = [self._forgotten, *self._checks.values()]
        self._reports += 1
        health = messages.Health(
            time_ns=now_ns,
            node=NODE,
            version=__version__,
            phase=phase,
            uptime_s=(now_ns - self._start_ns) / 1e9,
            received=self._received,
            lost=min(sum(check.lost for check in checks) + self._unrecovered, _LARGEST_COUNT),
            duplicated=sum(check.duplicated for check in checks),
            out_of_order=sum(check.out_of_order for check in checks),
            refused=self._refused.total(),
            refused_by_reason=self._refused,
            lag_ms=self._longest_lag_ns / 1e6,
            published=self._reports,
        )
        self._longest_lag_ns = 0
        return Publication(keys.key(self._plant, keys.HEALTH, NODE), health)
