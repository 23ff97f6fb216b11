"""Change of the model that a plant is judged by, after the diagnosis of its training.

The rows of the training are kept until it has been diagnosed. A change holds from one row on: the next one, or the one
that a recording names. From the same rows the baseline is learned again with the new model, so a replay learns the
same.
"""

from collections import deque
from typing import NamedTuple

from monitor_node.baseline.arx_fit import arx_structure
from monitor_node.baseline.commands import is_command
from monitor_node.baseline.predictor import ArxPredictor
from monitor_node.baseline.process_reference import ProcessReference
from monitor_node.baseline.training import Training, TrainingResult
from monitor_node.baseline.training_diagnosis import FAILED, DiagnosisJob, Finding, read_equations
from monitor_node.baseline.training_rows import TrainingState
from monitor_node.config import MonitorConfig
from reactorwatch.contract.messages_pb2 import Baseline
from reactorwatch.diagnosis.result import NOMINAL


class ScheduledChange(NamedTuple):
    """A change of the baseline to come.

    Attributes:
        at_ns: time of the first row that is judged by it; None: the next row.
        baseline: the change.
    """

    at_ns: int | None
    baseline: Baseline


class ModelUpdate:
    """Pending diagnosis of a plant's training, and the change that follows it.

    Args:
        config: settings of the monitor.
        changes: changes to come, in order; the caller may append those of a recording.

    Attributes:
        changes: changes to come.
        rows: rows of the training until it was diagnosed and the change was made; None: there are none.
        baseline: the change in force; None: the plant is judged by the model as given.
    """

    def __init__(self, config: MonitorConfig, changes: deque[ScheduledChange]) -> None:
        self._config = config
        self._last_ns: int | None = None
        self.changes = changes
        self.rows: TrainingState | None = None
        self.baseline: Baseline | None = None

    def job(self, equations: str) -> DiagnosisJob | None:
        """The pending diagnosis; None: there is none.

        Args:
            equations: see `DiagnosisJob`.
        """
        if self.rows is None or self.changes:
            return None
        return DiagnosisJob(self.rows, self._config.signals, equations)

    @property
    def is_pending(self) -> bool:
        """True while a diagnosis is pending."""
        return self.rows is not None and not self.changes

    def resolve(self, finding: Finding) -> str:
        """Process a finding: schedule the change for the next row; returns a note, empty if there is nothing to note.

        A finding of another training is ignored.
        """
        job = self.job("")
        if job is None or finding.first_ns != job.first_ns:
            return ""
        if finding.equations:
            self.changes.append(ScheduledChange(None, finding.baseline))
            return f"{finding.why}; from then on the plant is judged by the equations with it"
        self.rows = None
        if finding.verdict == FAILED:
            return f"not diagnosed: {finding.why}; the plant is judged by the equations as given"
        return "" if finding.verdict == NOMINAL else f"{finding.why}; the plant is judged by the equations as given"

    @property
    def commands(self) -> list[Baseline]:
        """Changes by accepted commands that hold from the next row on, in order."""
        return [item.baseline for item in self.changes if item.at_ns is None and is_command(item.baseline)]

    def pop_due(self, time_ns: int) -> Baseline | None:
        """The change that holds from a row on, with its time and number; None: there is none.

        Args:
            time_ns: time of the row. Where the row that a recording names was lost, the change holds from the next.
        """
        last_ns, self._last_ns = self._last_ns, time_ns
        if not self.changes:
            return None
        at_ns, baseline = self.changes[0]
        is_skipped = at_ns is not None and last_ns is not None and last_ns < at_ns < time_ns
        if at_ns not in (None, time_ns) and not is_skipped:
            return None
        if self.rows is None and not is_command(baseline):
            if at_ns is None:  # of a training that a command has ended since
                self.changes.popleft()
            return None
        self.changes.popleft()
        change = Baseline()
        change.CopyFrom(baseline)
        change.time_ns, change.id = time_ns, 1 + (self.baseline.id if self.baseline is not None else 0)
        return change

    def relearn(self, change: Baseline, predictors: list[ArxPredictor]) -> TrainingResult | None:
        """Learn the baseline again from the rows of the training, which are dropped, with the model of a change.

        Args:
            change: the change, which is in force afterwards.
            predictors: the identified models, which stay as they are.

        Returns:
            The result; None if the new equations do not judge the plant any better than the identified models.
        """
        assert self.rows is not None
        rows, self.rows = self.rows, None
        copies = [
            ArxPredictor(arx_structure(self._config), self._config.forgetting, with_snapshots=False) for _ in predictors
        ]
        for copy, predictor in zip(copies, predictors, strict=True):
            copy.restore(predictor.state)
        training = Training(self._config, read_equations(change.model), copies)
        training.restore(rows)
        trained = training.finish(last_chance=True)
        if trained.refused or not isinstance(trained.reference, ProcessReference):
            return None
        self.baseline = change
        return trained
