"""Worker that diagnoses trainings beside the watch: one process at low priority, which lives while there are jobs."""

import os
import threading
from collections.abc import Iterator, Sequence
from queue import Empty, SimpleQueue
from typing import NamedTuple, TypeVar

from monitor_node.learn.training_diagnosis import FAILED, DiagnosisJob, Finding, diagnose_training
from reactorwatch.limits import limits
from reactorwatch.runtime.jobs import Executor, Failed, ProcessExecutor, one_line, run_job

Item = TypeVar("Item")


class PlantFinding(NamedTuple):
    """A plant and the result of its diagnosis."""

    plant: str
    finding: Finding


def find_deviations(job: DiagnosisJob) -> Finding:
    """Diagnose a training in this process; a failure is a finding, too."""
    return _finding(job, run_job(diagnose_training, job, limits()))


def diagnose_beside(job: DiagnosisJob) -> Finding:
    """Diagnose a training in a process of its own, which gives way to the monitor."""
    os.setpriority(os.PRIO_PROCESS, 0, max(10, os.getpriority(os.PRIO_PROCESS, 0)))
    return diagnose_training(job)


def _finding(job: DiagnosisJob, outcome: Finding | Failed) -> Finding:
    return Finding(job.first_ns, FAILED, outcome.reason) if isinstance(outcome, Failed) else outcome


class DiagnosisWorker:
    """Queue of diagnoses, made one after the other by a thread and its process.

    A diagnosis at which two processes die has failed. An unfinished diagnosis is dropped when the program ends; the
    training's rows are still in the plant's state.
    """

    def __init__(self, executor: Executor | None = None) -> None:
        self._executor = ProcessExecutor(1, retries=1) if executor is None else executor
        self._jobs: SimpleQueue[tuple[str, DiagnosisJob] | None] = SimpleQueue()
        self._findings: SimpleQueue[PlantFinding] = SimpleQueue()
        self._thread: threading.Thread | None = None
        self._outstanding = 0
        self._is_closed = False

    def submit(self, plant: str, job: DiagnosisJob) -> None:
        """Queue the diagnosis of a plant's training."""
        self._outstanding += 1
        self._jobs.put((plant, job))
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="diagnosis of trainings", daemon=True)
            self._thread.start()

    @property
    def is_busy(self) -> bool:
        """True while findings are to be expected."""
        return self._outstanding > 0

    def pop_findings(self) -> list[PlantFinding]:
        """Findings since the last call."""
        found = list(_drain(self._findings))
        self._outstanding -= len(found)
        return found

    def close(self) -> None:
        """End a running diagnosis, and start no further one."""
        self._is_closed = True
        self._jobs.put(None)
        if isinstance(self._executor, ProcessExecutor):
            self._executor.close()
            if self._thread is not None:
                self._thread.join()

    def _work(self) -> None:
        while not self._is_closed:
            first = self._jobs.get()
            self._run([item for item in (first, *_drain(self._jobs)) if item is not None])

    def _run(self, batch: Sequence[tuple[str, DiagnosisJob]]) -> None:
        pending = dict(enumerate(batch))
        try:
            for index, outcome in self._executor.map_unordered(diagnose_beside, [job for _, job in batch]):
                self._add_finding(*pending.pop(index), outcome)
                if self._is_closed:
                    return
        except OSError as error:  # no process can be started
            for item in pending.values():
                self._add_finding(*item, Failed(f"no process can be started: {one_line(error)}"))

    def _add_finding(self, plant: str, job: DiagnosisJob, outcome: Finding | Failed) -> None:
        self._findings.put(PlantFinding(plant, _finding(job, outcome)))


def _drain(queue: "SimpleQueue[Item]") -> Iterator[Item]:
    while True:
        try:
            yield queue.get_nowait()
        except Empty:
            return
