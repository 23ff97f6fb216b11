"""Rerun's viewer as a process of ours: on loopback unless asked, and ended with the context."""

import os
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from reactorwatch.errors import InputError

END_WITHIN_S = 5.0


def viewer_program() -> Path:
    """The viewer itself; the command `rerun` is a script that starts it, and does not end it when it is ended."""
    package = find_spec("rerun_cli")
    if package is None or package.origin is None:
        raise InputError("no picture: this build of rerun comes without its viewer; install rerun-sdk from PyPI")
    return Path(package.origin).with_name("rerun")


@contextmanager
def viewer(
    *arguments: str, port: int, bind: str, log: Path, environment: Mapping[str, str] | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """A viewer's process.

    Args:
        arguments: of its command line.
        port: that it listens at for what to show.
        bind: the address that it listens on.
        log: where what it says goes.
        environment: variables beside our own.
    """
    command = [str(viewer_program()), "--bind", bind, "--port", str(port), "--hide-welcome-screen", *arguments]
    with log.open("wb") as output:
        process = subprocess.Popen(  # noqa: S603 (the program is Rerun's own, the arguments are paths and numbers)
            command,
            # without the level, what the viewer logs lies over the picture for some seconds
            env={**os.environ, "RUST_LOG": "error", **(environment or {})},
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
