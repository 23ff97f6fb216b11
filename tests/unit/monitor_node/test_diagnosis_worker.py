"""Trainings are diagnosed beside the watch, one after the other; a failure is a finding."""

import errno
import time
from array import array
from collections.abc import Callable, Generator, Sequence
from typing import Any

import pytest

from monitor_node.diagnosis_worker import DiagnosisWorker, PlantFinding
from monitor_node.learn.process_reference import ProcessReference
from monitor_node.learn.training_diagnosis import FAILED, DiagnosisJob, read_equations
from monitor_node.learn.training_rows import TrainingRows
from monitor_node.node import MonitorNode
from reactorwatch.contract.codec import Publication
from reactorwatch.diagnosis.result import NAMED
from reactorwatch.runtime.jobs import SerialExecutor

from ...running import WITHIN_S
from .warm_plant import CONFIG, LATE, TRAINED, Run, changes

SHORT = DiagnosisJob(
    TrainingRows([2, 2], array("q", [7, 8]), array("d", [1.0] * 6)),
    ("qc", "C", "T"),
    '{"format": "reactorwatch.model.v1", "model": "cstr"}',
)


def has_preparation(node: MonitorNode) -> bool:
    return node.preparation is not None


def wait_for_findings(worker: DiagnosisWorker) -> list[PlantFinding]:
    until_s, found = time.monotonic() + WITHIN_S, list[PlantFinding]()
    while worker.is_busy:
        assert time.monotonic() < until_s
        found += worker.pop_findings()
    return found


def test_a_training_that_cannot_be_diagnosed_is_a_finding_and_the_next_is_diagnosed() -> None:
    worker = DiagnosisWorker(SerialExecutor())
    for name in ("a", "b"):
        worker.submit(name, SHORT)
    found = wait_for_findings(worker)
    worker.close()
    assert [item.plant for item in found] == ["a", "b"]
    for _, finding in found:
        assert (finding.first_ns, finding.verdict, finding.equations) == (7, FAILED, "")
        assert finding.why == "training: a diagnosis needs at least 200 rows, got 2; record for longer"


class NoProcess(SerialExecutor):
    """An executor on a machine that has no room for another process."""

    def map_unordered(self, work: Callable[[Any], Any], jobs: Sequence[Any]) -> Generator[tuple[int, Any]]:
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")


def test_where_no_process_can_be_started_each_diagnosis_has_failed_and_the_next_is_tried() -> None:
    worker = DiagnosisWorker(NoProcess())
    for name in ("a", "b"):
        worker.submit(name, SHORT)
        ((plant, finding),) = wait_for_findings(worker)
        assert (plant, finding.verdict) == (name, FAILED)
        assert finding.why == "no process can be started: [Errno 11] Resource temporarily unavailable"
    worker.close()


@pytest.mark.slow
def test_a_live_monitor_continues_while_its_training_is_diagnosed_and_changes_the_model_at_the_next_row(
    warm: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("monitor_node.node.DiagnosisWorker", lambda: DiagnosisWorker(SerialExecutor()))
    node, published = MonitorNode(CONFIG, 0), list[Publication]()
    for message in warm.messages[:TRAINED]:
        published += node.on_message(message, 0)
    monitor = node.monitor(CONFIG.plant)
    assert not node._worker.is_busy
    assert monitor.pipeline.baselines.equations is monitor.pipeline.model
    for message in warm.messages[TRAINED:LATE]:
        published += node.on_message(message, 0)
    assert monitor.rows == LATE // 3
    assert not changes(published)
    now_ns, until_s = 0, time.monotonic() + 5.0 * WITHIN_S  # a diagnosis computes for two seconds on an idle machine
    while monitor.pipeline.baselines.update.is_pending:
        assert time.monotonic() < until_s
        assert node.next_tick_ns() <= now_ns + 100_000_000  # it looks for the finding soon
        now_ns += 100_000_000
        published += node.on_tick(now_ns)
    assert has_preparation(node)  # for looks for causes with the extended model
    for message in warm.messages[LATE : LATE + 30]:
        published += node.on_message(message, now_ns)
    node.on_stop(now_ns)
    (change,) = changes(published)
    assert change == changes(warm.published)[0]
    assert warm.finding.verdict == NAMED
    assert not node._worker.is_busy
    reference = monitor.pipeline.evaluation.reference
    assert isinstance(reference, ProcessReference)
    assert (
        reference.model is monitor.pipeline.baselines.equations is read_equations(change.model, monitor.pipeline.model)
    )  # the one that was prepared
