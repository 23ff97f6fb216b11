"""Pipeline of a plant's rows: training, then evaluation.

During training rows are kept, and the identified models are updated with them. Afterwards the reference predicts each
row, and the charts evaluate its prewhitened residuals (`evaluation`). Commands and diagnoses change the baseline by
which rows are judged, and so does a change of the operating mode.
"""

from collections import deque
from collections.abc import Callable

from monitor_node.alarms.alarms import AlarmChange
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.config import DEFAULT, WITHOUT_EQUATIONS, MonitorConfig
from monitor_node.health import NODE, Failures
from monitor_node.ingest.alignment import MeasuredRow, Row
from monitor_node.ingest.sampling import Interval, SamplingPeriod
from monitor_node.learn.arx_reference import ArxReference
from monitor_node.learn.baseline import TrainingResult
from monitor_node.learn.model_update import ModelUpdate, is_command
from monitor_node.learn.signal_range import input_bounds
from monitor_node.learn.training import TIMES_FEWEST, Training
from monitor_node.learn.training_diagnosis import DiagnosisJob, Finding, equations_text
from monitor_node.learn.training_rows import TrainingRows
from monitor_node.watch.baselines import Baselines
from monitor_node.watch.budget import check_promise
from monitor_node.watch.estimates import estimate_keys, estimates, model_snapshots
from monitor_node.watch.evaluation import Evaluation
from monitor_node.watch.operation import Operation
from monitor_node.watch.pipeline_memory import PipelineMemory
from monitor_node.watch.promise import PromiseStage
from monitor_node.watch.row_frame import Records
from monitor_node.watch.row_step import FilterNumbers
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Baseline
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.stored_state import copy_of


class PlantPipeline:
    """Pipeline of one plant.

    Args:
        config: settings of the monitor.
        board: alarms of the plant.
        points: True to publish estimates, chart points and models.
        model: see `Monitor`.
        failures: counter of errors in the search for causes; None: a new one.
        changes: changes of the baseline to come.
        diagnose: diagnoses the training before the first row is evaluated; None: the caller takes `diagnosis_job`.
        promises: stage of the promise of false alarms; None: one that checks and states nothing more.

    Raises:
        InputError: the settings ask for a process model that does not fit the plant's signals.

    Attributes:
        model: process model of the plant; None if there is none.
        evaluation: evaluation of the plant's rows.
        models: identified models.
        operation: operation of the plant, for the texts of alarms.
        baselines: the baseline in force, and those that can be restored.
        model_update: changes of the baseline to come, and the one in force.
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
        self._diagnose = diagnose
        self._failures = Failures() if failures is None else failures
        self._points = points
        self._inputs = len(config.inputs)
        self.model = _model(config, model)
        units = {**config.units, **(self.model.units if self.model is not None else {})}
        self.operation = Operation(config, input_bounds(config, self.model), units)
        board.describe_operation = self.operation.describe
        self._sampling = SamplingPeriod()
        self._promise_checked = False
        self._baseline_key = keys.key(config.plant, keys.BASELINE, NODE)
        self._estimate_keys = estimate_keys(config)
        self._model_keys = [keys.key(config.plant, keys.MODEL, signal) for signal in config.outputs]
        self.models = ArxReference(config, points=points)
        self.evaluation = Evaluation(
            config,
            board,
            self.models,
            model=self.model,
            is_process=model is not None or config.reference == "equations",
            failures=self._failures,
            promises=promises or PromiseStage(config, board, self._failures, points=points),
        )
        self._training = Training(config, self.model, self.models)
        self.model_update = ModelUpdate(config, deque() if changes is None else changes)
        self.baselines = Baselines(config, self.model, self.models, self._training, self.evaluation, self.model_update)

    # --- memory ----------------------------------------------------------------------------------------------

    @property
    def memory(self) -> PipelineMemory:
        """The memory between two rows, composed of those that run; the alarms belong to the board."""
        return PipelineMemory(
            self._sampling,
            self.operation.memory,
            self._training.memory,
            self.evaluation.memory,
            self.baselines.modes,
            self.baselines.kept,
            self.model_update.baseline,
            self.model_update.rows,
            self.model_update.commands,
        )

    def resume(self, memory: PipelineMemory, now_ns: int) -> None:
        """Resume bit-identically from a memory of the same settings; the alarms are restored before.

        Args:
            memory: the memory, which is then the one that runs.
            now_ns: present time, from which the data timeout counts.

        Raises:
            ValueError: the memory is damaged.
        """
        update, baselines = self.model_update, self.baselines
        if set(memory.operation) != set(self.operation.memory):
            raise ValueError(f"the state must be of {sorted(self.operation.memory)}, got {sorted(memory.operation)}")
        self._sampling, self.operation.memory, self._training.memory = (
            memory.sampling,
            memory.operation,
            memory.training,
        )
        baselines.modes, baselines.kept, update.baseline = memory.modes, memory.kept, memory.change
        update.changes.extend(memory.commands)
        update.rows = memory.undiagnosed if self._config.diagnose_training else None
        self.evaluation.resume(memory.evaluation, baselines.equations, now_ns, follows=True)

    def resume_from_alarms(self) -> None:
        """Follow alarms that were set from outside."""
        self.evaluation.leave_ordinary()
        self.evaluation.signals.silence.follow_alarms()

    @property
    def numbers(self) -> tuple[Records, FilterNumbers]:
        """Numbers of the stages and of the filter, each with a first axis of one; of a plant in its normal state."""
        ordinary = self.evaluation.ordinary
        assert ordinary.kalman is not None
        return ordinary.numbers, ordinary.kalman

    @property
    def is_ordinary(self) -> bool:
        """True if the compiled step may take the next row, see `row_step`."""
        return self.evaluation.is_ordinary

    @property
    def watching(self) -> bool:
        """True if rows are evaluated."""
        return self.evaluation.reference is not None

    @property
    def is_judged(self) -> bool:
        """False in a mode in which signals are checked only."""
        return self.baselines.modes.is_judged

    @property
    def reference(self) -> str:
        """Kind of the reference: `equations`, `black-box` or `arx`; empty before there is one."""
        return "" if self.evaluation.reference is None else self.evaluation.reference.kind

    @property
    def newest_reference(self) -> str:
        """Kind of the reference that judges, or judged last; empty before there was one."""
        return self.reference or self.baselines.modes.reference

    @property
    def noise_levels(self) -> dict[str, dict[str, float]] | None:
        """Noise levels of the equations, see `ProcessReference`; None with another reference."""
        reference = self.evaluation.reference
        return None if reference is None else reference.noise_levels

    @property
    def refused_training(self) -> str:
        """Reason why the last refused training was; empty if none was."""
        return self._training.refused

    @property
    def training_rows(self) -> int:
        """Number of rows of the training, after its end."""
        return self._training.trained_rows

    @property
    def trained_share(self) -> float:
        """Share of the training that is done, 0 to 1."""
        return 1.0 if self.watching else self._training.share(self._sampling.period_ns)

    @property
    def expected_false_alarms(self) -> float:
        """Mean number of false alarms expected so far."""
        return self.baselines.expected_false_alarms

    # --- rows ------------------------------------------------------------------------------------------------

    def update(self, row: Row, units: list[str], publications: list[Publication]) -> None:
        """Process a row.

        Args:
            row: values, the inputs first.
            units: units of the outputs.
            publications: list to which publications are added; those before an error are published nevertheless.
        """
        evaluation, time_ns = self.evaluation, row.time_ns
        if self.model_update.changes:
            self._change_baseline(time_ns, publications)
        if self._config.modes and self.baselines.is_mode_change(self.operation.values):
            self._note(self.baselines.change_mode(self.operation.values))
        interval = self._sampling.update(time_ns)
        if evaluation.is_ordinary:
            if not row.restarted and evaluation.step(row):
                if evaluation.needs_rows:
                    evaluation.publish_step(self._split(row, units, interval, publications))
                return
            evaluation.leave_ordinary()
        self._units = units
        if row.restarted:
            self.operation.on_restart()
        measured = self._split(row, units, interval, publications)
        self.operation.inputs = measured.inputs
        changes: list[AlarmChange] = []
        usable = evaluation.signals.check_row(time_ns, row.values, changes)
        measured.inputs, measured.values = usable[: self._inputs], list(usable[self._inputs :])
        if not self.is_judged:
            if self.baselines.modes.is_learned:
                evaluation.signals.check_values(time_ns, measured.values, units, changes)
            publications.extend(self._board.apply(time_ns, changes))
        elif evaluation.reference is None:
            publications.extend(self._board.apply(time_ns, changes))
            self._train(measured)
        else:
            if row.restarted:
                evaluation.signals.on_restart()
            evaluation.update(measured, self._sampling, changes)
        self.operation.inputs = ()

    def _split(self, row: Row, units: list[str], interval: Interval, publications: list[Publication]) -> MeasuredRow:
        """A row for the stages, with inputs and outputs apart."""
        inputs, values = row.values[: self._inputs], list(row.values[self._inputs :])
        follows = interval.follows and not row.restarted
        return MeasuredRow(row.time_ns, inputs, values, units, interval, follows, publications)

    def _train(self, row: MeasuredRow) -> None:
        config, training, time_ns, publications = self._config, self._training, row.time_ns, row.publications
        if not self._promise_checked and self._sampling.learned_ns is not None:
            check_promise(config, self._sampling.period_ns / MINUTE_NS)
            self._promise_checked = True
        training.start_clock(time_ns)
        share = training.share(self._sampling.period_ns, self.baselines.rows_in_other_modes)
        is_over = share >= 1.0 or self.baselines.modes.is_resumed
        timed_out = self.evaluation.signals.silence.silent[self._inputs :]
        if is_over and not training.is_open and training.is_enough(timed_out):
            trained = training.finish()
            if not trained.refused:
                self._end_training(time_ns, trained, publications)
                self.evaluation.evaluate(row, [])
                publications.extend(self.snapshots(time_ns))
                publications.extend(self._promise_messages(time_ns))
                return
            self._note(training.refuse(trained.refused, time_ns))
        if predictions := training.add(row):
            publications.extend(estimates(row, self._estimate_keys, predictions))

    def _note(self, text: str) -> None:
        if text:
            self.evaluation.notes.append(text)

    def snapshots(self, time_ns: int) -> list[Publication]:
        """Snapshots of the promise and of each output's models, see `model_snapshots`."""
        if not self._points:
            return []
        publications, evaluation = self._promise_messages(time_ns), self.evaluation
        snapshots = model_snapshots(
            self._config, self.models.predictors, evaluation.reference, evaluation.memory.checks
        )
        for key, of_output in zip(self._model_keys, snapshots, strict=True):
            for snapshot in of_output:
                snapshot.time_ns = time_ns
                publications.append(Publication(key, snapshot))
        return publications

    def _promise_messages(self, time_ns: int) -> list[Publication]:
        return self.evaluation.promises.messages(time_ns, self.evaluation.memory.rows_watched)

    # --- training --------------------------------------------------------------------------------------------

    def open_training(self) -> None:
        """Train until `end_training`, on all rows until then."""
        self._training.open()

    def end_training(self, time_ns: int) -> None:
        """End the training with the rows so far; the next row is the first of another run of the plant.

        Args:
            time_ns: time of the last row.

        Raises:
            InputError: there are too few rows to learn from, or no output can be watched.
        """
        self._end_training(time_ns, self._training.finish_early(), [])

    def _end_training(self, time_ns: int, trained: TrainingResult, publications: list[Publication]) -> None:
        self._start(trained)
        if self._config.diagnose_training and equations_text(self.model):
            self.model_update.rows = trained.rows
        if self._diagnose is not None and (job := self.diagnosis_job) is not None:
            self.on_finding(self._diagnose(job))
        if not self._change_model(time_ns, publications):
            self._check_training(trained.rows)

    def new_trials(self) -> Callable[[MonitorConfig], "PlantPipeline"]:
        """Learn from the rows so far; returns a function that makes pipelines which start with what was learned.

        Their settings may differ in the false alarms.

        Raises:
            InputError: there are too few rows to learn from, or no output can be watched.
        """
        trained = self._training.finish_early(times=TIMES_FEWEST)
        memory, reference = copy_of(self.memory), copy_of(trained.reference.memory)

        def start(config: MonitorConfig) -> "PlantPipeline":
            pipeline = PlantPipeline(config, Annunciator(config), points=False, model=self.model)
            pipeline.resume(copy_of(memory), 0)
            of_pipeline = reference.reference(pipeline.baselines.equations, config.outputs, pipeline.models)
            pipeline._start(trained._replace(reference=of_pipeline, checks=list(trained.checks)))
            return pipeline

        return start

    def start_run(self) -> None:
        """Expect the first row of another run of the plant, whose times are unrelated to those of the training."""
        self._sampling = SamplingPeriod(learned_ns=self._sampling.learned_ns)
        self.evaluation.restart()
        self.evaluation.release_values()
        self.evaluation.signals.on_restart()

    def _start(self, trained: TrainingResult, *, again: bool = False) -> None:
        """Start to evaluate rows, see `Evaluation.start`."""
        modes = self.baselines.modes
        modes.is_learned, modes.reference = True, trained.reference.kind
        self.evaluation.start(trained, self._sampling.period_ns, self._units, again=again)
        if not again:
            self.operation.end_training()

    def _check_training(self, rows: TrainingRows) -> None:
        """Judge the training by itself."""
        evaluation, reference = self.evaluation, self.evaluation.reference
        if reference is not None:
            model = self.baselines.equations if reference.follows_equations else None
            self._note(evaluation.promises.check(rows, model, reference.kind, evaluation.memory.rows_watched))

    # --- changes of the baseline -----------------------------------------------------------------------------

    @property
    def diagnosis_job(self) -> DiagnosisJob | None:
        """The diagnosis of the training, while it is pending."""
        return self.model_update.job(self.model)

    def on_finding(self, finding: Finding) -> None:
        """Process the result of a diagnosis; a change holds from the next row on."""
        note = self.model_update.resolve(finding)
        reference = self.evaluation.reference
        if finding.equations or (reference is not None and reference.follows_equations):
            self._note(note)

    def _change_baseline(self, time_ns: int, publications: list[Publication]) -> None:
        """Execute the change that holds from a row on, if there is one."""
        if not is_command(self.model_update.changes[0]):
            self._change_model(time_ns, publications)
        elif (change := self.model_update.pop_due(time_ns)) is not None:
            self.evaluation.leave_ordinary()
            self.baselines.execute(change)
            publications.append(Publication(self._baseline_key, change))

    def _change_model(self, time_ns: int, publications: list[Publication]) -> bool:
        """Learn the baseline again with the model of a change, if one holds from this row on; returns True if so."""
        if self.model_update.changes and is_command(self.model_update.changes[0]):
            return False
        change = self.model_update.pop_due(time_ns)
        if change is None or self.model_update.rows is None:
            return False
        self.evaluation.leave_ordinary()
        try:
            trained = self.model_update.relearn(change, self.models)
        except Exception as error:  # noqa: BLE001 # the stage's border: the baseline before is right without it
            self._failures.add("baseline", error, "the plant is judged by the equations as given")
            return False
        if trained is None:
            self._note("the identified models predict the training better; the baseline stays as it is")
            return False
        self._start(trained, again=True)
        self._check_training(trained.rows)
        publications.append(Publication(self._baseline_key, change))
        if (
            self.evaluation.memory.rows_watched
        ):  # the filter stands at the end of the training, and rows have come since
            trained.reference.restart()
            self.evaluation.release_values()
            publications.extend(self.snapshots(time_ns))
            publications.extend(self._promise_messages(time_ns))
        return True


def _model(config: MonitorConfig, model: ProcessModel | None) -> ProcessModel | None:
    """Process model for the plant, as the settings ask for it."""
    if config.reference in ("black-box", "arx") or (model is None and config.process == WITHOUT_EQUATIONS):
        return None
    given, model = model is not None, model or DEFAULT.require_model()
    fits = config.inputs == model.input_names and set(config.outputs) <= set(model.output_names)
    if fits:
        return model
    if config.reference == "auto" and not given:
        return None
    raise InputError(
        f"reference 'equations' needs the signals of {model.name}, inputs {', '.join(model.input_names)} and outputs "
        f"of {', '.join(model.output_names)}, got {', '.join(config.inputs) or 'none'} and "
        f"{', '.join(config.outputs)}; "
        'set reference = "arx"'
    )
