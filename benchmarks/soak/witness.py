"""Observer of the monitors of a soak, on a link that is never cut."""

import threading
from collections.abc import Callable

from benchmarks.harness.site import connect_client
from benchmarks.soak.site import FLEET, PATIENCE_S
from monitor_node.health import NODE
from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, decode
from reactorwatch.contract.messages_pb2 import Alarm, Health
from reactorwatch.runtime.config import BusConfig


class Witness:
    """Collects alarms, health and tokens of the monitors."""

    def __init__(self, config: BusConfig) -> None:
        self._changed = threading.Condition()
        self._tokens: set[str] = set()
        self.alarms: dict[str, list[Alarm]] = {}
        self.health: dict[str, Health] = {}
        self.longest_lag_ms = 0.0
        self._bus = connect_client(config)
        self._bus.subscribe_liveliness(f"{keys.ROOT}/{keys.FLEET}/**", self._on_token)
        self._bus.subscribe(f"{FLEET}/{keys.ALARM}/**", self._on_message)
        self._bus.subscribe(f"{FLEET}/{keys.HEALTH}/{NODE}", self._on_message)

    def wait_for_monitors(self, count: int) -> None:
        """Wait for a number of live monitors."""
        assert self.wait(lambda: len(self._tokens) == count), f"not {count} monitors, but {self._tokens}"

    def wait(self, condition: Callable[[], bool], within_s: float = PATIENCE_S) -> bool:
        """Wait for a condition on the messages; returns True if it holds."""
        with self._changed:
            return self._changed.wait_for(condition, within_s)

    def close(self) -> None:
        """Close the link."""
        self._bus.close()

    def _on_token(self, key: str, is_alive: bool) -> None:
        with self._changed:
            (self._tokens.add if is_alive else self._tokens.discard)(key)
            self._changed.notify_all()

    def _on_message(self, message: Encoded) -> None:
        topic = keys.parse(message.key)
        try:
            body = decode(message.payload, message.encoding)
        except DecodeError:
            return  # garbage
        if topic is None:
            return
        with self._changed:
            if isinstance(body, Health):
                self.health[topic.plant] = body
                self.longest_lag_ms = max(self.longest_lag_ms, body.lag_ms)
            elif isinstance(body, Alarm) and body.alarm == topic.name:
                self.alarms.setdefault(topic.plant, []).append(body)
            self._changed.notify_all()
