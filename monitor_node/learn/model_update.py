"""Change of what a plant is judged by: by an operator's commands, and after the diagnosis of its training.

People publish `reactor/{plant}/command/baseline`. The rows of a training are kept until it has been diagnosed. A change
holds from one row on: the next one, or the one that a recording names; it is published with the time of that row, so a
replay does the same there. After a diagnosis the baseline is learned again from the same rows with the new model.
"""

from collections import deque
from collections.abc import Sequence

from monitor_node.config import MonitorConfig
from monitor_node.learn.arx import ArxReference
from monitor_node.learn.baseline import TrainingResult, learn_baseline
from monitor_node.learn.training_diagnosis import FAILED, DiagnosisJob, Finding, equations_text, read_equations
from monitor_node.learn.training_rows import TrainingRows
from reactorwatch.contract.commands import check_signature
from reactorwatch.contract.messages_pb2 import Baseline, BaselineCommand
from reactorwatch.diagnosis.result import NOMINAL
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel


class ModelUpdate:
    """Pending diagnosis of a plant's training, and the change that follows it.

    Args:
        config: settings of the monitor.
        changes: changes to come, in order, each with the time of the first row that is judged by it, 0 for the next
            row; the caller may append those of a recording.

    Attributes:
        changes: changes to come.
        rows: rows of the training until it was diagnosed and the change was made; None: there are none.
        baseline: the change in force; None: the plant is judged by the model as given.
    """

    def __init__(self, config: MonitorConfig, changes: deque[Baseline]) -> None:
        self._config = config
        self._last_ns: int | None = None
        self.changes = changes
        self.rows: TrainingRows | None = None
        self.baseline: Baseline | None = None

    def job(self, model: ProcessModel | None) -> DiagnosisJob | None:
        """The pending diagnosis; None: there is none.

        Args:
            model: process model of the plant as given.
        """
        if self.rows is None or self.changes:
            return None
        return DiagnosisJob(self.rows, self._config.signals, equations_text(model))

    @property
    def is_pending(self) -> bool:
        """True while a diagnosis is pending."""
        return self.rows is not None and not self.changes

    def resolve(self, finding: Finding) -> str:
        """Process a finding: schedule the change for the next row; returns a note, empty if there is nothing to note.

        A finding of another training is ignored.
        """
        if self.rows is None or self.changes or finding.first_ns != self.rows.times_ns[0]:
            return ""
        if finding.equations:
            self.changes.append(finding.baseline)
            return f"{finding.why}; from then on the plant is judged by the equations with it"
        self.rows = None
        if finding.verdict == FAILED:
            return f"not diagnosed: {finding.why}; the plant is judged by the equations as given"
        return "" if finding.verdict == NOMINAL else f"{finding.why}; the plant is judged by the equations as given"

    @property
    def commands(self) -> list[Baseline]:
        """Changes by accepted commands that hold from the next row on, in order."""
        return [change for change in self.changes if not change.time_ns and is_command(change)]

    def pop_due(self, time_ns: int) -> Baseline | None:
        """The change that holds from a row on, with its time and number; None: there is none.

        Args:
            time_ns: time of the row. Where the row that a recording names was lost, the change holds from the next.
        """
        last_ns, self._last_ns = self._last_ns, time_ns
        if not self.changes:
            return None
        at_ns = self.changes[0].time_ns
        is_skipped = last_ns is not None and last_ns < at_ns < time_ns
        if at_ns not in (0, time_ns) and not is_skipped:
            return None
        if self.rows is None and not is_command(self.changes[0]):
            if not at_ns:  # of a training that a command has ended since
                self.changes.popleft()
            return None
        change = Baseline()
        change.CopyFrom(self.changes.popleft())
        change.time_ns, change.id = time_ns, 1 + (self.baseline.id if self.baseline is not None else 0)
        return change

    def relearn(self, change: Baseline, models: ArxReference) -> TrainingResult | None:
        """Learn the baseline again from the rows of the training, which are dropped, with the model of a change.

        Args:
            change: the change, which is in force afterwards.
            models: the identified models, which stay as they are.

        Returns:
            The result; None if the new equations do not judge the plant any better than the identified models.
        """
        assert self.rows is not None
        rows, self.rows = self.rows, None
        trained = learn_baseline(self._config, read_equations(change.model), models.copy(), rows, last_chance=True)
        if trained.refused or not trained.reference.follows_equations:
            return None
        self.baseline = change
        return trained


BASELINE = "baseline"
"""Name of the command."""

ACCEPT, RELEARN, RESTORE, LIST = "accept", "relearn", "restore", "list"
"""Learn from the rows since the alarm; learn from here on; judge by an earlier baseline again; list the baselines."""

TRAINED = "trained"
"""`Baseline.what` of what was learned first."""


def check_command(command: BaselineCommand, kept: Sequence[int], *, has_rows: bool, has_alarm: bool) -> Baseline:
    """Check a command other than `list`; returns the change, without its time and number.

    Args:
        command: the command.
        kept: numbers of the baselines that can be restored, the one before last.
        has_rows: True if a row has come.
        has_alarm: True if an alarm without a known cause is active, and rows are judged.

    Raises:
        InputError: the command is refused.
    """
    by, why = check_signature(command.by, command.why)
    if not why:
        raise InputError("why must say why the baseline changes, got ''")
    if command.what not in (ACCEPT, RELEARN, RESTORE):
        raise InputError(f"what must be one of {ACCEPT}, {RELEARN}, {RESTORE} and {LIST}, got {command.what!r}")
    if not has_rows:
        raise InputError("no sample has come yet, so there is no baseline to change")
    change = Baseline(what=command.what, by=by, why=why)
    if command.what == ACCEPT and not has_alarm:
        raise InputError("no alarm is active, so there are no rows to accept; relearn learns from the next row on")
    if command.what == RESTORE:
        if not kept:
            raise InputError("there is no earlier baseline to restore: nothing was learned again so far")
        change.restored = command.id if command.HasField("id") else kept[-1]
        if change.restored not in kept:
            raise InputError(f"id must be one of {', '.join(map(str, kept))}, got {change.restored}")
    return change


def is_command(change: Baseline) -> bool:
    """True if a person made a change; False if the diagnosis of the training did, or a version that named no maker."""
    return change.what in (ACCEPT, RELEARN, RESTORE)
