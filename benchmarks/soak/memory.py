"""Memory of the processes of a soak, and the rule that it is level after a warm-up.

The first third of the run is the warm-up: caches fill, and buffers grow to what the first floods and recoveries need.
Of a process that ran all the time since, the median in the last third is not above the median in the second third by
more than `GROWTH_MB`. It is the median, as a flood or a recovery takes more for a moment, whenever it comes. The first
monitor is never killed, so that every run judges the memory of a monitor.
"""

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

GROWTH_MB = 10.0
"""Allowed growth. In ten minutes with 200 plants a third is 240,000 samples: 42 bytes kept of each
are more. In an hour it is 7."""
OWN = ("RssAnon:", "RssShmem:")
"""Lines of a process's status: its own pages, and those of memory that it shares with other processes."""


class Taken(NamedTuple):
    """Memory that a process takes at one time."""

    row: int  # Row of the plants that was published last
    pid: int  # Number of the process; a restarted process has another one
    memory_mb: float  # Memory of the process's own in MB


def own_memory_mb(pid: int) -> float:
    """Return the memory that a process takes beside the files that it maps, in MB; 0 if it has ended.

    Pages of files, mainly of compiled libraries, are the system's to keep and to drop as it has room.
    """
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0.0
    return sum(int(line.split()[1]) for line in lines if line.startswith(OWN)) * 1024 / 1e6


def most_in_thirds(taken: Sequence[Taken], rows: int) -> tuple[float, float, float]:
    """Return the most memory in each third of the run, in MB."""
    first, middle, last = (max((item.memory_mb for item in third), default=0.0) for third in _thirds(taken, rows))
    return first, middle, last


def find_growth_mb(taken: Sequence[Taken], rows: int) -> float | None:
    """Return how much a process has grown since the warm-up, in MB; None if it did not run all the time since."""
    _, middle, last = _thirds(taken, rows)
    if not middle or not last or len({item.pid for item in (*middle, *last)}) > 1:
        return None
    return median(item.memory_mb for item in last) - median(item.memory_mb for item in middle)


def _thirds(taken: Sequence[Taken], rows: int) -> list[list[Taken]]:
    """Split measurements by the third of the run in which they were made."""
    thirds: list[list[Taken]] = [[], [], []]
    for item in taken:
        thirds[min(3 * item.row // rows, 2)].append(item)
    return thirds
