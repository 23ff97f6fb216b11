"""A Dask cluster of this machine, for tests."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def dask_cluster(workers: int) -> Iterator[str]:
    """The address of its scheduler.

    Args:
        workers: how many, each a process.
    """
    distributed = pytest.importorskip("distributed", reason="Dask (reactorwatch[cluster]) is not installed")
    options = {"threads_per_worker": 1, "host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}  # 0: any free port
    with distributed.LocalCluster(n_workers=workers, **options) as running:
        yield running.scheduler_address
