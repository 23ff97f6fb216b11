"""Pictures of dashboards without a screen, drawn by the headless Rerun viewer in a process for each dashboard.

The viewer does not report that it has finished. A picture is complete if nothing is being loaded, it has coloured lines
and not only frames, it is not that of the tab before, and the next picture is equal.
"""

import io
import re
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError
from reactorwatch.records.write import atomic_write, make_folder
from reactorwatch.runtime.http_pages import free_port
from recorder.view.viewer import describe_exit, viewer

if TYPE_CHECKING:
    from docs.pictures.viewer_client import Viewer

DEADLINE_S = 60.0
POLL_S = 0.3
LEAST_COLOUR = 60
"""Least difference between the channels of a pixel of a line; frames and texts are grey."""
LEAST_PIXELS = 500
"""Least number of coloured pixels of a picture with plots; buttons alone have fewer."""


def render_tabs(
    rrd: Path, folder: Path, width: int = 1600, height: int = 1000, deadline_s: float = DEADLINE_S
) -> list[Path]:
    """Draw every tab of a dashboard.

    Args:
        rrd: the dashboard.
        folder: folder for the pictures, which are named after the tabs; it is created if needed.
        width: width in pixels.
        height: height in pixels.
        deadline_s: largest duration of each picture, in seconds.

    Returns:
        The pictures, in the order of the tabs.

    Raises:
        InputError: the dashboard does not exist, the viewer does not run on this machine, or it shows no plots in time;
            or the folder cannot be created.
    """
    pictures: list[Path] = []
    deadline = time.monotonic() + deadline_s
    with _HeadlessViewer.open(rrd, width, height, deadline) as studio:
        picture = studio.picture(deadline)
        make_folder(folder)
        for index, (title, tab) in enumerate(studio.client.tabs.items()):
            if index:
                studio.client.open_tab(tab)
                picture = studio.picture(time.monotonic() + deadline_s, other_than=picture)
            path = folder / f"{slug(title)}.png"
            with atomic_write(path) as temporary:
                temporary.write_bytes(picture)
            pictures.append(path)
    return pictures


def slug(title: str) -> str:
    """Title as a file name: `residuals-and-charts`."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def count_coloured(png: bytes) -> int:
    """Number of pixels of coloured lines."""
    channels = _channels(png)
    return int((channels.max(axis=2) - channels.min(axis=2) >= LEAST_COLOUR).sum())


def _channels(png: bytes) -> NDArray[np.int16]:
    """Pixels of a picture, shape (height, width, 3)."""
    from PIL import Image

    with Image.open(io.BytesIO(png)) as image:
        return np.asarray(image.convert("RGB"), np.int16)


class _HeadlessViewer:
    """Headless viewer that shows a dashboard.

    Args:
        process: process of the viewer.
        port: port of the viewer.
        log: file with its output.
        deadline: latest time of its first reply, by the monotonic clock.

    Attributes:
        client: client of the viewer.
    """

    def __init__(self, process: subprocess.Popen[bytes], port: int, log: Path, deadline: float) -> None:
        self._process, self._log = process, log
        self.client = self._connect(port, deadline)

    @classmethod
    @contextmanager
    def open(cls, rrd: Path, width: int, height: int, deadline: float) -> "Iterator[_HeadlessViewer]":
        """Run a viewer with default settings within the context."""
        if not rrd.is_file():
            raise InputError(f"{rrd}: there is no such file")
        port = free_port()
        with tempfile.TemporaryDirectory() as home:
            log = Path(home) / "viewer.log"
            arguments = ("--headless", "--window-size", f"{width}x{height}", str(rrd))
            own = {"HOME": home, "XDG_CONFIG_HOME": home}
            with viewer(*arguments, port=port, bind="127.0.0.1", log=log, environment=own) as process:
                yield cls(process, port, log, deadline)

    def picture(self, deadline: float, other_than: bytes = b"") -> bytes:
        """Picture of the tab once it is complete.

        Args:
            deadline: latest time, by the monotonic clock.
            other_than: picture of the tab shown before.
        """
        before, shows = b"", "nothing was drawn"
        while self._wait_for_poll(deadline, shows):
            png = self.client.screenshot()
            coloured = count_coloured(png)
            shows = f"{coloured} coloured pixels"
            is_complete = (
                coloured >= LEAST_PIXELS and self.client.is_ready and (not other_than or _differ(png, other_than))
            )
            if is_complete and png == before:
                return png
            before = png
        raise AssertionError("polling continues or raises")

    def _connect(self, port: int, deadline: float) -> "Viewer":
        from docs.pictures.viewer_client import Viewer

        shows = "it did not answer"
        while self._wait_for_poll(deadline, shows):
            try:
                client = Viewer(port)
                if client.is_ready:
                    client.hide_top()
                    return client
            except (ConnectionError, RuntimeError) as error:
                shows = str(error)  # not listening yet
        raise AssertionError("polling continues or raises")

    def _wait_for_poll(self, deadline: float, shows: str) -> bool:
        """Wait until the next poll is due.

        Raises:
            InputError: the viewer has exited, or the deadline has passed.
        """
        if time.monotonic() >= deadline:
            raise InputError(f"no picture: the viewer did not show the plots in time ({shows})")
        try:
            code = self._process.wait(POLL_S)
        except subprocess.TimeoutExpired:
            return True
        cure = "it needs a graphics driver, on Debian mesa-vulkan-drivers libegl1 libgl1 libxkbcommon-x11-0"
        raise InputError(f"no picture: {describe_exit(code, self._log)}; {cure}")


def _differ(one: bytes, other: bytes) -> bool:
    """True if two pictures differ by more than the title of the active tab."""
    return bool((np.abs(_channels(one) - _channels(other)).max(axis=2) >= LEAST_COLOUR).sum() >= LEAST_PIXELS)
