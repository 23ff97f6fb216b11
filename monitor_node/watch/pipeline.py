"""Pipeline of a plant's rows: training, then evaluation.

During training rows are kept, and the identified models are updated with them. Afterwards the reference predicts each
row, and the charts evaluate its prewhitened residuals. An ordinary row is taken by the compiled step. Any other row
passes the stages (`evaluation`) one by one, with the same numbers. A reference that learns does so while nothing is
wrong: otherwise it would learn a fault as normal.

Commands and diagnoses change the baseline by which rows are judged, and so does a change of the operating mode
(`baselines`).
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from itertools import repeat
from math import isfinite, nan

from monitor_node.alarms.alarms import AlarmChange
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.causes.stage import Suspicion
from monitor_node.checks.base import CheckRow
from monitor_node.config import MonitorConfig
from monitor_node.health import NODE, Failures
from monitor_node.ingest.alignment import MeasuredRow, Row, SamplingPeriod
from monitor_node.learn.arx import ArxReference
from monitor_node.learn.baseline import NO_VALUE, TrainingResult
from monitor_node.learn.training import TrainingMemory
from monitor_node.learn.training_diagnosis import DiagnosisJob, Finding
from monitor_node.learn.training_rows import TrainingRows
from monitor_node.watch.baselines import Baselines, ModesMemory, is_command
from monitor_node.watch.evaluation import Evaluation, EvaluationMemory, check_promise
from monitor_node.watch.operation import CarriedState, Operation
from monitor_node.watch.promise import PromiseStage
from monitor_node.watch.row_step import EVENT, VIOLATING
from monitor_node.watched_process import input_bounds, judging_equations
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, Baseline, Estimate
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.spc.prewhitening import innovations
from reactorwatch.stored_state import Memory


class PipelineMemory(Memory):
    """Memory of a pipeline, without the alarms.

    Attributes:
        sampling: sampling period.
        operation: modes and set points, by signal.
        training: memory of the training.
        evaluation: memory of what judges the rows.
        modes: memory of the modes.
        kept: baselines that can be restored, the oldest first.
        change: newest change of a baseline, of any mode; None: there was none.
        undiagnosed: rows of the training until its diagnosis holds; None: there are none.
        commands: changes by accepted commands that hold from the next row on, in order.
        answer: change by the diagnosis of the training, until the row from which on it holds; None: there is none.
    """

    sampling: SamplingPeriod
    operation: dict[str, CarriedState]
    training: TrainingMemory
    evaluation: EvaluationMemory
    modes: ModesMemory
    kept: list[EvaluationMemory]
    change: Baseline | None
    undiagnosed: TrainingRows | None
    commands: list[Baseline]
    answer: Baseline | None = None


class PlantPipeline:
    """Pipeline of one plant.

    Raises:
        InputError: the settings ask for a process model that does not fit the plant's signals.

    Attributes:
        model: process model of the plant; None if there is none.
        evaluation: stages by which the plant's rows are evaluated.
        models: identified models.
        operation: operation of the plant, for the texts of alarms.
        training: training of the plant.
        baselines: the baseline in force, and those that can be restored.
        has_judged: True if a chart could judge a row since this object was made.
    """

    def __init__(
        self,
        config: MonitorConfig,
        board: Annunciator,
        *,
        points: bool = True,
        model: ProcessModel | None = None,
        failures: Failures | None = None,
        changes: deque[Baseline] | None = None,
        diagnose: Callable[[DiagnosisJob], Finding] | None = None,
        promises: PromiseStage | None = None,
    ) -> None:
        self._config, self._board = config, board
        self._units = [config.units.get(name, "") for name in config.outputs]
        self._failures = Failures() if failures is None else failures
        self._points = points
        self._inputs = len(config.inputs)
        self.model = judging_equations(config, model)
        units = {**config.units, **(self.model.units if self.model is not None else {})}
        self.operation = Operation(config, input_bounds(config, self.model), units)
        board.describe_operation = self.operation.describe
        self._sampling = SamplingPeriod()
        self._promise_checked = False
        self._baseline_key = keys.key(config.plant, keys.BASELINE, NODE)
        self._paths = [keys.key(config.plant, keys.ESTIMATE, signal) for signal in config.outputs]
        self._paths_beside = [f"{path}/{ArxReference.kind}" for path in self._paths]
        self.models = ArxReference(config, points=points)
        self.evaluation = Evaluation(
            config,
            board,
            self.models,
            model=self.model,
            is_process=model is not None or config.reference == "equations",
            promises=promises or PromiseStage(config, board, self._failures, points=points),
        )
        changes = deque() if changes is None else changes
        self.baselines = Baselines(
            config, self.model, self.evaluation, self.operation, self._failures, changes, diagnose
        )
        self.training = self.baselines.training
        self._noted: set[str] = set()
        self.has_judged = False

    # --- memory ----------------------------------------------------------------------------------------------

    @property
    def memory(self) -> PipelineMemory:
        """The memory between two rows, composed of those that run; the alarms belong to the board."""
        return PipelineMemory(
            self._sampling,
            self.operation.memory,
            self.training.memory,
            self.evaluation.collect_memory(),
            self.baselines.modes,
            self.baselines.kept,
            self.baselines.update.baseline,
            self.baselines.update.rows,
            self.baselines.update.commands,
            self.baselines.update.answer,
        )

    def resume(self, memory: PipelineMemory, now_ns: int) -> None:
        """Resume bit-identically from a memory of the same settings; the alarms are restored before.

        Raises:
            ValueError: the memory is damaged.
        """
        update, baselines = self.baselines.update, self.baselines
        if set(memory.operation) != set(self.operation.memory):
            raise ValueError(f"the state must be of {sorted(self.operation.memory)}, got {sorted(memory.operation)}")
        self._sampling = memory.sampling
        self.operation.memory, self.training.memory = memory.operation, memory.training
        baselines.modes, baselines.kept, update.baseline = memory.modes, memory.kept, memory.change
        update.changes.extend(memory.commands)
        if self._config.diagnose_training:
            update.rows, update.answer = memory.undiagnosed, memory.answer
        self.evaluation.resume(memory.evaluation, baselines.equations_of(memory.evaluation), now_ns, follows=True)

    def resume_from_alarms(self) -> None:
        """Follow alarms that were set from outside."""
        self.evaluation.leave_ordinary()
        self.evaluation.signals.silence.follow_alarms()

    @property
    def watching(self) -> bool:
        """True if rows are evaluated."""
        return self.evaluation.reference is not None

    @property
    def reference(self) -> str:
        """Kind of the reference: `equations`, `black-box` or `arx`; empty before there is one."""
        return "" if self.evaluation.reference is None else self.evaluation.reference.kind

    @property
    def trained_share(self) -> float:
        """Share of the training that is done, 0 to 1."""
        return 1.0 if self.watching else self.training.share(self._sampling.period_ns)

    # --- rows ------------------------------------------------------------------------------------------------

    def update(self, row: Row, units: list[str], publications: list[Publication]) -> None:
        """Process a row, with the units of its outputs; publications before an error are published nevertheless."""
        baselines, evaluation = self.baselines, self.evaluation
        if baselines.update.is_due:
            self._change_baseline(row.time_ns, publications)
        if self._config.modes:
            baselines.follow_mode(self.operation.values)
        interval = self._sampling.update(row.time_ns)
        inputs, values = row.values[: self._inputs], list(row.values[self._inputs :])
        follows = interval.follows and not row.restarted
        measured = MeasuredRow(row.time_ns, inputs, values, units, interval, follows, publications)
        if not (evaluation.is_ordinary and not row.restarted and self._take_ordinary(row.values, measured)):
            self._take_event(row, measured)

    def _take_ordinary(self, signals: tuple[float, ...], row: MeasuredRow) -> bool:
        """Evaluate a row by the compiled step; returns False if it is an event, for which nothing has changed."""
        evaluation, memory, time_ns = self.evaluation, self.evaluation.memory, row.time_ns
        ordinary, charts, shift = evaluation.ordinary, evaluation.charts, evaluation.shift
        verdict = ordinary.take(time_ns, signals)
        if verdict == EVENT:
            return False
        if verdict == VIOLATING:
            charts.store_delays(ordinary.numbers[0])
        assert ordinary.reference is not None
        ordinary.reference.accept_row(time_ns / MINUTE_NS, row.inputs)
        memory.rows_watched += 1
        self.has_judged = True
        if evaluation.suspicion is not None:
            evaluation.suspicion.add(time_ns / MINUTE_NS, row.inputs, row.values)
        if not (self._points or evaluation.drift.wanted or shift.is_active):
            return True
        before = len(row.publications)
        predictions, sds, z, points = ordinary.results
        if self._points:
            scales = [sd * whitened for sd, whitened in zip(sds, evaluation.whitened_sds, strict=True)]
            self._publish_estimates(row, predictions, sds, scales)
            row.publications.extend(charts.points(time_ns, points))
        changes = shift.update(row, z, away=evaluation.nowhere, points=self._points) if shift.is_active else []
        self._end_row(row, changes, before)
        if self._board.has_unexplained:  # a lasting step
            evaluation.leave_ordinary()
        return True

    def _take_event(self, row: Row, measured: MeasuredRow) -> None:
        """Pass a row that is not ordinary through the stages, one by one, and apply its changes of alarms once."""
        evaluation, modes, time_ns = self.evaluation, self.baselines.modes, row.time_ns
        if evaluation.is_ordinary:
            evaluation.leave_ordinary()
        self._units = measured.units
        if row.restarted:
            self.operation.on_restart()
        self.operation.inputs = measured.inputs
        changes: list[AlarmChange] = []
        seen = CheckRow(time_ns, row.values, measured.units)
        invalid = evaluation.signals.update("signals", seen, changes)
        if True in invalid:
            usable = seen.without(invalid)
            measured.inputs, measured.values = tuple(usable[: self._inputs]), usable[self._inputs :]
        if evaluation.reference is not None and modes.is_judged:
            if row.restarted:
                evaluation.signals.on_restart()
            self._evaluate(measured, changes)
            if not self._board.has_unexplained:
                evaluation.is_ordinary = evaluation.find_ordinary(time_ns, self._sampling)
        else:
            if not modes.is_judged and modes.is_learned:
                evaluation.signals.update("outputs", CheckRow(time_ns, measured.values, measured.units), changes)
            measured.publications.extend(self._board.apply(time_ns, changes))
            if modes.is_judged:
                self._train(measured)
        self.operation.inputs = ()

    def _evaluate(self, row: MeasuredRow, changes: list[AlarmChange]) -> None:
        """Evaluate a row by the stages after its first checks, which have found some changes of alarms."""
        evaluation, memory, time_ns, units = self.evaluation, self.evaluation.memory, row.time_ns, row.units
        reference, signals = evaluation.reference, evaluation.signals
        charts, shift = evaluation.charts, evaluation.shift
        assert reference is not None
        before = len(row.publications)
        if memory.left_out:
            self._mask_signals(row, memory.left_out)
        seen = CheckRow(time_ns, row.values, units)
        stuck = signals.update("outputs", seen, changes)
        if True in stuck:
            row.values = seen.without(stuck)
        values = row.values
        if row.interval.is_gap:  # the input in it is unknown
            evaluation.restart()
        predictions, sds, extrapolation, memory_share = reference.update(row, memory.quarantined)
        z = [(value - prediction) / sd for value, prediction, sd in zip(values, predictions, sds, strict=True)]
        tested = z
        if extrapolation is not None:
            tested = [(value - known) / sd for value, known, sd in zip(values, *extrapolation, strict=True)]
        scales = [sd * whitened for sd, whitened in zip(sds, evaluation.whitened_sds, strict=True)]
        e = innovations(evaluation.whitener_numbers, z)
        if self._points:
            self._publish_estimates(row, predictions, sds, scales)
        memory.rows_watched += 1
        if not self.has_judged:
            judged = (*e, *(tested if shift.is_active else ()), *(values if charts.reads_values else ()))
            self.has_judged = any(map(isfinite, judged))
        quarantined = tuple(signals.update("residuals", CheckRow(time_ns, e, units, scales), changes))
        memory.quarantined = quarantined
        if True in quarantined:
            for whitener, outlier in zip(evaluation.whiteners, quarantined, strict=True):
                if outlier:
                    whitener.reject_last()
        away = evaluation.find_away() if self._board.has_unexplained else evaluation.nowhere
        changes += charts.update(row, e, memory_share, quarantined, scales, away=away, points=self._points)
        if shift.is_active:
            changes += shift.update(row, tested, away=away, points=self._points)
        if reference.has_returned:
            evaluation.restart_residuals()
        if self._board.has_unexplained:
            changes += evaluation.change.update(row, points=self._points)
        self._end_row(row, changes, before, stuck)
        for about, text in reference.obstacles.items():
            if about not in self._noted:
                self._noted.add(about)
                evaluation.notes.append(text)

    def _publish_estimates(
        self, row: MeasuredRow, predictions: Sequence[float], sds: Sequence[float], scales: Sequence[float]
    ) -> None:
        """Publish the reference's estimates, with limits about the value that each prewhitening filter expected."""
        expected, widths = self.evaluation.whitener_numbers["expected"].tolist(), self.evaluation.charts.memory.widths
        limits: list[tuple[float, float, float]] = []
        for prediction, sd, scale, mean, width in zip(predictions, sds, scales, expected, widths, strict=True):
            usual, reach = prediction + sd * mean, scale * width
            limits.append((scale, usual - reach, usual + reach))
        _publish_estimates(row, self._paths, predictions, limits)

    def _end_row(
        self, row: MeasuredRow, changes: list[AlarmChange], before: int, stuck: Sequence[bool] | None = None
    ) -> None:
        """Compare the models, apply the changes of alarms, and let what follows from alarms follow.

        Without flags of stuck sensors it is an ordinary row: causes are not searched, and nothing is learned.
        """
        evaluation, memory, board = self.evaluation, self.evaluation.memory, self._board
        reference, publications = evaluation.reference, row.publications
        assert reference is not None
        if evaluation.drift.wanted:
            is_beside = reference is not self.models
            predictions = self.models.adapt(row) if is_beside or self.models.stays_as_fitted else []
            if is_beside and predictions:
                _publish_estimates(row, self._paths_beside, predictions)
            changes += evaluation.drift.update(row, self.models.predictors)
        if changes:
            publications.extend(board.apply(row.time_ns, changes))
        if stuck is not None and evaluation.suspicion is not None:
            publications.extend(self._search_causes(evaluation.suspicion, row, stuck))
        if stuck is not None or board.has_unexplained:
            reference.set_learning(not board.has_unexplained)
            if not board.has_unexplained:
                memory.incident = None
                evaluation.change.end_incident()
            else:
                if memory.incident is None:
                    memory.incident = TrainingRows([0] * len(self._config.outputs))
                memory.incident.add(row.time_ns, row.inputs, row.values)
        alarms = [item.message for item in publications[before:] if isinstance(item.message, Alarm)]
        if alarms:
            note = evaluation.promises.count_alarms(row.time_ns, memory.rows_watched, alarms, publications)
            evaluation.notes += [note] if note else []

    def _search_causes(self, suspicion: Suspicion, row: MeasuredRow, stuck: Sequence[bool]) -> list[Publication]:
        """Search the causes of alarms; an error there costs the state of the search, and no alarm."""
        try:
            return suspicion.update(row.time_ns, row.inputs, row.values, row.units, list(stuck))
        except Exception as error:  # noqa: BLE001 # the stage's border: alarms are right without it
            self._failures.add("isolation", error, "the search for the cause of this alarm starts again")
            assert self.evaluation.reference is not None
            self.evaluation.start_search(self.evaluation.reference)
            return []

    def _mask_signals(self, row: MeasuredRow, left_out: dict[str, str]) -> None:
        """Mask the signals that are left out, as in the training; note once each that comes after it."""
        for name, value in zip(self._config.signals, (*row.inputs, *row.values), strict=True):
            if left_out.get(name) == NO_VALUE and isfinite(value):
                left_out[name] = "its first value came after the training"
                self.evaluation.notes.append(
                    f"{name} comes now, and is not watched: start the monitor without its state to learn it"
                )
        inputs, outputs = self._config.inputs, self._config.outputs
        row.inputs = tuple(0.0 if name in left_out else x for name, x in zip(inputs, row.inputs, strict=True))
        row.values = [nan if name in left_out else y for name, y in zip(outputs, row.values, strict=True)]

    # --- training and baselines ------------------------------------------------------------------------------

    def _train(self, row: MeasuredRow) -> None:
        """Train with a row, or end the training before it and evaluate it."""
        training, modes, time_ns, period_ns = self.training, self.baselines.modes, row.time_ns, self._sampling.period_ns
        if not self._promise_checked and self._sampling.learned_ns is not None:
            check_promise(self._config, period_ns / MINUTE_NS)
            self._promise_checked = True
        training.start_clock(time_ns)
        is_over = training.share(period_ns, self.baselines.rows_in_other_modes) >= 1.0 or modes.is_resumed
        timed_out = self.evaluation.signals.silence.silent[self._inputs :]
        if is_over and not training.is_open and training.is_enough(timed_out):
            trained = training.finish()
            if not trained.refused:
                self._end_training(time_ns, trained, row.publications)
                self._evaluate(row, [])
                row.publications.extend(self.snapshots(time_ns))
                row.publications.extend(self._promise_messages(time_ns))
                return
            self.evaluation.notes.append(training.refuse(trained.refused, time_ns))
        if predictions := training.add(row):
            _publish_estimates(row, self._paths, predictions)

    def end_training(self, time_ns: int) -> None:
        """End the training with the rows so far; the next row is the first of another run of the plant.

        Raises:
            InputError: there are too few rows to learn from, or no output can be watched.
        """
        trained, period_ns = self.training.finish_early(), self._sampling.period_ns
        self.baselines.end_training(time_ns, trained, period_ns, self._units, at_once=True)

    def _end_training(self, time_ns: int, trained: TrainingResult, publications: list[Publication]) -> None:
        change = self.baselines.end_training(time_ns, trained, self._sampling.period_ns, self._units)
        if change is not None:
            publications.append(Publication(self._baseline_key, change))

    def start(self, trained: TrainingResult) -> None:
        """Start to judge by what was learned elsewhere from the rows so far."""
        self.baselines.start(trained, self._sampling.period_ns)

    def start_run(self) -> None:
        """Expect the first row of another run of the plant, whose times are unrelated to those of the training."""
        self._sampling = SamplingPeriod(learned_ns=self._sampling.learned_ns)
        self.evaluation.restart()
        self.evaluation.release_values()
        self.evaluation.signals.on_restart()

    def _change_baseline(self, time_ns: int, publications: list[Publication]) -> None:
        """Execute the change that holds from a row on, if there is one."""
        change = self.baselines.change(time_ns, self._sampling.period_ns, self._units)
        if change is None:
            return
        publications.append(Publication(self._baseline_key, change))
        if not is_command(change) and self.evaluation.memory.rows_watched:
            publications.extend(self.snapshots(time_ns))
            publications.extend(self._promise_messages(time_ns))

    def snapshots(self, time_ns: int) -> list[Publication]:
        """Snapshots of the promise and of each output's models."""
        if not self._points:
            return []
        return [*self._promise_messages(time_ns), *self.evaluation.model_snapshots(time_ns)]

    def _promise_messages(self, time_ns: int) -> list[Publication]:
        return self.evaluation.promises.messages(time_ns, self.evaluation.memory.rows_watched)


def _publish_estimates(
    row: MeasuredRow,
    paths: Sequence[str],
    predictions: Sequence[float],
    limits: Iterable[tuple[float, float, float]] = repeat((0.0, nan, nan)),
) -> None:
    """Publish estimates of a row's outputs that have a value and a prediction."""
    of_outputs = zip(paths, predictions, row.values, row.units, strict=True)
    for (path, prediction, value, unit), (sd, lower, upper) in zip(of_outputs, limits, strict=False):
        residual = value - prediction
        if isfinite(residual):
            estimate = Estimate(time_ns=row.time_ns, prediction=prediction, residual=residual, unit=unit)
            estimate.residual_sd, estimate.lower_limit, estimate.upper_limit = sd, lower, upper
            row.publications.append(Publication(path, estimate))
