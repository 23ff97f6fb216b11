"""Task that runs the monitor of a shard on a worker of a Dask cluster.

Scheduler and workers import this module in their event loops, and the scheduler takes a worker whose loop stands still
for lost. So it imports nothing that takes time.
"""

import asyncio
import os
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import Collection, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from reactorwatch.errors import InputError
from reactorwatch.version import version

_running: dict[str, Process] = {}
"""Monitors of this worker, by key of the task."""


class Ended(NamedTuple):
    """End of a shard's monitor: its exit code, and its last line on standard error."""

    exit_code: int
    why: str


async def run_shard(key: str, arguments: Sequence[str], settings: str, client_version: str) -> Ended:
    """Run the monitor of a shard until it ends or the worker does; this is a task on a worker.

    Args:
        key: key of the task.
        arguments: arguments of Python, in which `{settings}` is the path of the settings file. The monitor ends when
            its standard input does.
        settings: text of the settings file.
        client_version: version of this software at the client.

    Raises:
        InputError: the worker has another version of this software.
    """
    if version() != client_version:
        raise InputError(f"the worker has reactorwatch {version()}, the command {client_version}; install the same")
    with TemporaryDirectory(prefix="reactorwatch-") as folder:
        path = Path(folder) / "settings.toml"
        path.write_text(settings, encoding="utf-8")
        command = (sys.executable, *(argument.format(settings=path) for argument in arguments))
        process = await asyncio.create_subprocess_exec(*command, stdin=PIPE, stderr=PIPE)
        _running[key] = process
        assert process.stdin is not None
        assert process.stderr is not None
        tail = b""
        try:
            while block := await process.stderr.read(65_536):
                os.write(sys.stderr.fileno(), block)  # its log is the worker's
                tail = (tail + block)[-4096:]
        finally:  # also if the worker closes
            process.stdin.close()
            code = await process.wait()
            del _running[key]
    lines = tail.decode(errors="replace").split("\n")
    return Ended(code, next((line for line in reversed(lines) if line.strip()), ""))


async def end_shards(beginning: str, but: Collection[str] = ()) -> None:
    """End the monitors of this worker whose key has a beginning, but for some; this runs on each worker."""
    ending = [process for key, process in _running.items() if key.startswith(beginning) and key not in but]
    for process in ending:
        assert process.stdin is not None
        process.stdin.close()
    await asyncio.gather(*(process.wait() for process in ending))
