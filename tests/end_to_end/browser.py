"""A browser without a window: Chromium, spoken to in its own protocol over two pipes, so that no driver is needed.

https://chromedevtools.github.io/devtools-protocol/; with --remote-debugging-pipe it reads commands at descriptor 3 and
answers at 4, JSON that ends in a zero byte. One picture after another can be taken of a page that lives on, which
--screenshot, with its one moment, cannot.
"""

import base64
import json
import os
import select
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from .conftest import PATIENCE_S

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
ARGUMENTS = (
    "--headless=new",
    "--remote-debugging-pipe",
    "--no-sandbox",  # tests may be run by root
    "--no-first-run",
    "--disable-background-networking",
    "--disable-dev-shm-usage",
    "--enable-unsafe-swiftshader",  # graphics without a card
    "--use-angle=swiftshader",
    "--window-size=1280,800",
)


class Browser:
    """A browser with one page.

    Args:
        commands: descriptor that it reads.
        answers: descriptor that it writes.
    """

    def __init__(self, commands: int, answers: int) -> None:
        self._commands, self._answers = commands, answers
        self._rest = b""
        self._number = 0
        self._events: list[str] = []
        (page, *_) = [item for item in self._ask("Target.getTargets")["targetInfos"] if item["type"] == "page"]
        attached = self._ask("Target.attachToTarget", targetId=page["targetId"], flatten=True)
        self._session = {"sessionId": attached["sessionId"]}
        self._ask("Page.enable", on=self._session)

    def go_to(self, address: str) -> None:
        """Open an address; returns when the page is there."""
        self._events.clear()
        self._ask("Page.navigate", url=address, on=self._session)
        while "Page.loadEventFired" not in self._events:
            self._next()

    def screenshot(self) -> bytes:
        """What the page shows, as PNG."""
        return base64.b64decode(self._ask("Page.captureScreenshot", on=self._session)["data"])

    def resize(self, width: int, height: int) -> None:
        """Lay the page out for a window of that size, in pixels."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self._ask("Emulation.setDeviceMetricsOverride", on=self._session, **metrics)

    def prefer(self, scheme: str) -> None:
        """Ask the page for a `light` or a `dark` ground."""
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self._ask("Emulation.setEmulatedMedia", on=self._session, features=features)

    def emulate_print(self, width: int) -> None:
        """Lay the page out as on paper of that width, in pixels."""
        self.resize(width, 1000)
        self._ask("Emulation.setEmulatedMedia", on=self._session, media="print")

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression in the page."""
        found = self._ask("Runtime.evaluate", on=self._session, expression=expression, returnByValue=True)
        return found["result"]["value"]

    def _ask(self, method: str, on: dict[str, str] | None = None, **parameters: Any) -> Any:
        self._number += 1
        command = {"id": self._number, "method": method, "params": parameters, **(on or {})}
        os.write(self._commands, json.dumps(command).encode() + b"\0")
        while (answer := self._next()).get("id") != self._number:
            pass
        assert "error" not in answer, answer
        return answer["result"]

    def _next(self) -> dict[str, Any]:
        """The next that it says: an answer, or an event, which is noted."""
        while b"\0" not in self._rest:
            there, _, _ = select.select([self._answers], [], [], PATIENCE_S)
            assert there, f"the browser has said nothing for {PATIENCE_S:g} s"
            more = os.read(self._answers, 1 << 20)
            assert more, "the browser has ended"
            self._rest += more
        message, _, self._rest = self._rest.partition(b"\0")
        said: dict[str, Any] = json.loads(message)
        self._events.append(said.get("method", ""))
        return said


@contextmanager
def browser(folder: Path) -> Iterator[Browser]:
    """A browser that ends with the context; the test skips where there is none.

    Args:
        folder: for its settings.
    """
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip(f"there is no browser here (looked for {', '.join(NAMES)}; on Debian: chromium)")
    to_read, commands = os.pipe()
    answers, to_write = os.pipe()
    # it wants these very descriptors; a shell puts them there without code between fork and exec
    line = f'exec "$@" 3<&{to_read} 4>&{to_write}'
    process = subprocess.Popen(
        ["bash", "-c", line, "browser", program, *ARGUMENTS, f"--user-data-dir={folder}", "about:blank"],
        pass_fds=(to_read, to_write),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(to_read)
    os.close(to_write)
    try:
        yield Browser(commands, answers)
    finally:
        process.terminate()
        process.wait(20)
        os.close(commands)
        os.close(answers)
