"""Who hears what the monitors of a soak say, by a link that nobody cuts."""

import threading
from collections.abc import Callable

from benchmarks.link_cuts import connected
from benchmarks.soak.site import FLEET, PATIENCE_S
from monitor_node.health import NODE
from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, decode
from reactorwatch.contract.messages_pb2 import Alarm, Health
from reactorwatch.runtime.config import BusConfig


class Witness:
    """Hears alarms, health and who is there.

    Args:
        config: where the router is.

    Attributes:
        alarms: by plant, all that was said, in the order in which it came.
        health: by plant, what was said last of its monitor.
        longest_lag_ms: of all that was said.
    """

    def __init__(self, config: BusConfig) -> None:
        self._changed = threading.Condition()
        self._crew: set[str] = set()
        self.alarms: dict[str, list[Alarm]] = {}
        self.health: dict[str, Health] = {}
        self.longest_lag_ms = 0.0
        self._bus = connected(config)
        self._bus.subscribe_liveliness(f"{keys.ROOT}/{keys.FLEET}/**", self._on_token)
        self._bus.subscribe(f"{FLEET}/{keys.ALARM}/**", self._on_message)
        self._bus.subscribe(f"{FLEET}/{keys.HEALTH}/{NODE}", self._on_message)

    def wait_for_crew(self, count: int) -> None:
        """Wait until so many monitors are there."""
        assert self.wait(lambda: len(self._crew) == count), f"not {count} monitors, but {self._crew}"

    def wait(self, condition: Callable[[], bool], within_s: float = PATIENCE_S) -> bool:
        """Wait until what was heard makes it so; returns whether it does."""
        with self._changed:
            return self._changed.wait_for(condition, within_s)

    def close(self) -> None:
        """Hear no more."""
        self._bus.close()

    def _on_token(self, key: str, is_alive: bool) -> None:
        with self._changed:
            (self._crew.add if is_alive else self._crew.discard)(key)
            self._changed.notify_all()

    def _on_message(self, message: Encoded) -> None:
        topic = keys.parse(message.key)
        try:
            body = decode(message.payload, message.encoding)
        except DecodeError:
            return  # the stranger's
        if topic is None:
            return
        with self._changed:
            if isinstance(body, Health):
                self.health[topic.plant] = body
                self.longest_lag_ms = max(self.longest_lag_ms, body.lag_ms)
            elif isinstance(body, Alarm) and body.alarm == topic.name:
                self.alarms.setdefault(topic.plant, []).append(body)
            self._changed.notify_all()
