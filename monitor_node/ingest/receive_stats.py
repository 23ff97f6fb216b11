"""Statistics of a monitor's messages by receive time."""

from typing import NamedTuple

HEARD_AGAIN_NS = 1_000_000
"""Samples closer together than this count as one: the signals of a row arrive together."""

STALL_NS = 1_000_000_000
"""Due work is done within a millisecond; a monitor this late was stalled, or its clock was set."""


class ReceiveStats(NamedTuple):
    """Statistics by receive time. A restart resets them.

    Attributes:
        start_ns: start of the monitor.
        heard_ns: receive time of the newest sample that counted, see `HEARD_AGAIN_NS`.
        received_ns: receive time of the newest sample for the plant's `DataTimeout`; None before the first.
        counted_ns: receive time from which the next spacing is counted; None before the first.
        lag_ns: longest delay of a message since the last health message.
        health_due_ns: time of the next health message.
        ticked: True if there was a tick before.
        stalls: number of ticks that were more than a second late.
        not_stored: number of failures to store the state.
    """

    start_ns: int
    heard_ns: int
    received_ns: int | None
    counted_ns: int | None
    lag_ns: int
    health_due_ns: int
    ticked: bool
    stalls: int
    not_stored: int
