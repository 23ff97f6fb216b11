"""Queue of the plants' deadlines, the earliest first.

A postponed deadline is noticed when it comes up, so that a sample that postpones it need not search the queue.
"""

from collections.abc import Iterator
from heapq import heappop, heappush

from reactorwatch.records.record import NEVER_NS


class DeadlineQueue:
    """A heap of deadlines; the earliest of each plant counts."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, str]] = []
        self._due_ns: dict[str, int] = {}  # the earliest deadline in the heap by plant

    def schedule(self, plant: str, due_ns: int) -> None:
        """Schedule a plant, if this deadline is earlier than its present one."""
        if due_ns < self._due_ns.get(plant, due_ns + 1):
            self._due_ns[plant] = due_ns
            heappush(self._heap, (due_ns, plant))

    def remove(self, plant: str) -> None:
        """Remove a plant."""
        self._due_ns.pop(plant, None)

    def pop_due(self, now_ns: int) -> Iterator[str]:
        """Remove and yield the plants that are due."""
        while self._heap and self._heap[0][0] <= now_ns:
            due_ns, plant = heappop(self._heap)
            if self._due_ns.get(plant) == due_ns:
                del self._due_ns[plant]
                yield plant

    def next_ns(self) -> int:
        """The earliest deadline; `NEVER_NS` if there is none."""
        return self._heap[0][0] if self._heap else NEVER_NS
