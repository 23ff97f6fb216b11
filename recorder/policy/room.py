"""Room for keys in a recording. Pure.

A file of the format numbers its channels with 16 bits, and its index grows with each of them. So a file has room for a
bounded number of keys. Keys with messages of the product have nearly all of it; any other key or encoding has a small
part of its own, so that it takes room from none of them. Room that a key took is free again in the next file: where a
file is full, and a part of its keys has fallen silent, the next file is started early.
"""

from collections.abc import Collection
from typing import NamedTuple

MOST_CHANNELS = 65_535
"""Of a file: https://mcap.dev/spec#channel-op0x04"""
MOST_OTHERS = 4000
"""Keys of a file whose messages are not of the product, each encoding counted by itself."""
MOST_KEYS = 60_000
"""Keys of a file, those of repeated messages included; some channels of the format stay free."""
REPEATED_SHARE = 0.5
"""Of the keys of a file: what messages repeated at its start may take."""
SILENT_NS = 60_000_000_000
SILENT_SHARE = 0.1
"""Of its keys: where so many have been silent for so long, a full file is followed by the next one."""
LOOK_AGAIN_NS = 5_000_000_000


class Channel(NamedTuple):
    """A name under which messages stand in a file.

    Attributes:
        key: the key that they were published on.
        encoding: the encoding that they claim.
        is_of_product: whether they are messages of the product, on a key of the product.
    """

    key: str
    encoding: str
    is_of_product: bool


class Room:
    """The channels of the file that is being written.

    Args:
        most_keys: room in a file for keys with messages of the product.
        reserved: keys that always have room, such as those of the recorder's own alarms.
    """

    def __init__(self, most_keys: int, reserved: Collection[str] = ()) -> None:
        self._most_keys = most_keys
        self._reserved = frozenset(reserved)
        self._repeated = 0
        self._received_ns: dict[Channel, int] = {}  # when a message came last
        self._others: set[Channel] = set()
        self._look_at_ns = 0

    @property
    def most_repeated(self) -> int:
        """Messages that may be repeated at the start of a file."""
        return int(REPEATED_SHARE * self._most_keys)

    def start(self, repeated: int) -> None:
        """Start a file.

        Args:
            repeated: messages that are repeated at its start, each of which takes the room of a key.
        """
        self._repeated = repeated
        self._received_ns.clear()
        self._others.clear()

    def admit(self, channel: Channel, now_ns: int) -> bool:
        """Give a message its room in the file; False if there is none."""
        if not channel.is_of_product:
            if channel not in self._others and len(self._others) >= MOST_OTHERS:
                return False
            self._others.add(channel)
            return True
        if channel not in self._received_ns and self._is_full and channel.key not in self._reserved:
            return False
        self._received_ns[channel] = now_ns
        return True

    def has(self, channel: Channel) -> bool:
        """True if messages of a channel have room in the file."""
        return channel in self._received_ns or channel in self._others

    def needs_new_file(self, channel: Channel, now_ns: int) -> bool:
        """True if a message has no room in this file, and would have room in the next one."""
        if not channel.is_of_product or channel in self._received_ns or not self._is_full:
            return False
        if 0 <= self._look_at_ns - now_ns <= LOOK_AGAIN_NS:
            return False
        self._look_at_ns = now_ns + LOOK_AGAIN_NS
        silent = sum(now_ns - received_ns >= SILENT_NS for received_ns in self._received_ns.values())
        return silent >= SILENT_SHARE * self._most_keys

    @property
    def _is_full(self) -> bool:
        return len(self._received_ns) + self._repeated >= self._most_keys
