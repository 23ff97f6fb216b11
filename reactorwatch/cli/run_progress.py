"""Progress of a run that has an end, observed on the bus: newest sample, and newest row that the monitor evaluated."""

import threading
import time
from collections.abc import Callable

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, decode
from reactorwatch.contract.messages_pb2 import Estimate, Sample
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.runtime.bus_zenoh import ZenohBus

DRAIN_WITHIN_S = 60.0
"""Time without another evaluated row after which a monitor is not waited for."""

POLL_S = 0.1
STEADY_POLLS = 5
"""Polls with every received row evaluated, after which no more rows are on their way."""


class RunProgress:
    """Progress of source and monitor.

    Args:
        bus: the bus of the run.
        plant: name of the plant.
        span_ns: time from the first row of the run to its last; None: unknown.
    """

    def __init__(self, bus: ZenohBus, plant: str, span_ns: int | None = None) -> None:
        self._span_ns = span_ns
        self._lock = threading.Lock()
        self._first_ns: int | None = None
        self._newest_ns = 0
        self._evaluated_ns = 0
        bus.subscribe(keys.all_keys(plant, keys.SAMPLE), self._on_sample)
        bus.subscribe(keys.all_keys(plant, keys.ESTIMATE), self._on_estimate)

    @property
    def started(self) -> bool:
        """True once a sample has arrived."""
        return self._first_ns is not None

    @property
    def plant_min(self) -> float:
        """Plant time since the first sample, in minutes."""
        with self._lock:
            return 0.0 if self._first_ns is None else (self._newest_ns - self._first_ns) / MINUTE_NS

    def wait_until_evaluated(self, wait: Callable[[float], bool]) -> None:
        """Wait until the monitor has evaluated the last row; call it when all samples are published.

        Args:
            wait: waits for so many seconds; returns True if the run is stopped.
        """
        before, since, steady = -1, time.monotonic(), 0
        while not wait(POLL_S):
            evaluated_ns, all_evaluated = self._state()
            if all_evaluated and self._span_ns is not None:
                return
            steady = steady + 1 if all_evaluated else 0
            if evaluated_ns != before:
                before, since = evaluated_ns, time.monotonic()
            if steady >= STEADY_POLLS or time.monotonic() - since > DRAIN_WITHIN_S:
                return

    def _state(self) -> tuple[int, bool]:
        """Time of the newest evaluated row, and whether it is the last row, as far as that is known."""
        with self._lock:
            last_ns = self._newest_ns
            if self._span_ns is not None and self._first_ns is not None:
                last_ns = self._first_ns + self._span_ns
            return self._evaluated_ns, self._first_ns is not None and self._evaluated_ns >= last_ns

    def _on_sample(self, message: Encoded) -> None:
        sample = decode(message.payload, message.encoding)
        assert isinstance(sample, Sample)
        with self._lock:
            self._first_ns = sample.time_ns if self._first_ns is None else self._first_ns
            self._newest_ns = max(self._newest_ns, sample.time_ns)

    def _on_estimate(self, message: Encoded) -> None:
        estimate = decode(message.payload, message.encoding)
        assert isinstance(estimate, Estimate)
        with self._lock:
            self._evaluated_ns = max(self._evaluated_ns, estimate.time_ns)
