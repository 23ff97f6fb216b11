"""Recently adopted plants, and their samples that arrive a second time.

A monitor that adopts a plant queries its history up to now. The same samples may still be on their way: in the inbox,
or behind others that are being recovered after a partition. They are processed already, and many of them would look
like a restart of the plant with its clock set back. So for a while, longer than any recovery, a sample with a number
and a time not beyond the newest of the history is a repeat.

A plant that is really restarted in that while, with its clock set back, is processed when the while is over.
"""

from typing import NamedTuple

from monitor_node.core import Monitor
from monitor_node.ingest.sample_limits import LARGEST_SAMPLE
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, decode_as
from reactorwatch.contract.messages_pb2 import Sample
from reactorwatch.runtime.delivery.gap_tracker import GapTracker

AGAIN_NS = 60_000_000_000
"""At least twice the longest time that the bus waits for missing messages."""


class _Newest(NamedTuple):
    until_ns: int
    samples: dict[str, GapTracker]  # by key


class RecentlyAdopted:
    """The recently adopted plants."""

    def __init__(self) -> None:
        self._newest: dict[str, _Newest] = {}  # by plant, in the order of adoption

    def add(self, plant: str, monitor: Monitor, now_ns: int) -> None:
        """Add a plant whose history was processed.

        Args:
            plant: name of the plant.
            monitor: monitor of the plant.
            now_ns: present time.
        """
        runs = zip(monitor.config.signals, monitor.memory.runs, strict=True)
        samples = {
            keys.key(plant, keys.SAMPLE, signal): GapTracker(run.expected, run.newest_ns) for signal, run in runs
        }
        self._newest.pop(plant, None)
        self._newest[plant] = _Newest(now_ns + AGAIN_NS, samples)

    def is_repeat(self, plant: str, message: Encoded, now_ns: int) -> bool:
        """True if a message is a sample of the history."""
        while self._newest and (first := next(iter(self._newest))) and self._newest[first].until_ns < now_ns:
            del self._newest[first]
        newest = self._newest[plant].samples.get(message.key) if plant in self._newest else None
        if newest is None or len(message.payload) > LARGEST_SAMPLE:
            return False
        sample = decode_as(message, Sample)
        return sample is not None and newest.is_past(sample.sequence, sample.time_ns)
