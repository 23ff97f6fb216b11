"""The recorder: what travels on the bus into a file, and out of it again to the bus, to CSV and to pictures."""

from typing import NamedTuple


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
