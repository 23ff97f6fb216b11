"""What a recording holds, one message at a time."""

from typing import NamedTuple


class Entry(NamedTuple):
    """A message as it came from the bus.

    Attributes:
        key: the key it was published on; the topic in the file.
        payload: its bytes.
        encoding: what the bytes claim to be, as on the bus.
        log_time_ns: when it was received.
        publish_time_ns: the time of the sample that it speaks of; that of receipt where it says none.
        repeated: it was received before the file was begun, and is said again at the start of the file so that the
            file opens by itself. Who reads the file before passes over it.
    """

    key: str
    payload: bytes
    encoding: str
    log_time_ns: int
    publish_time_ns: int
    repeated: bool = False
