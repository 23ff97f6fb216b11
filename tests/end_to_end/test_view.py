"""The live view, in a browser, of a demonstration that runs."""

import io
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from reactorwatch.runtime.http_pages import free_port
from recorder.panels.base import INPUT, MEASURED, PREDICTED, Colour

from .browser import Browser, browser
from .conftest import PATIENCE_S, REACTORWATCH, Command

LEAST_PIXELS, LEAST_WIDTH = 300, 200
PHONE = (390, 844)


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Browser]:
    with browser(tmp_path / "browser") as opened:
        yield opened


@pytest.fixture
def settings(tmp_path: Path) -> Iterator[Path]:
    """Of a demonstration that runs as long as the test."""
    folder = tmp_path / "run"
    command = [REACTORWATCH, "demo", "--out", str(folder), "--speed", "200", "--duration", "1200"]
    demo = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + PATIENCE_S
    try:
        while not (folder / "settings.toml").is_file():
            assert time.monotonic() < deadline
            with pytest.raises(subprocess.TimeoutExpired):
                demo.wait(0.1)
        yield folder / "settings.toml"
    finally:
        demo.send_signal(signal.SIGINT)
        assert demo.wait(PATIENCE_S) in (0, 130)


def columns_of(png: bytes, colour: Colour) -> NDArray[np.intp]:
    """The columns of the pixels of a colour."""
    with Image.open(io.BytesIO(png)) as image:
        pixels = np.asarray(image.convert("RGB"), np.int16)
    return np.nonzero(np.abs(pixels - np.array(colour)).max(axis=2) <= 40)[1]


def is_plotted(columns: NDArray[np.intp]) -> bool:
    """Whether there is a line, and not only what the legend shows of it."""
    return bool(columns.size >= LEAST_PIXELS and np.ptp(columns) >= LEAST_WIDTH)


def listens(address: str, port: int) -> bool:
    try:
        with socket.create_connection((address, port), timeout=5.0):
            return True
    except OSError:
        return False


@contextmanager
def viewed(settings: Path) -> Iterator[str]:
    """`view --web` of a plant; its address."""
    command = [REACTORWATCH, "view", "--web", "--config", str(settings)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as view:
        try:
            assert view.stdout is not None
            yield view.stdout.readline().removeprefix("open ").strip()
        finally:
            view.send_signal(signal.SIGINT)
            assert view.wait(PATIENCE_S) == 0


@pytest.mark.slow
def test_a_browser_shows_the_lines_of_a_run_while_it_runs(page: Browser, settings: Path) -> None:
    with viewed(settings) as address:
        port = urlsplit(address).port
        assert port is not None
        assert listens("127.0.0.1", port)
        assert not listens("127.0.0.2", port), "it is bound to 127.0.0.1 and nothing else"
        page.go_to(address)
        deadline = time.monotonic() + 2 * PATIENCE_S
        found: dict[str, NDArray[np.intp]] = {}
        while not (found and all(map(is_plotted, found.values()))):
            assert time.monotonic() < deadline, {name: columns.size for name, columns in found.items()}
            png = page.screenshot()
            colours = {"measured": MEASURED, "predicted": PREDICTED, "input": INPUT}
            found = {name: columns_of(png, colour) for name, colour in colours.items()}
        page.resize(*PHONE)
        while np.ptp(columns_of(page.screenshot(), INPUT)) < 0.7 * PHONE[0]:  # a plot has the width of the phone
            assert time.monotonic() < deadline
    assert not listens("127.0.0.1", port), "the viewer ends with the command"


def test_a_port_in_use_is_reported(called: Command) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        done = called("view", "--web", "--port", str(port - 1))  # the data go by the next
    assert done.returncode == 2
    assert f"nothing can listen at 127.0.0.1 port {port}" in done.stderr
    assert "choose another --port" in done.stderr


def test_without_a_screen_there_is_no_window_and_one_line_states_the_remedy(
    called: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    done = called("view")
    assert done.returncode == 2
    assert "--web" in done.stderr
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_a_viewer_that_finds_no_screen_ends_the_command_while_it_waits_for_a_router(
    called: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("DISPLAY", ":4711")
    done = called("view", "--endpoint", f"tcp/127.0.0.1:{free_port()}")
    assert done.returncode == 2
    assert "the viewer ended with code" in done.stderr
    assert "try --web" in done.stderr
    assert "Traceback" not in done.stderr
