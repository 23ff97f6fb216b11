"""Functions over many inputs: in this process, in others of this machine, or on a Dask cluster."""

from reactorwatch.errors import InputError
from reactorwatch.runtime.parallel.jobs import Executor, SerialExecutor


def choose_executor(processes: int | None = None, scheduler: str | None = None) -> Executor:
    """Choose an executor.

    Args:
        processes: number of processes on this machine; None: one for each core that this process may use. One: this
            process.
        scheduler: address of a Dask cluster's scheduler, such as `tcp://127.0.0.1:8786`; None: this machine.

    Raises:
        InputError: both are given, there are no processes, or there is no such cluster.
    """
    if scheduler is not None:
        if processes is not None:
            raise InputError("--jobs is for this machine, and --scheduler for a cluster; give one of them")
        from reactorwatch.runtime.parallel.dask_workers import DaskExecutor

        return DaskExecutor(scheduler)
    from reactorwatch.runtime.parallel.process_pool import ProcessExecutor, available_cores

    if processes is None:
        processes = available_cores()
    if processes < 1:
        raise InputError(f"--jobs must be at least 1, got {processes}")
    return SerialExecutor() if processes == 1 else ProcessExecutor(processes)
