"""Pictures of dashboards, without a screen: Rerun's own viewer draws them, in a process that lives for one dashboard.

There is no moment at which the viewer says that it is done. What can be seen is that nothing is being loaded any more,
that the picture holds coloured lines and not only frames, that it is not that of another tab any more, and that the
next picture is the same.
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
from reactorwatch.records.atomic import atomic_write
from reactorwatch.records.folder import make_folder
from reactorwatch.runtime.loopback import free_port
from recorder.dashboard.file import DIAGNOSIS
from recorder.dashboard.viewer import viewer
from recorder.panels import PANELS

if TYPE_CHECKING:
    from recorder.dashboard.screen import Viewer

DEADLINE_S = 60.0
LOOK_EVERY_S = 0.3
LEAST_COLOUR = 60
"""By how much the channels of a pixel differ at least, when it is of a line: frames and texts are grey."""
LEAST_PIXELS = 500
"""Of that sort, in a picture with plots in it; its buttons have fewer."""


def render_png(rrd: Path, png: Path, width: int = 1600, height: int = 1000, deadline_s: float = DEADLINE_S) -> None:
    """Draw a dashboard as it looks when it is opened.

    Args:
        rrd: the dashboard.
        png: the picture; an older one of that name is replaced.
        width: in pixels.
        height: in pixels.
        deadline_s: how long it may take.

    Raises:
        InputError: there is no such dashboard, the viewer does not run on this machine, or it shows no plots in time.
    """
    deadline = time.monotonic() + deadline_s
    with atomic_write(png) as temporary, _Studio.opened(rrd, width, height, deadline) as studio:
        temporary.write_bytes(studio.picture(deadline))


def render_tabs(
    rrd: Path, folder: Path, width: int = 1600, height: int = 1000, deadline_s: float = DEADLINE_S
) -> list[Path]:
    """Draw every tab of a dashboard.

    Args:
        rrd: the dashboard.
        folder: for the pictures, which are named after the tabs; it is made if it is not there.
        width: in pixels.
        height: in pixels.
        deadline_s: how long each may take.

    Returns:
        The pictures, in the order of the tabs.

    Raises:
        InputError: as `render_png`; or the folder cannot be made.
    """
    make_folder(folder)
    found: list[Path] = []
    deadline = time.monotonic() + deadline_s
    with _Studio.opened(rrd, width, height, deadline) as studio:
        picture = studio.picture(deadline)
        for number, (title, tab) in enumerate(studio.tabs().items()):
            if number:
                studio.open_tab(tab)
                picture = studio.picture(time.monotonic() + deadline_s, other_than=picture)
            path = folder / f"{named_after(title)}.png"
            with atomic_write(path) as temporary:
                temporary.write_bytes(picture)
            found.append(path)
    return found


def picture_names() -> list[str]:
    """The names of the pictures that `render_tabs` may write."""
    return [f"{named_after(title)}.png" for title in (*(panel.title for panel in PANELS), DIAGNOSIS)]


def named_after(title: str) -> str:
    """The name of a file for a tab: `residuals-and-charts`."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def count_coloured(png: bytes) -> int:
    """How many pixels of a picture are those of coloured lines."""
    channels = _channels(png)
    return int((channels.max(axis=2) - channels.min(axis=2) >= LEAST_COLOUR).sum())


def _channels(png: bytes) -> NDArray[np.int16]:
    """Shape (height, width, 3)."""
    from PIL import Image

    with Image.open(io.BytesIO(png)) as image:
        return np.asarray(image.convert("RGB"), np.int16)


class _Studio:
    """A viewer without a screen that shows a dashboard.

    Args:
        process: the viewer's.
        port: that it listens at.
        log: what it says.
        deadline: when it is to answer at the latest, by the monotonic clock.
    """

    def __init__(self, process: subprocess.Popen[bytes], port: int, log: Path, deadline: float) -> None:
        self._process, self._log = process, log
        self._client = self._connected(port, deadline)

    @classmethod
    @contextmanager
    def opened(cls, rrd: Path, width: int, height: int, deadline: float) -> "Iterator[_Studio]":
        """One with settings of nobody's; it ends with the context."""
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
        """What it shows once all is there.

        Args:
            deadline: until when, by the monotonic clock.
            other_than: a picture of something else, shown before.
        """
        before, shows = b"", "nothing was drawn"
        while self._goes_on(deadline, shows):
            png = self._client.screenshot()
            coloured = count_coloured(png)
            shows = f"{coloured} coloured pixels"
            whole = coloured >= LEAST_PIXELS and self._client.is_ready and (not other_than or _differ(png, other_than))
            if whole and png == before:
                return png
            before = png
        raise AssertionError("it goes on or raises")

    def tabs(self) -> dict[str, str]:
        """See `Viewer.tabs`."""
        return self._client.tabs

    def open_tab(self, tab: str) -> None:
        """See `Viewer.open_tab`."""
        self._client.open_tab(tab)

    def _connected(self, port: int, deadline: float) -> "Viewer":
        from recorder.dashboard.screen import Viewer

        shows = "it did not answer"
        while self._goes_on(deadline, shows):
            try:
                client = Viewer(port)
                if client.is_ready:
                    client.hide_top()
                    return client
            except (ConnectionError, RuntimeError) as error:
                shows = str(error)  # not listening yet
        raise AssertionError("it goes on or raises")

    def _goes_on(self, deadline: float, shows: str) -> bool:
        """Wait until it is time for another look.

        Raises:
            InputError: the viewer has ended, or the time is over.
        """
        if time.monotonic() >= deadline:
            raise InputError(f"no picture: the viewer did not show the plots in time ({shows})")
        try:
            code = self._process.wait(LOOK_EVERY_S)
        except subprocess.TimeoutExpired:
            return True
        said = self._log.read_text(errors="replace").strip().splitlines()
        raise InputError(
            f"no picture: the viewer ended with code {code}: {said[-1] if said else 'it did not say why'}; it needs a "
            f"graphics driver, on Debian mesa-vulkan-drivers libegl1 libgl1 libxkbcommon-x11-0"
        )


def _differ(one: bytes, other: bytes) -> bool:
    """Whether two pictures differ by more than the name of the tab in front."""
    return bool((np.abs(_channels(one) - _channels(other)).max(axis=2) >= LEAST_COLOUR).sum() >= LEAST_PIXELS)
