"""Jobs on a Dask cluster (https://distributed.dask.org), the only file that knows of it: `reactorwatch[cluster]`.

The workers see the files under the same names as we do, and have this software in the same version; `DaskWorkers` holds
the latter. That a worker which dies costs a retry is what Dask's scheduler does by itself: it gives the job to another,
`distributed.scheduler.allowed-failures` times (3, unless the cluster is told otherwise). But it suspects all jobs that
wait at the worker as well, so one that is given up gets a last chance when it has the cluster to itself.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from reactorwatch import __version__
from reactorwatch.errors import InputError
from reactorwatch.runtime.parallel.jobs import Failed, attempt, died, fault, one_line

CONNECT_WITHIN_S = 10.0
WORKERS_WITHIN_S = 60.0  # a worker on a busy machine takes half a minute to start

ASK_AGAIN_S = 0.2

Job = TypeVar("Job")
Result = TypeVar("Result")


class DaskWorkers:
    """The workers of a cluster.

    Args:
        address: of its scheduler, such as `tcp://127.0.0.1:8786`.

    Raises:
        InputError: Dask is not installed, or the address is none.
    """

    def __init__(self, address: str) -> None:
        try:
            import distributed  # noqa: F401
        except ImportError as missing:
            raise InputError("--scheduler needs Dask: pip install 'reactorwatch[cluster]'") from missing
        if "://" not in address:
            raise InputError(f"--scheduler must be an address like tcp://127.0.0.1:8786, got {address!r}")
        self._address = address

    def outcomes(self, work: Callable[[Job], Result], jobs: Sequence[Job]) -> Iterator[tuple[int, Result | Failed]]:
        """As `Workers` has it.

        Raises:
            InputError: there is no scheduler, it has no workers, or they have another version of this software.
        """
        from distributed.scheduler import KilledWorker

        with _client(self._address) as client:
            _check_workers(client, self._address)
            numbers = {client.submit(attempt, work, job, pure=False): number for number, job in enumerate(jobs)}
            suspected: list[int] = []
            for future in self._as_done(client, list(numbers)):
                number = numbers.pop(future)
                if isinstance(future.exception(), KilledWorker):
                    suspected.append(number)
                else:
                    yield number, _outcome(future)
            for number in suspected:
                (alone,) = self._as_done(client, [client.submit(attempt, work, jobs[number], pure=False)])
                error = alone.exception()
                yield number, died(error.allowed_failures + 1) if isinstance(error, KilledWorker) else _outcome(alone)

    def _as_done(self, client: Any, futures: list[Any]) -> Iterator[Any]:
        """Futures as they are done.

        Raises:
            InputError: the cluster has lost all its workers, and nothing starts others.
        """
        from distributed import as_completed

        left = set(futures)
        while left:
            try:
                for future in as_completed(list(left), loop=client.loop, timeout=WORKERS_WITHIN_S):
                    left.discard(future)
                    yield future
            except TimeoutError:  # also where jobs just take long
                _wait_for_workers(client, self._address)


def _outcome(future: Any) -> Any:
    """What came of a job whose worker lives."""
    error = future.exception()
    if error is not None:  # not of the job, whose errors are outcomes: it could not be sent, or not be read
        return fault(error)
    return future.result()


@contextmanager
def _client(address: str) -> Iterator[Any]:
    from distributed import Client

    try:
        client = Client(address, timeout=CONNECT_WITHIN_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {address}: cannot be reached: {one_line(error)}") from error
    with client:
        yield client


def _check_workers(client: Any, address: str) -> None:
    versions: dict[str, Any] = {}
    deadline_s = time.monotonic() + WORKERS_WITHIN_S
    while not versions and time.monotonic() < deadline_s:
        _wait_for_workers(client, address)
        asked = client.run(_asks_for_version(), on_error="return")
        # A worker that died meanwhile costs a retry of its jobs; if all did, others are being started.
        versions = {worker: version for worker, version in asked.items() if not isinstance(version, OSError)}
        if not versions:
            time.sleep(ASK_AGAIN_S)  # the scheduler still knows those that died
    for worker, version in versions.items():
        if isinstance(version, Exception):
            raise version
        if version is None:
            raise InputError(f"--scheduler {address}: worker {worker} has no reactorwatch; install {__version__} there")
        if version != __version__:
            raise InputError(
                f"--scheduler {address}: worker {worker} has reactorwatch {version}, this is {__version__}; "
                "install the same"
            )


def _wait_for_workers(client: Any, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=WORKERS_WITHIN_S)
    except TimeoutError as error:
        raise InputError(
            f"--scheduler {address}: has no workers; start some with: dask worker {address} --nthreads 1"
        ) from error


def _asks_for_version() -> Callable[[], str | None]:
    """A function that is sent as it is, and not by its name: a worker that cannot find a name never answers."""

    def version() -> str | None:
        try:
            import reactorwatch
        except ImportError:
            return None
        return reactorwatch.__version__

    return version
