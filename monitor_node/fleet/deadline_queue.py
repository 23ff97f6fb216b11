"""When something is due of each of many plants, the earliest first.

What is due later than was known is found when it comes up, so that nothing has to be looked for when a sample makes it
so.
"""

from collections.abc import Iterator
from heapq import heappop, heappush

NEVER_NS = 2**63 - 1


class Dues:
    """A heap of times, of which the earliest of each plant counts."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, str]] = []
        self._due_ns: dict[str, int] = {}  # of each plant, the earliest that is in the heap

    def note(self, plant: str, due_ns: int) -> None:
        """Note when a plant is due, if that is earlier than known."""
        if due_ns < self._due_ns.get(plant, due_ns + 1):
            self._due_ns[plant] = due_ns
            heappush(self._heap, (due_ns, plant))

    def forget(self, plant: str) -> None:
        """A plant is due no more."""
        self._due_ns.pop(plant, None)

    def taken(self, now_ns: int) -> Iterator[str]:
        """The plants that are due; each is to be noted again."""
        while self._heap and self._heap[0][0] <= now_ns:
            due_ns, plant = heappop(self._heap)
            if self._due_ns.get(plant) == due_ns:
                del self._due_ns[plant]
                yield plant

    def first_ns(self) -> int:
        """When the first is due, or was; `NEVER_NS` if there is none."""
        return self._heap[0][0] if self._heap else NEVER_NS
