"""How messages came to a monitor, by the clock of receipt."""

from typing import NamedTuple

HEARD_AGAIN_NS = 1_000_000
"""Samples nearer to each other are one sign of life: the signals of a row come together."""

STALL_NS = 1_000_000_000
"""What is due is done within a millisecond; who is so late was frozen, or his clock was set."""


class Receipt(NamedTuple):
    """How messages came, by the clock of receipt.

    Attributes:
        start_ns: when the monitor was started.
        heard_ns: of the newest sign of life that counted, see `HEARD_AGAIN_NS`.
        received_ns: likewise, as the silence of the plant knows it; None: nothing has come.
        counted_ns: of these, the one that the next spacing is counted from; None: what comes next is the first.
        lag_ns: the longest that a message has waited since health was told.
        health_due_ns: when it is told next.
        ticked: whether the clock was looked at before.
        stalls: how often that was more than a second late.
        not_stored: how often what is remembered could not be stored.
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
