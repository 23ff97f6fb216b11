"""Retention: select the oldest recordings for deletion until the others are within limits. Pure.

All times are confirmed times (see `ages`): setting a clock deletes nothing.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import NamedTuple

DAY_NS = 86_400_000_000_000


class CompleteRecording(NamedTuple):
    """Complete recording on disk.

    Attributes:
        path: the file.
        size_bytes: size of the file.
        ended_ns: confirmed time at which it was first seen complete.
        modified_ns: modification time of the file, which orders files with equal `ended_ns`.
    """

    path: Path
    size_bytes: int
    ended_ns: int
    modified_ns: int = 0


@dataclass(frozen=True)
class Limits:
    """Limits on recordings, the one being written included; inf is no limit.

    Attributes:
        size_bytes: total size.
        age_ns: time since the end of a recording.
        files: number of files.
    """

    size_bytes: float = inf
    age_ns: float = inf
    files: float = inf


def select_deletions(
    complete: Iterable[CompleteRecording],
    writing_bytes: int | None,
    limits: Limits,
    now_ns: int,
    protected_since_ns: int | None = None,
) -> list[Path]:
    """Select the recordings to delete, oldest first.

    Args:
        complete: complete recordings, without the one that is being written, which is never deleted.
        writing_bytes: size of the recording that is being written; None if there is none.
        limits: the limits.
        now_ns: confirmed time.
        protected_since_ns: recordings that ended since then stay regardless of the limits; None protects none.
    """
    by_age = sorted(complete, key=lambda item: (item.ended_ns, item.modified_ns, item.path))
    count, size = len(by_age), sum(item.size_bytes for item in by_age)
    if writing_bytes is not None:
        count, size = count + 1, size + writing_bytes
    deletions = []
    for item in by_age:
        within = count <= limits.files and size <= limits.size_bytes and now_ns - item.ended_ns <= limits.age_ns
        if within or (protected_since_ns is not None and item.ended_ns >= protected_since_ns):
            break
        deletions.append(item.path)
        count, size = count - 1, size - item.size_bytes
    return deletions
