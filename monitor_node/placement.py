"""Placement of a fleet's shards on the workers of a Dask cluster (https://distributed.dask.org).

Each shard is a task that runs its monitor as a child process of a worker, until the monitor ends or the worker does:
the monitor ends when its standard input does. A worker has as many shards as it was given of the resource `monitor`,
one by the command that the log shows. The scheduler starts the task of a lost worker on another one. The client submits
again what ends, whatever the reason: a monitor that ended, a task at which too many workers were lost, a scheduler that
came back without tasks.

Tasks outlive a client that dies: they are wanted by Dask's own client `fire-and-forget`, too. A task's key has the
plants, the shard and a digest of the settings, so a client that comes back with the same settings submits tasks that
exist, which does not start them again. Cancelling a task drops it where it waits, and does not stop it where it runs.
So shards are also ended on the workers: those with other settings when a client begins, all when it is stopped.

Two monitors of a shard never work at the same time for long: the second one waits until the liveliness token of the
first has disappeared, and then claims the folder of states, which the first one reads before it publishes (see
`state_files`).
"""

import asyncio
import time
from collections.abc import Awaitable, Collection, Mapping
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import structlog

from monitor_node.fleet import FleetConfig
from monitor_node.shard_task import end_shards, run_shard
from reactorwatch.errors import InputError
from reactorwatch.runtime.config import IDENTITY, BusConfig
from reactorwatch.runtime.event_loop import StopSignal, describe
from reactorwatch.runtime.jobs import CONNECT_WITHIN_S, check_dask, one_line
from reactorwatch.runtime.node_main import SUPERVISED
from reactorwatch.runtime.provisioning import CA, CERTIFICATE, KEY
from reactorwatch.version import version

if TYPE_CHECKING:
    from distributed import Client, Future
    from distributed.security import Security

log = structlog.get_logger()

Answer = TypeVar("Answer")

RESOURCE = "monitor"
"""Dask's name for what a shard takes of a worker."""

ARGUMENTS = ("-P", "-m", "monitor_node", "{settings}", SUPERVISED)
"""Python's arguments for a monitor."""

LOOK_S = 5.0
"""Interval of looks at where the shards run."""

LONGEST_PAUSE_S = 30.0
"""Longest wait before a shard that ends again and again is submitted; the first is a second."""

END_WITHIN_S = 30.0
"""A monitor that is asked to end stores its states and leaves the bus within seconds."""


def cluster_security(fleet: FleetConfig, bus: BusConfig) -> "Security | None":
    """Certificates of a connection to the scheduler: those of `[fleet] identity`, else of the bus; None without any.

    Raises:
        InputError: Dask is not installed, or the address does not fit the certificates.
    """
    check_dask(str(fleet.scheduler))
    from distributed.security import Security

    files = [getattr(bus, name) for name in IDENTITY]
    if fleet.identity is not None:
        files = [str(Path(fleet.identity) / name) for name in (CA, CERTIFICATE, KEY)]
    ca, certificate, key = files
    if str(fleet.scheduler).startswith("tls://") != (ca is not None):
        raise InputError(
            f"a scheduler like tls://127.0.0.1:8786 and certificates, of [fleet] identity or [bus], belong together, "
            f"got {fleet.scheduler} {'without' if ca is None else 'with'} them"
        )
    if ca is None:
        return None
    for file in files:
        if not Path(file).is_file():
            raise InputError(f"the certificates of the scheduler: {file} must be a file that is there")
    return Security(tls_ca_file=ca, tls_client_cert=certificate, tls_client_key=key, require_encryption=True)


def worker_command(address: str) -> str:
    """Command that starts a worker for one shard."""
    return f"dask worker {address} --nthreads 1 --no-nanny --resources {RESOURCE}=1"


def place(fleet: FleetConfig, bus: BusConfig, settings: Mapping[str, str], stop: StopSignal) -> None:
    """Keep the shards of a fleet running on a cluster until a stop is requested, which ends them.

    Args:
        fleet: settings of the fleet.
        bus: settings of the bus.
        settings: text of the settings file of each shard's monitor, by shard, such as `2/5`.
        stop: ends it.

    Raises:
        InputError: Dask is not installed, or the address does not fit the certificates.
    """
    beginning = f"{RESOURCE} {bus.endpoint} {fleet.plants} "
    asyncio.run(_place(str(fleet.scheduler), cluster_security(fleet, bus), beginning, settings, stop))


async def _place(
    address: str, security: "Security | None", beginning: str, settings: Mapping[str, str], stop: StopSignal
) -> None:
    """Connect to the scheduler as often as it takes."""
    from distributed import Client

    changed, loop = asyncio.Event(), asyncio.get_running_loop()

    def on_change(*_: object) -> None:
        loop.call_soon_threadsafe(changed.set)

    stop.call_on_set(on_change)
    options: dict[str, Any] = {"asynchronous": True, "set_as_default": False, "timeout": CONNECT_WITHIN_S}
    before = ""
    while not stop.is_set:
        try:
            async with Client(address, security=security, **options) as client:
                log.info("connected", scheduler=address)
                before = ""
                await _Placement(client, address, beginning, settings, stop, changed).keep()
        except OSError as error:  # also a lost connection, and a refused certificate
            if (reason := describe(error)) != before:
                log.warning("waiting", scheduler=address, why=reason)
                before = reason
            changed.clear()
            if not stop.is_set:
                await _wait(changed, 1.0)


async def _wait(changed: asyncio.Event, timeout_s: float) -> None:
    with suppress(TimeoutError):
        await asyncio.wait_for(changed.wait(), timeout_s)


class _Placement:
    """The shards' tasks, as long as a connection to the scheduler lasts."""

    def __init__(
        self,
        client: "Client",
        address: str,
        beginning: str,
        settings: Mapping[str, str],
        stop: StopSignal,
        changed: asyncio.Event,
    ) -> None:
        self._client: Any = client  # its annotations do not say which of its methods are coroutines here
        self._address, self._beginning = address, beginning
        self._stop, self._changed = stop, changed
        digests = {shard: blake2b(text.encode(), digest_size=8).hexdigest() for shard, text in settings.items()}
        self._shards = {f"{beginning}{shard} {digests[shard]}": shard for shard in settings}
        self._settings = settings
        self._futures: dict[str, Future[Any]] = {}
        self._due_s = dict.fromkeys(self._shards, 0.0)  # time of the next submission
        self._pause_s = dict.fromkeys(self._shards, 1.0)
        self._places: dict[str, str] = {}
        self._look_s = time.monotonic() + LOOK_S  # by then they are placed

    async def keep(self) -> None:
        """Submit what does not run, until a stop is requested.

        Raises:
            OSError: the connection was lost, or the scheduler does not answer.
        """
        # The first worker of a new scheduler would get all shards, which leave it again one by one, seconds later.
        until_s = time.monotonic() + CONNECT_WITHIN_S
        while not self._stop.is_set and time.monotonic() < until_s:
            if len(await self._ask(self._client.nthreads())) >= len(self._shards):
                break
            await _wait(self._changed, 0.2)
        await self._end(self._shards)
        while not self._stop.is_set:
            self._changed.clear()
            now_s = time.monotonic()
            for key in [key for key in self._shards if key not in self._futures and self._due_s[key] <= now_s]:
                self._submit(key)
            if now_s >= self._look_s:
                self._look_s = now_s + LOOK_S
                await self._look()
            await _wait(self._changed, 1.0)
            for key in [key for key, future in self._futures.items() if future.done()]:
                await self._on_end(key, self._futures.pop(key))
            if self._client.status != "running":
                raise ConnectionError("the connection was lost")
        await self._end(())

    def _submit(self, key: str) -> None:
        from distributed import fire_and_forget

        text = self._settings[self._shards[key]]
        future = self._client.submit(run_shard, key, ARGUMENTS, text, version(), key=key, resources={RESOURCE: 1})
        fire_and_forget(future)
        loop = asyncio.get_running_loop()
        future.add_done_callback(lambda _: loop.call_soon_threadsafe(self._changed.set))
        self._futures[key] = future
        self._due_s[key] = time.monotonic()

    async def _on_end(self, key: str, future: "Future[Any]") -> None:
        """Log why a shard ended, and when it is submitted again: at once if it ran for a while."""
        about: dict[str, Any] = {}
        if future.status == "finished":
            with suppress(TimeoutError):
                about = (await asyncio.wait_for(future.result(), LOOK_S))._asdict()
        elif future.status == "error":
            about = {"why": one_line(await future.exception())}
        elif self._client.status != "running":
            return
        future.release()
        now_s, worker = time.monotonic(), self._places.get(key, "")
        pause_s = 1.0 if now_s - self._due_s[key] > 2.0 * LONGEST_PAUSE_S else self._pause_s[key]
        self._pause_s[key] = min(2.0 * pause_s, LONGEST_PAUSE_S)
        self._due_s[key] = now_s + pause_s
        log.warning("ended", shard=self._shards[key], worker=worker, again_in_s=pause_s, **about)

    async def _look(self) -> None:
        """Log shards that have come to another worker, or wait for one."""
        by_worker = await self._ask(self._client.processing())
        places = {key: worker for worker, keys in by_worker.items() for key in keys}
        for key, shard in self._shards.items():
            place = places.get(key, "")
            if place == self._places.get(key, "none yet"):
                continue
            if place:
                log.info("placed", shard=shard, worker=place)
            else:
                log.warning("waiting for a worker", shard=shard, cure=worker_command(self._address))
            self._places[key] = place

    async def _end(self, but: Collection[str]) -> None:
        """End the shards of these plants but for some: those that wait for a worker, then those that run."""
        from distributed import Future

        def waiting(dask_scheduler: Any, beginning: str) -> list[str]:  # pickled by value
            return [key for key in dask_scheduler.tasks if str(key).startswith(beginning)]

        found = await self._ask(self._client.run_on_scheduler(waiting, beginning=self._beginning))
        others: list[Future[Any]] = [Future(key, self._client) for key in found if key not in but]
        await self._client.cancel(others, force=True)
        try:
            ended = self._client.run(end_shards, self._beginning, tuple(but), on_error="ignore")
            await asyncio.wait_for(ended, END_WITHIN_S)
        except TimeoutError:
            log.warning("a worker or the scheduler does not answer, and may still run shards", after_s=END_WITHIN_S)

    async def _ask(self, answer: Awaitable[Answer]) -> Answer:
        """Answer of the scheduler; an OSError if it does not come in time."""
        return await asyncio.wait_for(answer, CONNECT_WITHIN_S)
