"""Baselines of one plant: the one in force, those that operators can restore, and those of other modes.

The modes that the training has seen, with rows enough, are judged by what was learned in them. A mode in which the
plant starts up or shuts down, or one that the training has not seen, is watched by the signal checks only.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence

import msgspec

from monitor_node.config import MonitorConfig
from monitor_node.health import NODE, Failures
from monitor_node.learn.baseline import TrainingResult
from monitor_node.learn.model_update import (
    ACCEPT,
    RESTORE,
    TRAINED,
    ModelUpdate,
    check_command,
    is_command,
)
from monitor_node.learn.training import Training
from monitor_node.learn.training_diagnosis import FAILED, DiagnosisJob, Finding, equations_text, read_equations
from monitor_node.watch.evaluation import Evaluation, EvaluationMemory
from monitor_node.watch.operation import Operation
from reactorwatch.contract.messages_pb2 import Baseline, BaselineCommand
from reactorwatch.process.model import ProcessModel
from reactorwatch.stored_state import Memory, copy_of

MOST_KEPT = 3
"""Baselines that can be restored; memory stays bounded."""


class ModesMemory(Memory):
    """Memory of the modes of a plant; one without signals of modes is always in the same.

    Attributes:
        mode: present mode, one value a signal; NaN before its first sample.
        is_judged: False in a mode in which signals are checked only.
        is_learned: True once a mode was learned: one that is new then has not been seen in the training.
        reference: kind of the reference that judged last.
        expected: false alarms expected in the modes before, less those of the present one before.
        is_resumed: True if the present mode was seen in the training, and is learned from these rows now.
        others: memory of each other mode that was learned, or whose training was left before its end.
    """

    mode: list[float]
    is_judged: bool = True
    is_learned: bool = False
    reference: str = ""
    expected: float = 0.0
    is_resumed: bool = False
    others: dict[str, EvaluationMemory] = msgspec.field(default_factory=dict)


class Baselines:
    """Baselines of one plant.

    Args:
        config: settings of the monitor.
        model: process model of the plant as given; None if there is none.
        evaluation: stages of the evaluation of its rows.
        operation: operation of the plant.
        failures: counter of errors in the change of the model.
        changes: changes of the baseline to come.
        diagnose: diagnoses the training before the first row is evaluated; None: the caller takes `diagnosis_job`.

    Attributes:
        training: training of the plant.
        update: changes of the baseline to come, and the one in force.
        kept: baselines that can be restored, the oldest first.
        modes: memory of the modes.
    """

    def __init__(
        self,
        config: MonitorConfig,
        model: ProcessModel | None,
        evaluation: Evaluation,
        operation: Operation,
        failures: Failures,
        changes: deque[Baseline],
        diagnose: Callable[[DiagnosisJob], Finding] | None,
    ) -> None:
        self._config, self._model, self._operation = config, model, operation
        self._evaluation, self._models = evaluation, evaluation.models
        self._failures, self._diagnose = failures, diagnose
        self.training, self.update = Training(config, model, self._models), ModelUpdate(config, changes)
        self.kept: list[EvaluationMemory] = []
        self.modes = ModesMemory([float("nan")] * len(config.modes))

    def _keep(self) -> EvaluationMemory:
        """The baseline in force, as it is kept."""
        return copy_of(self._evaluation.collect_memory())

    def _judge_by(self, kept: EvaluationMemory) -> None:
        """Judge by a baseline that was replaced; its filters and charts start with the next row."""
        memory = copy_of(kept)
        memory.suspicion = None
        self._evaluation.resume(memory, self.equations_of(memory), follows=False)
        self._evaluation.restart_charts()

    def _stop_judging(self) -> None:
        """Judge no rows."""
        self._evaluation.stop()
        self.training.memory.refusals = 0

    # --- training --------------------------------------------------------------------------------------------

    def end_training(
        self, time_ns: int, trained: TrainingResult, period_ns: float, units: Sequence[str]
    ) -> Baseline | None:
        """Judge by what was learned from now on; returns the change of the model by the diagnosis of the training.

        Args:
            time_ns: time of the last row.
            trained: result of the training.
            period_ns: sampling period.
            units: units of the outputs.
        """
        self.start(trained, period_ns)
        if self._config.diagnose_training and equations_text(self._model):
            self.update.rows = trained.rows
        if self._diagnose is not None and (job := self.diagnosis_job) is not None:
            self.on_finding(self._diagnose(job))
        change = self._change_model(time_ns, period_ns, units)
        if change is None:
            self._check_training(trained, period_ns, units)
        return change

    def start(self, trained: TrainingResult, period_ns: float) -> None:
        """Start to judge by what was learned."""
        self.modes.is_learned, self.modes.reference = True, trained.reference.kind
        self._evaluation.start(trained, period_ns, again=False)
        self._operation.end_training()

    def _check_training(self, trained: TrainingResult, period_ns: float, units: Sequence[str]) -> None:
        model = self.equations if trained.reference.follows_equations else None
        self._evaluation.check_training(trained, model, period_ns, units)

    @property
    def diagnosis_job(self) -> DiagnosisJob | None:
        """The diagnosis of the training, while it is pending."""
        return self.update.job(self._model)

    def on_finding(self, finding: Finding) -> None:
        """Process the result of a diagnosis; a change holds from the next row on."""
        note, reference = self.update.resolve(finding), self._evaluation.reference
        if note and (finding.equations or (reference is not None and reference.follows_equations)):
            self._evaluation.notes.append(note)

    # --- changes ---------------------------------------------------------------------------------------------

    def change(self, time_ns: int, period_ns: float, units: Sequence[str]) -> Baseline | None:
        """Execute the change that holds from a row on, and return it; None: there is none."""
        if not is_command(self.update.changes[0]):
            return self._change_model(time_ns, period_ns, units)
        change = self.update.pop_due(time_ns)
        if change is not None:
            self._evaluation.leave_ordinary()
            self._execute(change)
        return change

    def _change_model(self, time_ns: int, period_ns: float, units: Sequence[str]) -> Baseline | None:
        """Learn the baseline again with the model of a change, if one holds from this row on; returns it if so."""
        update, evaluation = self.update, self._evaluation
        if update.changes and is_command(update.changes[0]):
            return None
        change = update.pop_due(time_ns)
        if change is None or update.rows is None:
            return None
        evaluation.leave_ordinary()
        try:
            trained = update.relearn(change, self._models)
        except Exception as error:  # noqa: BLE001 # the stage's border: the baseline before is right without it
            self._failures.add("baseline", error, "the plant is judged by the equations as given")
            return None
        if trained is None:
            evaluation.notes.append("the identified models predict the training better; the baseline stays as it is")
            return None
        self.modes.reference, evaluation.memory.change = trained.reference.kind, change
        evaluation.start(trained, period_ns, again=True)
        self._check_training(trained, period_ns, units)
        if evaluation.memory.rows_watched:  # the filter stands at the end of the training, and rows have come since
            trained.reference.restart()
            evaluation.release_values()
        return change

    # --- commands --------------------------------------------------------------------------------------------

    @property
    def all(self) -> list[Baseline]:
        """Baselines that can be restored, the oldest first, then the one in force."""
        return [_change_of(change) for change in (*(item.change for item in self.kept), self.update.baseline)]

    @property
    def equations(self) -> ProcessModel | None:
        """Process model in force: as given, or as the change of the baseline has it; None: there is none."""
        return self.equations_of(self._evaluation.memory)

    def equations_of(self, memory: EvaluationMemory) -> ProcessModel | None:
        """Process model of a baseline; None: there is none. The newest change may be of another mode."""
        change = memory.change
        return self._model if change is None or not change.model else read_equations(change.model)

    def schedule(self, command: BaselineCommand) -> Baseline:
        """Schedule a command for the next row; returns the change.

        Raises:
            InputError: the command is refused.
        """
        kept = [item.id for item in self.all[:-1]]
        has_rows, has_alarm = self.training.memory.began_ns is not None, self._evaluation.memory.incident is not None
        change = check_command(command, kept, has_rows=has_rows, has_alarm=has_alarm)
        self.update.changes.append(change)
        return change

    def _execute(self, change: Baseline) -> None:
        """Execute a command: keep the baseline in force, and train again or restore another."""
        kept = {_change_of(item.change).id: item for item in self.kept}
        restored = kept.get(change.restored) if change.what == RESTORE else None
        memory = self._evaluation.memory
        accepted = memory.incident if change.what == ACCEPT else None
        memory.incident = self.update.rows = None
        if self._evaluation.reference is not None:
            replaced = self._keep()
            replaced.change = _change_of(replaced.change)
            replaced.change.id = _change_of(self.update.baseline).id  # its own may be that of another mode's baseline
            kept[replaced.change.id] = replaced
        self.kept = list(kept.values())[-MOST_KEPT:]
        if restored is not None:
            change.model = _change_of(restored.change).model
            self._judge_by(restored)
        else:
            self._stop_judging()
            self.training.restart(change.time_ns)
            if accepted is not None:
                self.training.take_over(accepted)
        self.update.baseline = self._evaluation.memory.change = change
        if self._evaluation.reference is None:
            self.modes.is_judged, self.modes.is_resumed = True, False

    # --- modes -----------------------------------------------------------------------------------------------

    def follow_mode(self, values: Mapping[str, float]) -> None:
        """Take over the newest values of the modes, and change the baseline if the plant has changed its mode.

        A first value is no change: rows before it are of the same mode.
        """
        new, old = [values[name] for name in self._config.modes], self.modes.mode
        is_first = all(before != before or before == value for before, value in zip(old, new, strict=True))
        if is_first and not self._is_startup(new):
            self.modes.mode = new
        elif new != old:
            self._change_mode(new)

    def _is_startup(self, mode: list[float]) -> bool:
        """True if the plant starts up or shuts down in a mode."""
        return any(
            value in self._config.startup_modes.get(name, ())
            for name, value in zip(self._config.modes, mode, strict=True)
        )

    def _change_mode(self, mode: list[float]) -> None:
        """Leave the present mode, and judge by what was learned in the next, or go on to learn it."""
        modes, training, evaluation = self.modes, self.training, self._evaluation
        evaluation.leave_ordinary()
        evaluation.memory.incident, began_ns = None, training.memory.began_ns
        if (rows := self.update.rows) is not None:  # its finding would change the baseline of the next mode
            self.on_finding(Finding(rows.times_ns[0], FAILED, "the plant changed its mode before the end"))
            self.update.rows = None
        is_watched = evaluation.reference is not None
        if modes.is_judged and (is_watched or training.memory.rows.times):
            left = modes.others[_key_of(modes.mode)] = self._keep()
            left.training = None if is_watched else training.memory.rows
        modes.mode, modes.expected = mode, self.expected_false_alarms
        self._stop_judging()
        modes.is_judged = not self._is_startup(modes.mode)
        if not modes.is_judged:
            return
        known = modes.others.pop(_key_of(modes.mode), None)
        if known is not None and known.training is None:
            self._judge_by(known)
            modes.expected = 2.0 * modes.expected - self.expected_false_alarms
            return
        modes.is_resumed = known is not None and modes.is_learned
        training.restart(began_ns)
        if known is not None and known.training is not None:
            training.memory.rows, evaluation.memory.change = known.training, known.change
            self._models.resume(known.predictors, follows=False)
        if not modes.is_learned or (known is not None and training.is_enough()):
            return
        modes.is_judged = False
        name = ", ".join(f"{name} {value:.6g}" for name, value in zip(self._config.modes, modes.mode, strict=True))
        self._evaluation.notes.append(
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
