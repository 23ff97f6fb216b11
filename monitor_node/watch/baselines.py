"""Baselines of one plant: the one in force, those that operators can restore, and those of other modes.

The modes that the training has seen, with rows enough, are judged by what was learned in them. A mode in which the
plant starts up or shuts down, or one that the training has not seen, is watched by the signal checks only.

A baseline changes by an operator's command (`reactor/{plant}/command/baseline`), and after the diagnosis of the
training, whose rows are kept until then: it is learned again from them with the new model. A command holds from the
next row on, a diagnosis from the row that is `ANSWER_ROWS` after the training, whenever before it was done: so a
back-test, where it is done at once, and a live monitor publish the same. A diagnosis that takes longer holds from the
next row on. A change is published with the time of its row, so a replay does the same there.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence

import msgspec

from monitor_node.config import MonitorConfig
from monitor_node.health import NODE, Failures
from monitor_node.learn.arx import ArxReference
from monitor_node.learn.baseline import TrainingResult, learn_baseline
from monitor_node.learn.training import Training
from monitor_node.learn.training_diagnosis import (
    FAILED,
    DiagnosisJob,
    Finding,
    equations_text,
    read_equations,
)
from monitor_node.learn.training_rows import TrainingRows
from monitor_node.watch.evaluation import Evaluation, EvaluationMemory
from monitor_node.watch.operation import Operation
from reactorwatch.contract.codec import check_signature
from reactorwatch.contract.messages_pb2 import Baseline, BaselineCommand
from reactorwatch.diagnosis.record_checks import describe_still_inputs
from reactorwatch.diagnosis.result import NOMINAL
from reactorwatch.errors import InputError
from reactorwatch.process import effects_of, own_effects
from reactorwatch.process.model import ProcessModel
from reactorwatch.stored_state import Memory, copy_of


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
        self.training, self.update = Training(config, model, self._models), ModelUpdate(config, model, changes)
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
        self, time_ns: int, trained: TrainingResult, period_ns: float, units: Sequence[str], *, at_once: bool = False
    ) -> Baseline | None:
        """Judge by what was learned from now on; returns the change of the model that a recording has at this row.

        Args:
            time_ns: time of the row.
            trained: what was learned.
            period_ns: sampling period.
            units: units of the outputs.
            at_once: True to change the model now by the diagnosis of the training, as no row of this record follows.
        """
        self.start(trained, period_ns)
        if self._config.diagnose_training and self._model is not None and self._model.inputs:
            self.update.rows = trained.rows
        if self._diagnose is not None and (job := self.diagnosis_job) is not None:
            self.on_finding(self._diagnose(job))
        change = self._change_model(time_ns, period_ns, units, at_once=at_once)
        if change is None:
            self._check_training(trained, period_ns, units)
        return change

    def start(self, trained: TrainingResult, period_ns: float) -> None:
        """Start to judge by what was learned."""
        self.modes.is_learned, self.modes.reference = True, trained.reference.kind
        self._evaluation.start(trained, period_ns, again=False)
        if self._model is not None and trained.reference.follows_equations:
            still = describe_still_inputs(self._model, effects_of(self._model), trained.rows.arrays.inputs)
            self._evaluation.notes += [f"training: {item}" for item in still]
        self._operation.end_training()

    def _check_training(self, trained: TrainingResult, period_ns: float, units: Sequence[str]) -> None:
        model = self.equations if trained.reference.follows_equations else None
        self._evaluation.check_training(trained, model, period_ns, units)

    @property
    def diagnosis_job(self) -> DiagnosisJob | None:
        """The diagnosis of the training, while it is pending."""
        return self.update.job

    def on_finding(self, finding: Finding) -> None:
        """Process the result of a diagnosis; see the module for the row from which on a change holds."""
        note, reference = self.update.resolve(finding), self._evaluation.reference
        if note and (finding.equations or (reference is not None and reference.follows_equations)):
            self._evaluation.notes.append(note)

    # --- changes ---------------------------------------------------------------------------------------------

    def change(self, time_ns: int, period_ns: float, units: Sequence[str]) -> Baseline | None:
        """Execute the change that holds from a row on, and return it; None: there is none."""
        if not (self.update.changes and is_command(self.update.changes[0])):
            return self._change_model(time_ns, period_ns, units)
        change = self.update.pop_due(time_ns)
        if change is not None:
            self._evaluation.leave_ordinary()
            self._execute(change)
        return change

    def _change_model(
        self, time_ns: int, period_ns: float, units: Sequence[str], *, at_once: bool = False
    ) -> Baseline | None:
        """Learn the baseline again with the model of a change, if one holds from this row on; returns it if so."""
        update, evaluation = self.update, self._evaluation
        if at_once or evaluation.memory.rows_watched >= ANSWER_ROWS:
            update.take_answer()
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
        return self._model if change is None or not change.model else read_equations(change.model, self._model)

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
        memory.incident = None
        self.update.drop_training()
        if self._evaluation.reference is not None:
            replaced = self._keep()
            replaced.change = _change_of(replaced.change)
            replaced.change.id = _change_of(self.update.baseline).id  # its own may be that of another mode's baseline
            kept[replaced.change.id] = replaced
        self.kept = list(kept.values())[-3:]
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
            self.update.answer = None
            self.on_finding(Finding(rows.times_ns[0], FAILED, "the plant changed its mode before the end"))
            self.update.drop_training()
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


ANSWER_ROWS = 10
"""Number of rows after a training from which on its diagnosis holds. As many come before the first look for causes. The
reactor's takes a few seconds, less than a row of six seconds each."""


class ModelUpdate:
    """Pending diagnosis of a plant's training, and the change that follows it.

    Attributes:
        changes: changes to come.
        answer: change by the diagnosis of the training, until the row from which on it holds; None: there is none.
        rows: rows of the training until it was diagnosed and the change was made; None: there are none.
        baseline: the change in force; None: the plant is judged by the model as given.
    """

    def __init__(self, config: MonitorConfig, model: ProcessModel | None, changes: deque[Baseline]) -> None:
        self._config, self._model = config, model
        self._last_ns: int | None = None
        self.changes = changes
        self.answer: Baseline | None = None
        self.rows: TrainingRows | None = None
        self.baseline: Baseline | None = None

    @property
    def job(self) -> DiagnosisJob | None:
        """The pending diagnosis; None: there is none."""
        if not self.is_pending or self.rows is None or self._model is None:
            return None
        effects, config = own_effects(self._model), self._config
        causes, text = tuple(effect.name for effect in effects), equations_text(self._model)
        return DiagnosisJob(self.rows, config.signals, text, config.process, causes, config.uncertain, effects)

    @property
    def is_pending(self) -> bool:
        """True while a diagnosis is pending."""
        return self.rows is not None and not self.changes and self.answer is None

    @property
    def is_due(self) -> bool:
        """True if a change may hold from the next row on."""
        return bool(self.changes) or self.answer is not None

    def take_answer(self) -> None:
        """Let the diagnosis of the training hold from this row on; a command that comes first replaces the training."""
        if self.answer is not None and not self.changes:
            self.changes.append(self.answer)
            self.answer = None

    def drop_training(self) -> None:
        """Drop the rows of the training, and what their diagnosis would change."""
        self.rows = self.answer = None

    def resolve(self, finding: Finding) -> str:
        """Process a finding, which may be a change to come; returns a note, empty if there is nothing to note.

        A finding of another training is ignored.
        """
        if self.rows is None or not self.is_pending or finding.first_ns != self.rows.times_ns[0]:
            return ""
        if finding.equations:
            self.answer = finding.baseline
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

        Returns:
            The result; None if the new equations do not judge the plant any better than the identified models.
        """
        assert self.rows is not None
        rows, self.rows = self.rows, None
        trained = learn_baseline(
            self._config, read_equations(change.model, self._model), models.copy(), rows, last_chance=True
        )
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
