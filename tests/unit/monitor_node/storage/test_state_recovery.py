"""What is known of plants from before, as a monitor finds it that may be cut off."""

import threading

import pytest

from monitor_node.storage import state_recovery
from monitor_node.storage.state_recovery import StateRecovery
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded
from tests.memory_bus import Exchange, MemoryBus
from tests.running import WITHIN_S


class CutOff(MemoryBus):
    """A bus whose router is gone at first, and found again at the third look."""

    def __init__(self) -> None:
        super().__init__(Exchange())
        self._looks = iter((False, False, True))
        self.seen: list[str] = []
        self.asked = threading.Event()

    @property
    def has_router(self) -> bool:
        found = next(self._looks, True)
        self.seen.append("router" if found else "no router")
        return found

    def query_history(self, key_expression: str) -> list[Encoded]:
        self.seen.append(key_expression)
        if keys.ALARM in key_expression:
            self.asked.set()
        return []


@pytest.fixture(autouse=True)
def _no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("HANDOVER_S", "RETURN_S", "POLL_S"):
        monkeypatch.setattr(state_recovery, name, 0.0)


def test_who_is_cut_off_takes_nobody_s_plants_over_until_the_others_are_to_be_seen_again() -> None:
    bus = CutOff()
    state_recovery = StateRecovery(bus, None, lambda _plant: True, lambda _plant, _line: None)
    state_recovery.request("a")
    state_recovery.start(lambda _past: None)
    assert bus.asked.wait(WITHIN_S)
    state_recovery.close()
    assert bus.seen[:2] == ["no router", "no router"]
    assert bus.seen[-3:] == ["router", "reactor/a/sample/**", "reactor/a/alarm/**"]
