"""Run the Rerun viewer as a child process, on loopback by default."""

import os
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from reactorwatch.errors import InputError

EXIT_TIMEOUT_S = 5.0


def viewer_program() -> Path:
    """Path of the viewer; the command `rerun` is a script that does not terminate the viewer with itself."""
    package = find_spec("rerun_cli")
    if package is None or package.origin is None:
        raise InputError("no picture: this build of rerun comes without its viewer; install rerun-sdk from PyPI")
    return Path(package.origin).with_name("rerun")


def describe_exit(code: int, log: Path) -> str:
    """Text about a viewer that has exited, with the last line of its output."""
    lines = log.read_text(errors="replace").strip().splitlines()
    return f"the viewer ended with code {code}: {lines[-1] if lines else 'without a message'}"


@contextmanager
def viewer(
    *arguments: str, port: int, bind: str, log: Path, environment: Mapping[str, str] | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a viewer within the context.

    Args:
        arguments: arguments of its command line.
        port: port for data.
        bind: address to listen on.
        log: file for its output.
        environment: additional environment variables.
    """
    command = [str(viewer_program()), "--bind", bind, "--port", str(port), "--hide-welcome-screen", *arguments]
    with log.open("wb") as output:
        process = subprocess.Popen(  # noqa: S603 (the program is Rerun's own, the arguments are paths and numbers)
            command,
            # without the level, log lines of the viewer cover the picture for some seconds
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
                process.wait(EXIT_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
