"""Which recordings are deleted, oldest first, so that those that are left keep within limits. Pure.

All times are confirmed ones, see `ages`: no clock that is set deletes anything.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import NamedTuple

DAY_NS = 86_400_000_000_000


class Finished(NamedTuple):
    """A recording that is whole.

    Attributes:
        path: the file.
        size_bytes: its size.
        ended_ns: the confirmed time at which it was first seen whole.
        modified_ns: the time that the file says it was modified at; it orders files that were first seen together.
    """

    path: Path
    size_bytes: int
    ended_ns: int
    modified_ns: int = 0


@dataclass(frozen=True)
class Limits:
    """What may be kept, the file that is being written included; infinite: without limit.

    Attributes:
        size_bytes: of all together.
        age_ns: of a recording, since its end.
        files: how many.
    """

    size_bytes: float = inf
    age_ns: float = inf
    files: float = inf


def to_delete(
    finished: Iterable[Finished],
    writing_bytes: int | None,
    limits: Limits,
    now_ns: int,
    needed_since_ns: int | None = None,
) -> list[Path]:
    """What has to go.

    Args:
        finished: all recordings that are whole; the one that is being written is not among them and is never deleted.
        writing_bytes: its size; None: none is being written.
        limits: see there.
        now_ns: the confirmed time.
        needed_since_ns: what ended since then stays, whatever the limits say; None: nothing is needed.

    Returns:
        The files, oldest first.
    """
    by_age = sorted(finished, key=lambda item: (item.ended_ns, item.modified_ns, item.path))
    left, size = len(by_age), sum(item.size_bytes for item in by_age)
    if writing_bytes is not None:
        left, size = left + 1, size + writing_bytes
    gone = []
    for item in by_age:
        within = left <= limits.files and size <= limits.size_bytes and now_ns - item.ended_ns <= limits.age_ns
        if within or (needed_since_ns is not None and item.ended_ns >= needed_since_ns):
            break
        gone.append(item.path)
        left, size = left - 1, size - item.size_bytes
    return gone
