"""Baselines of one plant: the one in force, those that operators can restore, and those of other modes.

The modes that the training has seen, with rows enough, are judged by what was learned in them. A mode in which the
plant starts up or shuts down, or one that the training has not seen, is watched by the signal checks only.
"""

from collections.abc import Mapping

from monitor_node.config import MonitorConfig
from monitor_node.health import NODE
from monitor_node.learn.arx_reference import ArxReference
from monitor_node.learn.model_update import ACCEPT, RESTORE, TRAINED, ModelUpdate, check_command
from monitor_node.learn.training import Training
from monitor_node.learn.training_diagnosis import read_equations
from monitor_node.watch.evaluation import Evaluation
from monitor_node.watch.pipeline_memory import EvaluationMemory, ModesMemory
from reactorwatch.contract.messages_pb2 import Baseline, BaselineCommand
from reactorwatch.process.model import ProcessModel
from reactorwatch.stored_state import copy_of

MOST_KEPT = 3
"""Baselines that can be restored; memory stays bounded."""


class Baselines:
    """Baselines of one plant.

    Args:
        config: settings of the monitor.
        model: process model of the plant as given; None if there is none.
        models: identified models.
        training: training of the plant.
        evaluation: evaluation of its rows.
        update: changes of the baseline to come, and the one in force.

    Attributes:
        kept: baselines that can be restored, the oldest first.
        modes: memory of the modes.
    """

    def __init__(
        self,
        config: MonitorConfig,
        model: ProcessModel | None,
        models: ArxReference,
        training: Training,
        evaluation: Evaluation,
        update: ModelUpdate,
    ) -> None:
        self._names, self._startup = config.modes, config.startup_modes
        self._model, self._models, self._training = model, models, training
        self._evaluation, self._update = evaluation, update
        self.kept: list[EvaluationMemory] = []
        self.modes = ModesMemory([float("nan")] * len(config.modes))

    def _keep(self) -> EvaluationMemory:
        """The baseline in force, as it is kept."""
        kept = copy_of(self._evaluation.memory)
        kept.change = self._update.baseline
        return kept

    def _judge_by(self, kept: EvaluationMemory) -> None:
        """Judge by a baseline that was replaced; its filters and charts start with the next row."""
        memory = copy_of(kept)
        memory.suspicion = None
        self._evaluation.resume(memory, self._equations(memory.change), follows=False)
        self._evaluation.restart_charts()

    def _stop_judging(self) -> None:
        """Judge no rows."""
        self._evaluation.stop()
        self._training.memory.refusals = 0

    # --- commands --------------------------------------------------------------------------------------------

    @property
    def all(self) -> list[Baseline]:
        """Baselines that can be restored, the oldest first, then the one in force."""
        return [_change_of(change) for change in (*(item.change for item in self.kept), self._update.baseline)]

    @property
    def equations(self) -> ProcessModel | None:
        """Process model in force: as given, or as the change of the baseline has it; None: there is none."""
        return self._equations(self._update.baseline)

    def _equations(self, change: Baseline | None) -> ProcessModel | None:
        return self._model if change is None or not change.model else read_equations(change.model)

    def schedule(self, command: BaselineCommand) -> Baseline:
        """Schedule a command for the next row; returns the change.

        Raises:
            InputError: the command is refused.
        """
        kept = [item.id for item in self.all[:-1]]
        has_rows, has_alarm = self._training.memory.began_ns is not None, self._evaluation.memory.incident is not None
        change = check_command(command, kept, has_rows=has_rows, has_alarm=has_alarm)
        self._update.changes.append(change)
        return change

    def execute(self, change: Baseline) -> None:
        """Execute a command: keep the baseline in force, and train again or restore another."""
        kept = {_change_of(item.change).id: item for item in self.kept}
        restored = kept.get(change.restored) if change.what == RESTORE else None
        memory = self._evaluation.memory
        accepted = memory.incident if change.what == ACCEPT else None
        memory.incident = self._update.rows = None
        if memory.reference is not None:
            kept[_change_of(self._update.baseline).id] = self._keep()
        self.kept = list(kept.values())[-MOST_KEPT:]
        if restored is not None:
            change.model = _change_of(restored.change).model
            self._judge_by(restored)
        else:
            self._stop_judging()
            self._training.restart(change.time_ns)
            if accepted is not None:
                self._training.take_over(accepted)
        self._update.baseline = change
        if self._evaluation.reference is None:
            self.modes.is_judged, self.modes.is_resumed = True, False

    # --- modes -----------------------------------------------------------------------------------------------

    def is_mode_change(self, values: Mapping[str, float]) -> bool:
        """Take over the newest values of the modes; returns True if the plant has changed its mode.

        A first value is no change: rows before it are of the same mode.
        """
        new, old = [values[name] for name in self._names], self.modes.mode
        if new == old:
            return False
        is_first = all(before != before or before == value for before, value in zip(old, new, strict=True))
        if is_first and not self._is_startup(new):
            self.modes.mode = new
            return False
        return True

    def _is_startup(self, mode: list[float]) -> bool:
        """True if the plant starts up or shuts down in a mode."""
        return any(value in self._startup.get(name, ()) for name, value in zip(self._names, mode, strict=True))

    def change_mode(self, values: Mapping[str, float]) -> str:
        """Leave the present mode, and judge by what was learned in the next, or go on to learn it.

        Args:
            values: newest values of the modes.

        Returns:
            A note if the mode is new and its rows are not judged, else empty.
        """
        modes, training, evaluation = self.modes, self._training, self._evaluation
        evaluation.leave_ordinary()
        evaluation.memory.incident, began_ns = None, training.memory.began_ns
        is_watched = evaluation.reference is not None
        if modes.is_judged and (is_watched or training.memory.rows.times):
            left = modes.others[_key_of(modes.mode)] = self._keep()
            left.training = None if is_watched else training.memory.rows
        modes.mode, modes.expected = [values[name] for name in self._names], self.expected_false_alarms
        self._stop_judging()
        modes.is_judged = not self._is_startup(modes.mode)
        if not modes.is_judged:
            return ""
        known = modes.others.pop(_key_of(modes.mode), None)
        if known is not None and known.training is None:
            self._judge_by(known)
            modes.expected = 2.0 * modes.expected - self.expected_false_alarms
            return ""
        modes.is_resumed = known is not None and modes.is_learned
        training.restart(began_ns)
        if known is not None and known.training is not None:
            training.memory.rows = known.training
            self._models.resume(known.predictors, follows=False)
        if not modes.is_learned or (known is not None and training.is_enough()):
            return ""
        modes.is_judged = False
        name = ", ".join(f"{name} {value:.6g}" for name, value in zip(self._names, modes.mode, strict=True))
        return (
            f"{name} was not seen in the training: its rows are watched by signal checks only; "
            "`baseline relearn` learns them"
        )

    @property
    def rows_in_other_modes(self) -> int:
        """Number of rows of the trainings of other modes, until one is learned."""
        trainings = [item.training for item in self.modes.others.values() if item.training is not None]
        return 0 if self.modes.is_learned else sum(rows.dropped + len(rows.times) for rows in trainings)

    @property
    def expected_false_alarms(self) -> float:
        """Mean number of false alarms expected so far, in all modes."""
        return self.modes.expected + self._evaluation.expected_false_alarms


def _change_of(change: Baseline | None) -> Baseline:
    """A change of the baseline; that of the first training where there was none."""
    return Baseline(what=TRAINED, by=NODE) if change is None else change


def _key_of(mode: list[float]) -> str:
    """Key of a mode in the memory."""
    return ",".join(map(repr, mode))
