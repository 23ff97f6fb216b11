"""Baselines of one plant: the one in force, and those that operators can restore."""

from monitor_node.health import NODE
from monitor_node.learn.arx_reference import ArxReference
from monitor_node.learn.model_update import ACCEPT, RESTORE, TRAINED, ModelUpdate, ScheduledChange, check_command
from monitor_node.learn.references import Reference
from monitor_node.learn.training_diagnosis import read_equations
from monitor_node.learn.training_rows import TrainingRows
from monitor_node.watch.evaluation import Evaluation
from monitor_node.watch.pipeline_state import KeptBaseline, TrainedState
from monitor_node.watch.training_stage import TrainingStage
from reactorwatch.contract.messages_pb2 import Baseline, BaselineCommand
from reactorwatch.process.model import ProcessModel
from reactorwatch.stored_state import copy_of

MOST_KEPT = 3
"""Baselines that can be restored; memory stays bounded."""


class KeptBaselines:
    """Baselines of one plant.

    Args:
        model: process model of the plant as given; None if there is none.
        models: identified models.
        training: training of the plant.
        evaluation: evaluation of its rows.
        update: changes of the baseline to come, and the one in force.

    Attributes:
        kept: baselines that can be restored, the oldest first.
    """

    def __init__(
        self,
        model: ProcessModel | None,
        models: ArxReference,
        training: TrainingStage,
        evaluation: Evaluation,
        update: ModelUpdate,
    ) -> None:
        self._model, self._models, self._training = model, models, training
        self._evaluation, self._update = evaluation, update
        self.kept: list[KeptBaseline] = []

    @property
    def all(self) -> list[Baseline]:
        """Baselines that can be restored, the oldest first, then the one in force."""
        return [*(Baseline.FromString(item.change) for item in self.kept), self._in_force]

    @property
    def _in_force(self) -> Baseline:
        return Baseline(what=TRAINED, by=NODE) if self._update.baseline is None else self._update.baseline

    @property
    def equations(self) -> ProcessModel | None:
        """Process model in force: as given, or as the change of the baseline has it; None: there is none."""
        change = self._update.baseline
        return self._model if change is None or not change.model else read_equations(change.model)

    def schedule(self, command: BaselineCommand) -> Baseline:
        """Schedule a command for the next row; returns the change.

        Raises:
            InputError: the command is refused.
        """
        kept = [item.id for item in self.all[:-1]]
        has_rows, has_alarm = self._training.began_ns is not None, self._evaluation.incident is not None
        change = check_command(command, kept, has_rows=has_rows, has_alarm=has_alarm)
        self._update.changes.append(ScheduledChange(None, change))
        return change

    def execute(self, change: Baseline) -> None:
        """Execute a command: keep the baseline in force, and train again or restore another."""
        kept = {Baseline.FromString(item.change).id: item for item in self.kept}
        restored = kept.get(change.restored) if change.what == RESTORE else None
        evaluation = self._evaluation
        if evaluation.reference is not None:
            kept[self._in_force.id] = self.make(evaluation.reference)
        self.kept = list(kept.values())[-MOST_KEPT:]
        accepted = evaluation.incident if change.what == ACCEPT else None
        evaluation.incident = self._update.rows = None
        if restored is not None:
            change.model = Baseline.FromString(restored.change).model
            self.restore(restored)
        else:
            self._train_again(change.time_ns, accepted)
        self._update.baseline = change

    def make(self, reference: Reference) -> KeptBaseline:
        """The baseline in force, as it is kept."""
        return KeptBaseline(
            self._in_force.SerializeToString(),
            self.trained_state(reference),
            copy_of(self._models.memory),
            self._evaluation.signals.memory,
        )

    def trained_state(self, reference: Reference) -> TrainedState:
        """State after the training, with the change of the model in force."""
        change = self._update.baseline
        return self._evaluation.trained_state(reference, b"" if change is None else change.SerializeToString())

    def restore(self, kept: KeptBaseline) -> None:
        """Judge by a baseline that was replaced; its filters and charts start with the next row."""
        self._models.resume(kept.models)
        self._models.restart()
        self._evaluation.signals.resume(kept.signals)
        change = Baseline.FromString(kept.change)
        equations = read_equations(change.model) if change.model else self._model
        self._evaluation.restore_baseline(kept.trained, equations)
        self._evaluation.restart_charts()

    def stop_judging(self) -> None:
        """Judge no rows."""
        self._evaluation.stop()
        self._training.refusals = 0

    def _train_again(self, time_ns: int, rows: TrainingRows | None) -> None:
        """Train from a row on, after the given rows."""
        self.stop_judging()
        self._training.restart(time_ns)
        if rows is not None:
            self._training.take_over(rows)
