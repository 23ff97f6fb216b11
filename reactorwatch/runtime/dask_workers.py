"""Jobs on a Dask cluster (https://distributed.dask.org), the only file that knows of it: `reactorwatch[cluster]`.

The workers see the files under the same paths as this process, and have the same version of this software, which
`DaskExecutor` checks. Dask's scheduler retries the job of a dead worker by itself,
`distributed.scheduler.allowed-failures` times (3 by default). But it also counts the death for every job that waits at
that worker, so a job that it gives up gets a last run when it has the cluster to itself.
"""

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any

from reactorwatch.errors import InputError
from reactorwatch.limits import limits
from reactorwatch.runtime.jobs import Failed, Job, Result, internal_error, one_line, run_job, worker_death
from reactorwatch.version import version as own_version

CONNECT_WITHIN_S = 10.0
WORKERS_WITHIN_S = 60.0  # a worker on a busy machine takes half a minute to start

ASK_AGAIN_S = 0.2


class DaskExecutor:
    """Runs jobs on the workers of a cluster.

    Args:
        address: address of its scheduler, such as `tcp://127.0.0.1:8786`.

    Raises:
        InputError: Dask is not installed, or the address is malformed.
    """

    def __init__(self, address: str) -> None:
        try:
            import distributed  # noqa: F401
        except ImportError as missing:
            raise InputError("--scheduler needs Dask: pip install 'reactorwatch[cluster]'") from missing
        if "://" not in address:
            raise InputError(f"--scheduler must be an address like tcp://127.0.0.1:8786, got {address!r}")
        self._address = address

    def map_unordered(
        self, work: Callable[[Job], Result], jobs: Sequence[Job]
    ) -> Generator[tuple[int, Result | Failed]]:
        """See `Executor`.

        Raises:
            InputError: there is no scheduler, it has no workers, or they have another version of this software.
        """
        from distributed import Client
        from distributed.scheduler import KilledWorker

        try:
            connection = Client(self._address, timeout=CONNECT_WITHIN_S, set_as_default=False)
        except (OSError, ValueError) as unreachable:
            text = one_line(unreachable)
            raise InputError(f"--scheduler {self._address}: cannot be reached: {text}") from unreachable
        with connection as client:
            _check_workers(client, self._address)
            indices = {client.submit(run_job, work, job, limits(), pure=False): index for index, job in enumerate(jobs)}
            suspects: list[int] = []
            for future in self._in_completion_order(client, list(indices)):
                index = indices.pop(future)
                if isinstance(future.exception(), KilledWorker):
                    suspects.append(index)
                else:
                    yield index, _outcome(future)
            for index in suspects:
                (alone,) = self._in_completion_order(
                    client, [client.submit(run_job, work, jobs[index], limits(), pure=False)]
                )
                error = alone.exception()
                killed = isinstance(error, KilledWorker)
                yield index, worker_death(error.allowed_failures + 1) if killed else _outcome(alone)

    def _in_completion_order(self, client: Any, futures: list[Any]) -> Iterator[Any]:
        """Yield futures as they complete."""
        from distributed import as_completed

        pending = set(futures)
        while pending:
            try:
                for future in as_completed(list(pending), loop=client.loop, timeout=WORKERS_WITHIN_S):
                    pending.discard(future)
                    yield future
            except TimeoutError:  # also if jobs just take long
                _wait_for_workers(client, self._address)


def _outcome(future: Any) -> Any:
    """Result of a job whose worker lives."""
    error = future.exception()
    if error is not None:  # no error of the job, those are results: it could not be sent or read
        return internal_error(error)
    return future.result()


def _check_workers(client: Any, address: str) -> None:
    versions: dict[str, Any] = {}
    deadline_s = time.monotonic() + WORKERS_WITHIN_S
    while not versions and time.monotonic() < deadline_s:
        _wait_for_workers(client, address)
        replies = client.run(_version_query(), on_error="return")
        # A worker that died meanwhile costs a retry of its jobs; if all did, others are starting.
        versions = {worker: version for worker, version in replies.items() if not isinstance(version, OSError)}
        if not versions:
            time.sleep(ASK_AGAIN_S)  # the scheduler still lists dead workers
    for worker, version in versions.items():
        if isinstance(version, Exception):
            raise version
        if version is None:
            raise InputError(
                f"--scheduler {address}: worker {worker} has no reactorwatch; install {own_version()} there"
            )
        if version != own_version():
            raise InputError(
                f"--scheduler {address}: worker {worker} has reactorwatch {version}, this is {own_version()}; "
                "install the same"
            )


def _wait_for_workers(client: Any, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=WORKERS_WITHIN_S)
    except TimeoutError as error:
        raise InputError(
            f"--scheduler {address}: has no workers; start some with: dask worker {address} --nthreads 1"
        ) from error


def _version_query() -> Callable[[], str | None]:
    """Function that is pickled by value: a worker that cannot find a function by its name never answers."""

    def installed_version() -> str | None:
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version("reactorwatch")
        except PackageNotFoundError:
            return None

    return installed_version
