"""Modes of a plant and diagnoses of their trainings: each mode keeps the equations by which it was learned."""

from collections.abc import Callable
from dataclasses import replace

import msgspec
import pytest

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.learn.training_diagnosis import DiagnosisJob, Finding
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode, encode_message
from reactorwatch.contract.messages_pb2 import BaselineCommand, Quality, Sample
from reactorwatch.diagnosis.result import NOMINAL
from reactorwatch.kalman.filter_states import WANDER
from reactorwatch.process.extended_model import parse_extended_model
from reactorwatch.records.record import to_time_ns

from ..samples import PLANT, leaking_run, samples

CONFIG = MonitorConfig(training_min=60.0, reference="equations", modes=("mode",), isolation=False)
WANDERS = f"{WANDER} T"
RUN, CLEAN = 1.0, 2.0
CHANGES = {0: RUN, 200: CLEAN, 400: RUN, 900: CLEAN, 1000: RUN}
"""Mode by its first row: the training ends in RUN, and CLEAN is learned from its rows of the training."""


def find_wander(job: DiagnosisJob) -> Finding:
    """A finding by which a disturbance wanders beside the equations."""
    model = replace(parse_extended_model(job.equations), uncertain=(WANDERS,))
    return Finding(job.first_ns, "named", "T wanders", msgspec.json.encode(model.to_object()).decode())


def find_nothing(job: DiagnosisJob) -> Finding:
    """A finding that leaves the equations as they are."""
    return Finding(job.first_ns, NOMINAL, "the training agrees with the equations")


class Run:
    """A plant of two modes, row by row."""

    def __init__(self, diagnose: Callable[[DiagnosisJob], Finding] | None = None) -> None:
        self.monitor, self.row = Monitor(CONFIG, 0, points=False, diagnose=diagnose), 0
        self._samples = list(samples(*leaking_run(-0.1, 500.0, 130.0, seed=1)))

    def take_until(self, end: int) -> "Run":
        for row in range(self.row, end):
            if row in CHANGES:
                sample = Sample(time_ns=to_time_ns(row / 10) - 1, value=CHANGES[row], quality=Quality.QUALITY_GOOD)
                self.monitor.on_message(encode(Publication(keys.key(PLANT, keys.SAMPLE, "mode"), sample)), 0)
            for item in self._samples[3 * row : 3 * row + 3]:
                self.monitor.on_message(item, 0)
        self.row = end
        return self

    def command(self, what: str) -> None:
        command = BaselineCommand(what=what, by="Anna", why="the cleaning has changed")
        key = keys.key(PLANT, keys.COMMAND, "baseline")
        assert self.monitor.on_command(Encoded(key, *encode_message(command)), 0)[0].accepted

    def resume(self) -> None:
        other = Monitor(CONFIG, 0, points=False)
        other.from_bytes(self.monitor.to_bytes())
        other.on_history_end()
        self.monitor = other

    def uncertain(self) -> tuple[str, ...]:
        """States beside those of the equations in the reference in force."""
        reference = self.monitor.pipeline.evaluation.reference
        assert reference is not None
        assert reference.plant is not None
        return reference.plant.equations.uncertain


@pytest.fixture
def diagnosed() -> Run:
    """A run in CLEAN, whose training agrees with the equations; that of RUN did not."""
    findings = [find_wander, find_nothing]
    run = Run(lambda job: findings.pop(0)(job)).take_until(800)
    assert run.uncertain() == (WANDERS,)
    run.take_until(950)
    assert not findings
    assert run.uncertain() == ()
    return run


def test_a_resumed_monitor_judges_by_the_equations_of_the_mode_not_of_the_newest_change(diagnosed: Run) -> None:
    diagnosed.resume()
    assert diagnosed.uncertain() == ()
    assert diagnosed.monitor.pipeline.baselines.equations is diagnosed.monitor.pipeline.model
    diagnosed.take_until(1050)
    assert diagnosed.uncertain() == (WANDERS,)
    diagnosed.resume()
    assert diagnosed.uncertain() == (WANDERS,)


def test_a_replaced_baseline_is_restored_with_the_equations_of_its_mode(diagnosed: Run) -> None:
    diagnosed.command("relearn")
    diagnosed.take_until(960)
    assert not diagnosed.monitor.pipeline.watching
    diagnosed.resume()
    diagnosed.command("restore")
    diagnosed.take_until(970)
    assert diagnosed.uncertain() == ()
    assert [item.id for item in diagnosed.monitor.pipeline.baselines.all] == [1, 3]


def test_a_diagnosis_that_ends_after_the_plant_changed_its_mode_changes_no_baseline() -> None:
    run = Run().take_until(950)
    baselines = run.monitor.pipeline.baselines
    job = baselines.diagnosis_job
    assert job is not None
    assert job.first_ns == to_time_ns(20.0), "the training of CLEAN"
    run.take_until(1010)
    assert [note for note in run.monitor.notes if "the plant changed its mode before the end" in note]
    assert baselines.diagnosis_job is None
    baselines.on_finding(find_wander(job))
    run.take_until(1050)
    assert run.uncertain() == ()
    assert run.monitor.baseline is None
