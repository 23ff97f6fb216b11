"""Statistics of a monitor's messages by receive time."""

from dataclasses import dataclass

HEARD_AGAIN_NS = 1_000_000
"""Samples closer together than this count as one: the signals of a row arrive together."""

STALL_NS = 1_000_000_000
"""Due work is done within a millisecond; a monitor this late was stalled, or its clock was set."""


@dataclass(slots=True)
class ReceiveStats:
    """Statistics by receive time. A restart resets them.

    Attributes:
        start_ns: start of the monitor.
        health_due_ns: time of the next health message.
        heard_ns: receive time of the newest sample that counted, see `HEARD_AGAIN_NS`.
        lag_ns: longest delay of a message since the last health message.
        ticked: True if there was a tick before.
        stalls: number of ticks that were more than a second late.
        not_stored: number of failures to store the state, counted by the storage.
    """

    start_ns: int
    health_due_ns: int
    heard_ns: int = 0
    lag_ns: int = 0
    ticked: bool = False
    stalls: int = 0
    not_stored: int = 0
