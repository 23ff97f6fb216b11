"""Group recordings whose time spans overlap. Pure."""

from collections.abc import Callable, Iterable
from typing import TypeVar

Item = TypeVar("Item")


def group_overlapping(items: Iterable[Item], span: Callable[[Item], tuple[int, int]]) -> list[list[Item]]:
    """Group items so that groups follow each other in time, and times overlap within a group.

    Args:
        items: items in the order of their starts.
        span: returns start and end of an item.

    >>> group_overlapping(["ad", "bc", "de", "fg"], lambda item: (ord(item[0]), ord(item[1])))
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
