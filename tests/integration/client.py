"""A client of a router, for as long as a test needs it."""

from collections.abc import Iterator
from contextlib import contextmanager

from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.bus_zenoh import ZenohBus
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal


@contextmanager
def client(config: BusConfig) -> Iterator[ZenohBus]:
    bus = bus_zenoh.connect(config, "test", StopSignal())
    assert bus is not None
    yield bus
    bus.close()
