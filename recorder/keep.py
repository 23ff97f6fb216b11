"""Rules for the files of a recorder, without I/O: names, flushes, rotation, deletion, the black box, room for keys.

In a folder, each file is named after the plant and its start time: `cstr-20260701T100005Z.mcap`. With a file name
given, the first file has that name and the others are numbered: `run.mcap`, `run-2.mcap`.

A recorder that is killed loses what it had not handed to the operating system, so it flushes twice a second. A machine
that loses its power loses what was not synced. The sync period trades safety against disk load.

Retention selects the oldest recordings for deletion until the others are within limits. Its times are confirmed times
(see `Ages`): setting a clock deletes nothing. The black box keeps an interval around each alarm, in times of receipt.
An alarm that is raised before the current interval ends extends it, because both belong to one event. An interval has a
largest length; the next alarm after it starts a new one.

MCAP numbers the channels of a file with 16 bits, and the index grows with each channel. So the number of keys in a file
is bounded. Keys with messages of the product have nearly all channels. Other keys and encodings have a small share of
their own, so that they take no channel from the product. The next file starts with all channels free: where a file is
full and part of its keys are inactive, the next file is started early.

Models, alarms, incidents, baselines, promises and faults are published when they change. A file in which none changes
would not contain them. So the last message of each is repeated at the start of a file, marked as
`RecordedMessage.latched`, with the time of its sample and with the start time of the file as its time of receipt.
"""

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from math import inf
from pathlib import Path
from typing import Literal, NamedTuple
from weakref import WeakValueDictionary

from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.records.record import MINUTE_NS, NEVER_NS
from recorder import Channel, RecordedMessage

SECOND_NS = 1_000_000_000

ENDING = ".mcap"
_MOMENT = "%Y%m%dT%H%M%SZ"
_MOMENT_PATTERN = r"-\d{8}T\d{6}Z"


@dataclass(frozen=True)
class FileNames:
    """Naming scheme of the files of one recorder.

    Attributes:
        folder: folder of the files.
        stem: start of each name.
        dated: True if the start time follows the stem.
    """

    folder: Path
    stem: str
    dated: bool

    @classmethod
    def of(cls, out: Path, plant: str, *, is_folder: bool) -> "FileNames":
        """Naming scheme of the setting `out`: a file, by its ending, or a folder.

        Args:
            out: the setting.
            plant: name of the plant, for files in a folder.
            is_folder: True if a folder of that name exists.
        """
        if out.suffix == ENDING and not is_folder:
            return cls(out.parent, out.stem, dated=False)
        return cls(out, plant, dated=True)

    def next(self, now_ns: int, existing: Iterable[str] = ()) -> Path:
        """Name of the next file, with a number above all that exist, so that no name of a deleted file is reused.

        Args:
            now_ns: start time of the file.
            existing: names of files in the folder.
        """
        started = datetime.fromtimestamp(now_ns // SECOND_NS, UTC)
        stem = f"{self.stem}-{started:{_MOMENT}}" if self.dated else self.stem
        pattern = re.compile(rf"{re.escape(stem)}(?:-([1-9]\d*))?{re.escape(ENDING)}")
        matches = map(pattern.fullmatch, existing)
        last = max((int(match[1] or 1) for match in matches if match), default=0)
        return self.folder / (f"{stem}-{last + 1}{ENDING}" if last else f"{stem}{ENDING}")

    def owns(self, name: str) -> bool:
        """True if the scheme gives this name."""
        moment = _MOMENT_PATTERN if self.dated else ""
        return re.fullmatch(rf"{re.escape(self.stem)}{moment}(-[1-9]\d*)?{re.escape(ENDING)}", name) is not None


Fsync = Literal["never", "chunk", "second"]


class FlushAndRotation:
    """Schedule of one recording.

    A clock that is set back would delay everything by as much, so all stored times are moved back with it.

    Args:
        flush_ns: time between two flushes while there is something to flush.
        fsync: sync never, after each flush, or once a second.
        rotate_ns: age of a file at which a new one is started; inf never starts one.
        rotate_bytes: size of a file at which a new one is started; inf never starts one.
        now_ns: start time of the first file.
    """

    def __init__(self, flush_ns: int, fsync: Fsync, rotate_ns: float, rotate_bytes: float, now_ns: int) -> None:
        self._flush_ns, self._fsync = flush_ns, fsync
        self._rotate_ns, self._rotate_bytes = rotate_ns, rotate_bytes
        self._now_ns = now_ns
        self.start_file(now_ns)

    def start_file(self, now_ns: int) -> None:
        """Restart all times for a new file."""
        self._start_ns = self._synced_ns = self._oldest_ns = now_ns
        self._is_empty = True
        self.unflushed = 0  # messages that a kill would lose now
        self._unsynced = False

    def count_message(self, now_ns: int) -> None:
        """Count a message that was written."""
        if not self.unflushed:
            self._oldest_ns = now_ns
        self.unflushed += 1
        self._is_empty = False

    def mark_flushed(self) -> None:
        """Note that everything written was flushed."""
        self._unsynced = self._unsynced or bool(self.unflushed)
        self.unflushed = 0

    def mark_synced(self, now_ns: int) -> None:
        """Note that everything flushed is on the disk."""
        self._unsynced = False
        self._synced_ns = now_ns

    def flush_is_due(self, now_ns: int) -> bool:
        """True if the oldest unflushed message has waited for the flush period."""
        self._follow_clock(now_ns)
        return bool(self.unflushed) and now_ns - self._oldest_ns >= self._flush_ns

    def sync_is_due(self, now_ns: int) -> bool:
        """True if something was flushed and the policy asks for a sync now."""
        if not self._unsynced or self._fsync == "never":
            return False
        self._follow_clock(now_ns)
        return self._fsync == "chunk" or now_ns - self._synced_ns >= SECOND_NS

    def is_full(self, now_ns: int, size_bytes: int) -> bool:
        """True if the next message belongs into a new file; a file without messages is never full."""
        self._follow_clock(now_ns)
        if self._is_empty:
            return False
        return now_ns - self._start_ns >= self._rotate_ns or size_bytes >= self._rotate_bytes

    def next_due_ns(self) -> int:
        """Time of the next flush or sync if no message arrives until then."""
        if self.unflushed:
            return self._oldest_ns + self._flush_ns
        if self._unsynced and self._fsync != "never":
            return self._synced_ns + SECOND_NS
        return NEVER_NS

    def _follow_clock(self, now_ns: int) -> None:
        back_ns = self._now_ns - now_ns
        if back_ns > 0:
            self._start_ns -= back_ns
            self._oldest_ns -= back_ns
            self._synced_ns -= back_ns
        self._now_ns = now_ns


DAY_NS = 24 * 60 * MINUTE_NS


class CompleteRecording(NamedTuple):
    """Complete recording on disk.

    Attributes:
        path: the file.
        size_bytes: size of the file.
        ended_ns: confirmed time at which it was first seen complete.
        modified_ns: modification time of the file, which orders files with equal `ended_ns`.
    """

    path: Path
    size_bytes: int
    ended_ns: int
    modified_ns: int = 0


@dataclass(frozen=True)
class Limits:
    """Limits on recordings, the one being written included; inf is no limit.

    Attributes:
        size_bytes: total size.
        age_ns: time since the end of a recording.
        files: number of files.
    """

    size_bytes: float = inf
    age_ns: float = inf
    files: float = inf


def select_deletions(
    complete: Iterable[CompleteRecording],
    writing_bytes: int | None,
    limits: Limits,
    now_ns: int,
    protected_since_ns: int | None = None,
) -> list[Path]:
    """Select the recordings to delete, oldest first.

    The newest recording is never deleted for its size: the one being written or, between two of them, the last one.

    Args:
        complete: complete recordings, without the one that is being written.
        writing_bytes: size of the recording that is being written; None if there is none.
        limits: the limits.
        now_ns: confirmed time.
        protected_since_ns: recordings that ended since then stay regardless of the limits; None protects none.
    """
    by_age = sorted(complete, key=lambda item: (item.ended_ns, item.modified_ns, item.path))
    count, size = len(by_age), sum(item.size_bytes for item in by_age)
    if writing_bytes is not None:
        count, size = count + 1, size + writing_bytes
    deletions: list[Path] = []
    for item in by_age:
        is_newest = writing_bytes is None and len(deletions) == len(by_age) - 1
        fits = size <= limits.size_bytes or is_newest
        within = fits and count <= limits.files and now_ns - item.ended_ns <= limits.age_ns
        if within or (protected_since_ns is not None and item.ended_ns >= protected_since_ns):
            break
        deletions.append(item.path)
        count, size = count - 1, size - item.size_bytes
    return deletions


MAX_MARGINS = 10
"""Largest time from the first alarm to the end of an interval, in margins: alarms may come without an end."""
RAISED = "raised"
"""Event of an alarm that is raised."""


@dataclass(frozen=True)
class AlarmInterval:
    """Time interval around one or several alarms.

    Attributes:
        from_ns: start of the interval.
        to_ns: end of the interval.
        raised_ns: time of receipt of the first alarm.
        alarm: name of the first alarm.
    """

    from_ns: int
    to_ns: int
    raised_ns: int
    alarm: str


class BlackBox:
    """Derives the intervals to keep from a plant's alarms.

    Args:
        margin_ns: time kept before and after an alarm; 0 keeps nothing.
        own: names of the recorder's own alarms, which start no interval.
    """

    def __init__(self, margin_ns: int, own: Collection[str] = ()) -> None:
        self._margin_ns = margin_ns
        self._own = own
        self._open: AlarmInterval | None = None

    def on_message(self, message: Message, received_ns: int) -> AlarmInterval | None:
        """Process a message.

        Returns:
            The interval that ended before this alarm started a new one; usually None.
        """
        if not self._margin_ns or not isinstance(message, messages.Alarm):
            return None
        if message.event != RAISED or message.alarm in self._own:
            return None
        ended = self.pop_ended(received_ns)
        end_ns = received_ns + self._margin_ns
        if self._open is None:
            self._open = AlarmInterval(received_ns - self._margin_ns, end_ns, received_ns, message.alarm)
        else:
            end_ns = min(end_ns, self._open.raised_ns + MAX_MARGINS * self._margin_ns)
            self._open = replace(self._open, to_ns=max(self._open.to_ns, end_ns))
        return ended

    def pop_ended(self, now_ns: int) -> AlarmInterval | None:
        """Return the interval that has ended, once; None if there is none."""
        if self._open is None or now_ns <= self._open.to_ns:
            return None
        return self.close()

    def close(self) -> AlarmInterval | None:
        """End the current interval now and return it; None if there is none."""
        ended, self._open = self._open, None
        return ended

    def protected_ns(self, now_ns: int) -> int | None:
        """Length of the most recent time of which nothing may be deleted, as an alarm needs it; None if all may be."""
        if not self._margin_ns:
            return None
        return max(self._margin_ns, now_ns - self._open.from_ns if self._open is not None else 0)

    @property
    def longest_ns(self) -> int:
        """Largest length of an interval: older alarms cannot belong to the current one."""
        return (MAX_MARGINS + 1) * self._margin_ns

    @property
    def next_due_ns(self) -> int | None:
        """Time at which the current interval ends if no other alarm is raised."""
        return self._open.to_ns + 1 if self._open is not None else None


MAX_CHANNELS = 65_535
"""Channels in a file: https://mcap.dev/spec#channel-op0x04"""
MAX_OTHER_CHANNELS = 4000
"""Channels in a file for messages that are not of the product, out of those that `MAX_KEYS` leaves."""
MAX_KEYS = 60_000
"""Keys of the product in a file, latched messages included; some channels of the format stay free."""


_CHANNELS: WeakValueDictionary[tuple[str, str, bool, bool], Channel] = WeakValueDictionary()


def channel_of(key: str, encoding: str, *, is_readable: bool, latched: bool = False) -> Channel:
    """Channel of the messages of a key and an encoding: one object as long as it is in use."""
    name = key, encoding, is_readable, latched
    channel = _CHANNELS.get(name)
    if channel is None:
        is_product = is_readable and keys.parse(key) is not None
        # two threads may ask at once
        channel = _CHANNELS.setdefault(name, Channel(key, encoding, is_product, is_readable, latched))
    return channel


class ChannelBudget:
    """Channels of the file that is being written.

    Args:
        most_keys: number of keys with messages of the product that a file may have.
        reserved: keys that are always admitted, such as those of the recorder's own alarms.
    """

    def __init__(self, most_keys: int, reserved: Collection[str] = ()) -> None:
        self._most_keys = most_keys
        self._reserved = frozenset(reserved)
        self._latched = 0
        self._received_ns: dict[Channel, int] = {}  # time of the last message
        self._others: set[Channel] = set()
        self._next_check_ns = 0

    def reset(self, latched: int) -> None:
        """Start a file with a number of latched messages, each of which takes the place of a key."""
        self._latched = latched
        self._received_ns.clear()
        self._others.clear()

    def admit(self, channel: Channel, now_ns: int) -> bool:
        """Reserve a channel in the file; False if none is free."""
        if not channel.is_product:
            if channel not in self._others and len(self._others) >= MAX_OTHER_CHANNELS:
                return False
            self._others.add(channel)
            return True
        received_ns = self._received_ns
        is_new = channel not in received_ns and channel.key not in self._reserved
        if is_new and len(received_ns) + self._latched >= self._most_keys:
            return False
        received_ns[channel] = now_ns
        return True

    def has(self, channel: Channel) -> bool:
        """True if the channel is in the file."""
        return channel in self._received_ns or channel in self._others

    def needs_new_file(self, channel: Channel, now_ns: int) -> bool:
        """True if the next file would have room for a channel that was not admitted to this file.

        That is so if a tenth of the keys had no message for a minute, which is checked every 5 s at most: it takes a
        pass over all keys.
        """
        if not channel.is_product or 0 <= self._next_check_ns - now_ns <= 5 * SECOND_NS:
            return False
        self._next_check_ns = now_ns + 5 * SECOND_NS
        inactive = sum(now_ns - received_ns >= MINUTE_NS for received_ns in self._received_ns.values())
        return 10 * inactive >= self._most_keys


LATCHED_KINDS: Mapping[str, type[Message]] = {
    keys.MODEL: messages.ModelSnapshot,
    keys.ALARM: messages.Alarm,
    keys.INCIDENT: messages.Incident,
    keys.BASELINE: messages.Baseline,
    keys.PROMISE: messages.Promise,
    keys.FAULT: messages.Fault,
}
"""Kinds of messages that are latched, with their types."""
STATES = frozenset(LATCHED_KINDS.values())
"""Types of latched messages."""


class LatchedMessages:
    """Last message of each model, alarm, incident until its alarms are normal, baseline, promise and fault.

    Args:
        capacity: largest number of messages, at most half of the keys of a file; beyond it the oldest is dropped.
    """

    def __init__(self, capacity: int = MAX_KEYS // 2) -> None:
        self._capacity = capacity
        self._last: dict[tuple[str, tuple[str, bool, bool]], RecordedMessage] = {}

    def update(self, recorded: RecordedMessage, message: Message) -> None:
        """Process a recorded message and its decoded content."""
        if isinstance(message, messages.ModelSnapshot):
            # models that share a key: the adaptive one, the one held since the training, the reference
            name = (recorded.key, (message.structure, message.reference, message.held))
        elif type(message) in STATES:
            name = (recorded.key, ("", False, False))
        else:
            return
        self._last.pop(name, None)
        if isinstance(message, messages.Incident) and message.state == messages.ALARM_STATE_NORMAL:
            return  # over and acknowledged; each is a key of its own, and a plant goes on for years
        self._last[name] = recorded
        if len(self._last) > self._capacity:
            del self._last[next(iter(self._last))]

    def messages(self, start_ns: int) -> list[RecordedMessage]:
        """Messages to repeat in a file that starts at `start_ns`, in the order of receipt."""
        return [item._replace(log_time_ns=start_ns, latched=True) for item in self._last.values()]
