"""Plants that were adopted lately, and the samples of them that come a second time.

Who adopts a plant is told what it said before, up to now. The same samples may still be on their way to him by
themselves: they wait in his inbox, or for others that are being recovered after a cut. When they come he has judged
them, and more of them than rows may be late would look like a plant that was started anew and has set its clock back.
So for a while, which is longer than any recovery takes, a sample with a number and a time that are not beyond the
newest that was told is taken as one that was told.

A plant that is really started anew in that while, with a clock that was set back, is heard when the while is over.
"""

from typing import NamedTuple

from monitor_node.core import Monitor
from monitor_node.ingest.sample_limits import LARGEST_SAMPLE
from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, decode
from reactorwatch.contract.messages_pb2 import Sample

AGAIN_NS = 60_000_000_000
"""The bus waits for what is missing for half of it at most."""


class _Newest(NamedTuple):
    until_ns: int
    samples: dict[str, tuple[int, int]]  # by key, number and time


class Recent:
    """The plants that were adopted lately."""

    def __init__(self) -> None:
        self._newest: dict[str, _Newest] = {}  # by plant; the order is that of their adoption

    def adopted(self, plant: str, monitor: Monitor, now_ns: int) -> None:
        """What was told of a plant has been judged.

        Args:
            plant: its name.
            monitor: its.
            now_ns: now.
        """
        runs = zip((monitor.config.input, *monitor.config.outputs), monitor.state.runs, strict=True)
        samples = {
            keys.key(plant, keys.SAMPLE, signal): (run.number, run.time_ns)
            for signal, run in runs
            if run.number is not None
        }
        self._newest.pop(plant, None)
        self._newest[plant] = _Newest(now_ns + AGAIN_NS, samples)

    def again(self, plant: str, message: Encoded, now_ns: int) -> bool:
        """Whether a message is a sample that was told before the plant was adopted."""
        while self._newest and (first := next(iter(self._newest))) and self._newest[first].until_ns < now_ns:
            del self._newest[first]
        newest = self._newest[plant].samples.get(message.key) if plant in self._newest else None
        if newest is None or len(message.payload) > LARGEST_SAMPLE:
            return False
        try:
            sample = decode(message.payload, message.encoding)
        except DecodeError:
            return False
        return isinstance(sample, Sample) and sample.sequence <= newest[0] and sample.time_ns <= newest[1]
