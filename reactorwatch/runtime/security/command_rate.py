"""Rate limit of commands, so that a flood of them delays no alarm.

A command that changes something is written to the disk before it is answered, which takes milliseconds. Senders choose
the names in commands, so all names together are limited, too. Commands without a name have a limit of their own.
"""

from collections import OrderedDict
from typing import NamedTuple

from reactorwatch.contract.codec import DecodeError, Encoded, decode
from reactorwatch.contract.commands import MAX_NAME

MAX_NAMES = 1000
"""Names with a bucket; the least recently seen is evicted first."""


class Rate(NamedTuple):
    """A token bucket.

    Attributes:
        at_once: capacity, in commands.
        per_s: commands a second that fill it.
    """

    at_once: float
    per_s: float


PER_NAME = Rate(30.0, 5.0)
ALL = Rate(100.0, 20.0)
"""Limit of all names together, and of commands without a name."""


class CommandRateLimiter:
    """Token buckets of commands by their sender's name.

    >>> rate = CommandRateLimiter()
    >>> [rate.check("Anna", now_ns=0) for _ in range(30)] == [None] * 30
    True
    >>> rate.check("Anna", now_ns=0)
    "too many commands by 'Anna': 30 at once and 5 a second are taken; try again in a second"
    >>> rate.check("Anna", now_ns=1_000_000_000) is None
    True
    """

    def __init__(self) -> None:
        self._names: OrderedDict[str, tuple[float, int]] = OrderedDict()  # level of a bucket, and its time
        self._all = {True: (ALL.at_once, 0), False: (ALL.at_once, 0)}  # with a name, without

    def check(self, name: str, now_ns: int) -> str | None:
        """Count a command; returns the reason for its refusal, None if it is accepted.

        Args:
            name: sender's name in the command; empty: none.
            now_ns: the time.
        """
        left_all = _level(self._all[bool(name)], ALL, now_ns)
        left = _level(self._names.pop(name, (PER_NAME.at_once, now_ns)), PER_NAME, now_ns) if name else left_all
        refused = left < 1.0 or left_all < 1.0
        spent = 0.0 if refused else 1.0
        self._all[bool(name)] = left_all - spent, now_ns
        if name:
            self._names[name] = left - spent, now_ns
            if len(self._names) > MAX_NAMES:
                self._names.popitem(last=False)
        if not refused:
            return None
        rate, who = (PER_NAME, f" by {name!r}") if name and left < 1.0 else (ALL, "")
        return (
            f"too many commands{who}: {rate.at_once:g} at once and {rate.per_s:g} a second are taken; "
            f"try again in a second"
        )


def sender_name(question: Encoded) -> str:
    """Sender's name in a command; empty if it has none, or cannot be decoded."""
    try:
        command = decode(question.payload, question.encoding)
    except DecodeError:
        return ""
    return str(getattr(command, "by", "")).strip()[:MAX_NAME]


def _level(bucket: tuple[float, int], rate: Rate, now_ns: int) -> float:
    """Level of a bucket now; a clock that was set back does not fill it."""
    left, since_ns = bucket
    return min(left + rate.per_s * max(now_ns - since_ns, 0) / 1e9, rate.at_once)
