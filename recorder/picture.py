"""Pictures of dashboards, without a screen: Rerun's own viewer draws them, in a process that lives for one picture.

There is no moment at which the viewer says that it is done. What can be seen is that nothing is being loaded any more,
that the picture holds coloured lines and not only frames, and that the next picture is the same.
"""

import io
import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reactorwatch.errors import InputError
from reactorwatch.records.atomic import replacing
from reactorwatch.runtime.loopback import free_port

if TYPE_CHECKING:
    from recorder.rerun_file import Viewer

LOOK_EVERY_S = 0.3
END_WITHIN_S = 5.0
LEAST_COLOUR = 60
"""By how much the channels of a pixel differ at least, when it is of a line: frames and texts are grey."""
LEAST_PIXELS = 500
"""Of that sort, in a picture with plots in it; its buttons have fewer."""


def render_png(rrd: Path, png: Path, width: int = 1600, height: int = 1000, deadline_s: float = 60.0) -> None:
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
    if not rrd.is_file():
        raise InputError(f"{rrd}: there is no such file")
    with replacing(png) as temporary, tempfile.TemporaryDirectory() as home:
        log = Path(home) / "viewer.log"
        port = free_port()
        with _viewer(rrd, port, f"{width}x{height}", Path(home), log) as process:
            temporary.write_bytes(_picture(process, port, log, time.monotonic() + deadline_s))


def count_coloured(png: bytes) -> int:
    """How many pixels of a picture are those of coloured lines."""
    from PIL import Image

    with Image.open(io.BytesIO(png)) as image:
        channels = np.asarray(image.convert("RGB"), np.int16)
    return int((channels.max(axis=2) - channels.min(axis=2) >= LEAST_COLOUR).sum())


@contextmanager
def _viewer(rrd: Path, port: int, size: str, home: Path, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """The viewer's process, on loopback, with settings of nobody's."""
    from recorder.rerun_file import viewer_program

    command = [str(viewer_program()), "--headless", "--hide-welcome-screen", "--bind", "127.0.0.1", "--port", str(port)]
    # without the level, what the viewer logs lies over the picture for some seconds
    environment = {**os.environ, "HOME": str(home), "XDG_CONFIG_HOME": str(home), "RUST_LOG": "error"}
    with log.open("wb") as output:
        process = subprocess.Popen(  # noqa: S603 (the program is Rerun's own, the arguments are a path and numbers)
            [*command, "--window-size", size, str(rrd)],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
        )
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(END_WITHIN_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _picture(process: subprocess.Popen[bytes], port: int, log: Path, deadline: float) -> bytes:
    from recorder.rerun_file import connect_viewer

    client: Viewer | None = None
    bare = False
    before = b""
    shows = "it did not answer"
    while time.monotonic() < deadline:
        try:
            if client is None:
                client = connect_viewer(port)
            state = client.get_state()
            if state.views and not bare:
                client.run_command("ui.toggle_top_panel")  # it warns of slow drawing, which is no matter here
                bare = True
            png = client.take_screenshot()
        except (ConnectionError, RuntimeError) as error:
            client, shows = None, str(error)  # not listening yet
        else:
            coloured = count_coloured(png)
            shows = f"{coloured} coloured pixels"
            if bare and not state.loading and coloured >= LEAST_PIXELS and png == before:
                return png
            before = png
        try:
            code = process.wait(LOOK_EVERY_S)
        except subprocess.TimeoutExpired:
            continue
        said = log.read_text(errors="replace").strip().splitlines()
        raise InputError(
            f"no picture: the viewer ended with code {code}: {said[-1] if said else 'it did not say why'}; it needs a "
            f"graphics driver, on Debian mesa-vulkan-drivers libegl1 libgl1 libxkbcommon-x11-0"
        )
    raise InputError(f"no picture: the viewer did not show the plots in time ({shows})")
