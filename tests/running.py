"""Run a function in a thread while a test talks to it, and mount a small disk for it to fill."""

import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from reactorwatch.runtime.event_loop import StopSignal

WITHIN_S = 60.0

Command = Callable[..., subprocess.CompletedProcess[str]]
"""Runs `reactorwatch` with arguments to its end."""


@contextmanager
def running(work: Callable[[], object], stop: StopSignal) -> Iterator[None]:
    """Something in a thread; it is asked to stop at the end and must then end."""
    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(WITHIN_S)
    assert not thread.is_alive()


@contextmanager
def mount_small_disk(folder: Path, size: str) -> Iterator[Path]:
    """A new folder on a disk of its own, whose size is written as for `mount`; skips without the right to mount one."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a disk of its own")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)
