"""Limit of the rate at which a node takes commands, so that a flood of them delays no alarm.

A command that changes something is written to the disk before it is answered, which takes milliseconds. Names in
commands are what their senders say, so all names together are limited, too; questions, which carry no name, apart from
them.
"""

from collections import OrderedDict
from typing import NamedTuple

from reactorwatch.contract.codec import DecodeError, Encoded, decode
from reactorwatch.contract.commands import LONGEST_NAME

MOST_NAMES = 1000
"""Names that are remembered; the one that has not been seen for longest goes first."""


class Rate(NamedTuple):
    """A token bucket.

    Attributes:
        at_once: commands after a pause.
        per_s: commands a second from then on.
    """

    at_once: float
    per_s: float


ONE_NAME = Rate(30.0, 5.0)
ALL = Rate(100.0, 20.0)
"""Of all names together; and of questions without a name."""


class CommandRate:
    """Counts commands by their sender's name.

    >>> rate = CommandRate()
    >>> [rate.refusal("Anna", now_ns=0) for _ in range(30)] == [None] * 30
    True
    >>> rate.refusal("Anna", now_ns=0)
    "too many commands by 'Anna': 30 at once and 5 a second are taken; try again in a second"
    >>> rate.refusal("Anna", now_ns=1_000_000_000) is None
    True
    """

    def __init__(self) -> None:
        self._names: OrderedDict[str, tuple[float, int]] = OrderedDict()  # what is left of a bucket, and when
        self._all = {True: (ALL.at_once, 0), False: (ALL.at_once, 0)}  # with a name, without

    def refusal(self, name: str, now_ns: int) -> str | None:
        """Count a command; returns why it is refused, None if it is to be obeyed.

        Args:
            name: of the sender, as the command has it; empty: a question without one.
            now_ns: the time.
        """
        left_all = _level(self._all[bool(name)], ALL, now_ns)
        left = _level(self._names.pop(name, (ONE_NAME.at_once, now_ns)), ONE_NAME, now_ns) if name else left_all
        refused = left < 1.0 or left_all < 1.0
        spent = 0.0 if refused else 1.0
        self._all[bool(name)] = left_all - spent, now_ns
        if name:
            self._names[name] = left - spent, now_ns
            if len(self._names) > MOST_NAMES:
                self._names.popitem(last=False)
        if not refused:
            return None
        rate, who = (ONE_NAME, f" by {name!r}") if name and left < 1.0 else (ALL, "")
        return (
            f"too many commands{who}: {rate.at_once:g} at once and {rate.per_s:g} a second are taken; "
            f"try again in a second"
        )


def sender_of(question: Encoded) -> str:
    """The name that a command carries; empty if it carries none, or cannot be read."""
    try:
        command = decode(question.payload, question.encoding)
    except DecodeError:
        return ""
    return str(getattr(command, "by", "")).strip()[:LONGEST_NAME]


def _level(bucket: tuple[float, int], rate: Rate, now_ns: int) -> float:
    """Commands that a bucket holds now; a clock that was set back fills nothing."""
    left, since_ns = bucket
    return min(left + rate.per_s * max(now_ns - since_ns, 0) / 1e9, rate.at_once)
