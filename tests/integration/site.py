"""A site with its router on loopback, and sessions that join it with their certificates."""

import datetime
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec

from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime.bus_zenoh import ZenohBus, connect, router_from_file
from reactorwatch.runtime.config import BusConfig, read_settings, section
from reactorwatch.runtime.event_loop import StopSignal
from reactorwatch.runtime.http_pages import free_port
from reactorwatch.runtime.provisioning import make_site

PLANTS = ("cstr", "other")
WITHIN_S = 60.0


class OneAttempt(StopSignal):
    """Ends the waiting for a router after the first refusal."""

    def __init__(self) -> None:
        super().__init__()
        self._asked = 0

    def wait(self, timeout_s: float | None = None) -> bool:
        self._asked += 1
        return self._asked > 1


def make(folder: Path, endpoint: str = "", plants: tuple[str, ...] = PLANTS) -> str:
    """A site of two plants, with a router that is called at the endpoint returned."""
    endpoint = endpoint or f"tls/127.0.0.1:{free_port()}"
    make_site(folder, plants, endpoint, endpoint, 90.0, datetime.datetime.now(datetime.UTC))
    return endpoint


def settings(folder: Path, who: str) -> BusConfig:
    """How a holder, such as `cstr/viewer`, joins."""
    return section(BusConfig, "bus", read_settings(folder / who / "settings.toml"), {})


class Site:
    """A router that is running, and what it hears; closed at the end, with all who joined.

    Args:
        folder: for the site's files.
        plants: the plants of the site.
    """

    def __init__(self, folder: Path, plants: tuple[str, ...] = PLANTS) -> None:
        self.folder = folder
        self.endpoint = make(folder, plants=plants)
        self.router = router_from_file(folder / "router" / "router.json5")
        self._joined: list[ZenohBus] = []
        self._received: list[Encoded] = []
        self._changed = threading.Condition()
        for keys in ("sample/*", "audit/*", "alarm/recording/*"):
            self.router.subscribe(f"reactor/cstr/{keys}", self._on_message)  # no whole stream: each as it comes

    def join(self, who: str, endpoint: str | None = None) -> ZenohBus:
        """A session of a holder, by the router's address or another that leads there."""
        config = settings(self.folder, who)
        config = msgspec.structs.replace(config, endpoint=endpoint or config.endpoint)
        bus = connect(config, who, OneAttempt())
        assert bus is not None, f"{who} was not let in"
        self._joined.append(bus)
        return bus

    def leave(self, *buses: ZenohBus) -> None:
        """End sessions, once all that they sent has been let in or not; each takes a second, so all at once."""
        for bus in buses:
            self._joined.remove(bus)
        with ThreadPoolExecutor(len(buses)) as closing:
            list(closing.map(ZenohBus.close, buses))

    def received_until(self, is_last: Callable[[Encoded], bool]) -> list[Encoded]:
        """What was let in, up to a message."""
        with self._changed:
            assert self._changed.wait_for(lambda: any(map(is_last, self._received)), WITHIN_S)
            return list(self._received)

    def close_readers(self) -> None:
        """End all sessions, the newest first; a session hands on what waits in it before it ends."""
        while self._joined:
            self._joined.pop().close()

    def close(self) -> None:
        for bus in self._joined:
            bus.close()
        self.router.close()

    def _on_message(self, message: Encoded) -> None:
        with self._changed:
            self._received.append(message)
            self._changed.notify_all()
