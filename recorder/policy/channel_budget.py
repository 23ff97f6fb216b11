"""Number of channels in a recording, shared between keys. Pure.

MCAP numbers the channels of a file with 16 bits, and the index grows with each channel. So the number of keys in a file
is bounded. Keys with messages of the product have nearly all channels. Other keys and encodings have a small share of
their own, so that they take no channel from the product. The next file starts with all channels free: where a file is
full and part of its keys are inactive, the next file is started early.
"""

from collections.abc import Collection
from typing import NamedTuple

MAX_CHANNELS = 65_535
"""Channels in a file: https://mcap.dev/spec#channel-op0x04"""
MAX_OTHER_CHANNELS = 4000
"""Channels in a file for messages that are not of the product."""
MAX_KEYS = 60_000
"""Keys of the product in a file, latched messages included; some channels of the format stay free."""
LATCHED_SHARE = 0.5
"""Largest share of a file's keys that latched messages take."""
INACTIVE_NS = 60_000_000_000
INACTIVE_SHARE = 0.1
"""Share of keys without a message for `INACTIVE_NS` from which on a full file is followed by the next one."""
CHECK_INTERVAL_NS = 5_000_000_000


class Channel(NamedTuple):
    """Channel of a file.

    Attributes:
        key: key that its messages were published on.
        encoding: encoding that its messages claim.
        is_product: True for messages of the product on a key of the product.
    """

    key: str
    encoding: str
    is_product: bool


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

    @property
    def max_latched_messages(self) -> int:
        """Largest number of latched messages at the start of a file."""
        return int(LATCHED_SHARE * self._most_keys)

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
        if channel not in self._received_ns and self._is_full and channel.key not in self._reserved:
            return False
        self._received_ns[channel] = now_ns
        return True

    def has(self, channel: Channel) -> bool:
        """True if the channel is in the file."""
        return channel in self._received_ns or channel in self._others

    def needs_new_file(self, channel: Channel, now_ns: int) -> bool:
        """True if this file has no free channel and the next one would."""
        if not channel.is_product or channel in self._received_ns or not self._is_full:
            return False
        if 0 <= self._next_check_ns - now_ns <= CHECK_INTERVAL_NS:
            return False
        self._next_check_ns = now_ns + CHECK_INTERVAL_NS
        inactive = sum(now_ns - received_ns >= INACTIVE_NS for received_ns in self._received_ns.values())
        return inactive >= INACTIVE_SHARE * self._most_keys

    @property
    def _is_full(self) -> bool:
        return len(self._received_ns) + self._latched >= self._most_keys
