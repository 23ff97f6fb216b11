"""Task that runs the monitor of a shard on a worker of a Dask cluster.

Scheduler and workers import this module in their event loops, and the scheduler takes a worker whose loop stands still
for lost. So it imports nothing that takes time.
"""

import asyncio
import os
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import Collection, Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from reactorwatch.errors import InputError
from reactorwatch.version import version


class RunningShard:
    """A task of this worker: its monitor's process once it has started, and whether it has to end."""

    def __init__(self) -> None:
        self.process: Process | None = None
        self.is_ending = False
        self.ended = asyncio.Event()

    def end(self) -> None:
        """Ask the monitor to end, at once or as soon as it has started."""
        self.is_ending = True
        if self.process is not None and self.process.stdin is not None:
            self.process.stdin.close()


_running: dict[str, RunningShard] = {}
"""Tasks of this worker, by key."""


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
    shard = _running[key] = RunningShard()
    try:
        with TemporaryDirectory(prefix="reactorwatch-") as folder:
            path = Path(folder) / "settings.toml"
            path.write_text(settings, encoding="utf-8")
            command = (sys.executable, *(argument.format(settings=path) for argument in arguments))
            process = await asyncio.create_subprocess_exec(*command, stdin=PIPE, stderr=PIPE)
            shard.process = process
            if shard.is_ending:
                shard.end()
            assert process.stderr is not None
            tail = bytearray()
            try:
                await _copy_log(process.stderr, tail)
            finally:  # also if the worker closes
                shard.end()
                code = await process.wait()
    finally:
        shard.ended.set()
        if _running.get(key) is shard:
            del _running[key]
    lines = tail.decode(errors="replace").split("\n")
    return Ended(code, next((line for line in reversed(lines) if line.strip()), ""))


async def _copy_log(stream: asyncio.StreamReader, tail: bytearray) -> None:
    """Write the log of a monitor to that of its worker, and keep its end; a full disk ends neither."""
    while block := await stream.read(65_536):
        with suppress(OSError):
            os.write(sys.stderr.fileno(), block)
        tail += block
        del tail[:-4096]


async def end_shards(beginning: str, but: Collection[str] = ()) -> None:
    """End the monitors of this worker whose key has a beginning, but for some; this runs on each worker."""
    ending = [shard for key, shard in _running.items() if key.startswith(beginning) and key not in but]
    for shard in ending:
        shard.end()
    await asyncio.gather(*(shard.ended.wait() for shard in ending))
