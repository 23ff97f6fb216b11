"""Which of several recordings are read one after the other, and which together. Pure."""

from collections.abc import Callable, Iterable
from typing import TypeVar

Item = TypeVar("Item")


def in_turn(items: Iterable[Item], span: Callable[[Item], tuple[int, int]]) -> list[list[Item]]:
    """Put things in groups that follow each other in time; within a group their times overlap.

    Args:
        items: in the order of their beginnings.
        span: beginning and end of one.

    >>> in_turn(["ad", "bc", "de", "fg"], lambda item: (ord(item[0]), ord(item[1])))
    [['ad', 'bc'], ['de'], ['fg']]
    """
    groups: list[list[Item]] = []
    last = -1
    for item in items:
        first, end = span(item)
        if groups and first < last:
            groups[-1].append(item)
        else:
            groups.append([item])
        last = max(last, end)
    return groups
