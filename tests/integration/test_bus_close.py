"""A closed bus leaves no thread in Zenoh's code: at the interpreter's end such a thread aborts the process."""

import threading

from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime.bus_zenoh import ZenohBus, router
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.http_pages import free_endpoint
from tests.running import WITHIN_S

KEY = "reactor/cstr/sample/T"


def test_close_returns_after_the_last_batch_is_handled() -> None:
    bus: ZenohBus = router(BusConfig(endpoint=free_endpoint()))
    entered, release, order = threading.Event(), threading.Event(), list[str]()

    def handle(_messages: list[Encoded]) -> None:
        entered.set()
        assert release.wait(WITHIN_S)
        order.append("handled")

    def close() -> None:
        bus.close()
        order.append("closed")

    bus.subscribe_batched(KEY, handle)
    bus.publish(Encoded(KEY, b"1", ""))
    assert entered.wait(WITHIN_S)
    closing = threading.Thread(target=close)
    closing.start()
    closing.join(1.5)  # the bus stays open for a second after its last message
    release.set()
    closing.join(WITHIN_S)
    assert order == ["handled", "closed"]
    assert not [thread for thread in threading.enumerate() if thread.name == "gather"]
