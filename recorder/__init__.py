"""The recorder: what travels on the bus into a file, and out of it again to the bus, to CSV and to pictures."""

from dataclasses import dataclass
from typing import NamedTuple

import msgspec


class RecordedMessage(NamedTuple):
    """A message as received from the bus.

    Attributes:
        key: key that it was published on; the topic in the file.
        payload: bytes of the message.
        encoding: encoding that the publisher claimed.
        log_time_ns: time of receipt.
        publish_time_ns: time of the sample; the time of receipt where the message has none.
        latched: True if it was received before the file was started and is repeated at its start, so that the file is
            self-contained. A reader of the file before skips it.
    """

    key: str
    payload: bytes
    encoding: str
    log_time_ns: int
    publish_time_ns: int
    latched: bool = False


@dataclass(slots=True, eq=False, weakref_slot=True)
class Channel:
    """Channel of a file, with the fields that its messages share. Equal by identity, which is looked up fastest.

    Attributes:
        key: key that its messages were published on.
        encoding: encoding that its messages claim.
        is_product: True for messages of the product on a key of the product.
        is_readable: True if its messages are what their encoding names.
        latched: see `RecordedMessage`.
    """

    key: str
    encoding: str
    is_product: bool = False
    is_readable: bool = True
    latched: bool = False


class StoredMessage(msgspec.Struct, gc=False):
    """A message of a file; a structure, because one is built for each message, and a tuple takes twice the time."""

    channel: Channel
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    payload: bytes

    @property
    def recorded_message(self) -> RecordedMessage:
        """The message as it was received from the bus."""
        channel = self.channel
        return RecordedMessage(
            channel.key, self.payload, channel.encoding, self.log_time_ns, self.publish_time_ns, channel.latched
        )
