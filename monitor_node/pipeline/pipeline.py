"""Pipeline of a plant's rows: training, then monitoring.

The identified models predict each row and are updated with it. During training the row is kept. Afterwards the
reference predicts it, its residuals are prewhitened, and the charts evaluate them. A reference that learns does so
while nothing is wrong: otherwise it would learn a fault as normal. Where the identified models do not judge, they keep
adapting beside the reference, and their predictions are published beside its own. Their distance from what they were
after the training is charted as drift.
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from math import isfinite, nan

import msgspec
import numpy as np

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.baseline.arx_bank import ArxBank
from monitor_node.baseline.black_box_reference import BlackBoxReference, BlackBoxReferenceState
from monitor_node.baseline.commands import ACCEPT, RESTORE, TRAINED, check_command, is_command
from monitor_node.baseline.model_update import ModelUpdate, ScheduledChange
from monitor_node.baseline.predictor import ArxPredictor, arx_structure
from monitor_node.baseline.references import (
    ArxReference,
    ArxReferenceState,
    ProcessReference,
    ProcessReferenceState,
    Reference,
)
from monitor_node.baseline.signal_range import input_bounds, possible_ranges, stated_ranges
from monitor_node.baseline.training import MOST_REFUSALS, NO_VALUE, Training, TrainingResult, TrainingState
from monitor_node.baseline.training_diagnosis import DiagnosisJob, Finding, equations_text, read_equations
from monitor_node.config import DEFAULT, WITHOUT_EQUATIONS, MonitorConfig
from monitor_node.health.failures import Failures
from monitor_node.health.message import NODE
from monitor_node.ingest.alignment import MeasuredRow, Row
from monitor_node.ingest.sampling import Interval, SamplingPeriod, SamplingState
from monitor_node.isolation.stage import Suspicion, has_causes
from monitor_node.pipeline.operating_modes import OperatingModes, key_of
from monitor_node.pipeline.operation import Operation
from monitor_node.pipeline.pipeline_state import KeptBaseline, ModeTraining, PipelineState, TrainedState
from monitor_node.pipeline.power import Watch
from monitor_node.pipeline.promise_stage import PromiseStage
from monitor_node.pipeline.row_step import EVENT, VIOLATING, FilterNumbers, Records, RowStep, numbers_type
from monitor_node.signal_checks.stage import SignalChecks
from monitor_node.stages.charts import ChartWatch, count_chance_alarms, has_values_only
from monitor_node.stages.drift import DriftWatch
from monitor_node.stages.shift import NAME as SHIFT
from monitor_node.stages.shift import ShiftWatch
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import (
    Baseline,
    BaselineCommand,
    Check,
    Estimate,
    ModelSnapshot,
    Parameter,
)
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.spc import false_alarm_budget
from reactorwatch.spc.charts.parameters import ParameterT2
from reactorwatch.spc.prewhitening import Prewhitener, Prewhitening, innovations
from reactorwatch.spc.training_errors import TrainingErrors
from reactorwatch.stored_state import unpack_numbers, unpack_times

MOST_KEPT = 3
"""Baselines that can be restored; memory stays bounded."""

TIMES_FEWEST = 2
"""Times the fewest rows of a training that a part of it needs to judge the rest: with fewer it is too rough."""


def check_promise(config: MonitorConfig, period_min: float) -> None:
    """Check that charts can keep the promised number of false alarms, with every output monitored.

    Args:
        config: settings of the monitor.
        period_min: sampling period in minutes.

    Raises:
        InputError: charts cannot keep the promise.
    """
    outputs = len(config.outputs)
    of_drift = outputs if ParameterT2.name in config.charts else 0
    alarms = count_chance_alarms(config) + SignalChecks.CHANCE_ALARMS * outputs + of_drift
    false_alarm_budget.promise_per_30_days(config.false_alarms_per_30_days, alarms, period_min)


STEPPED = (ProcessReference, BlackBoxReference)
"""References whose rows the compiled step takes."""


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
        notes: notes to log, oldest first; the caller empties the list.
        rows_watched: number of evaluated rows.
        is_normal: True if the compiled step may take the next row, see `row_step`.
        left_out: signals that are not monitored, with the reason, after the training.
        signals: signal checks.
        operation: operation of the plant, for the texts of alarms.
        training_rows: number of rows of the training, after its end.
        promises: promise of false alarms.
    """

    def __init__(
        self,
        config: MonitorConfig,
        board: Annunciator,
        *,
        points: bool = True,
        model: ProcessModel | None = None,
        failures: Failures | None = None,
        changes: deque[ScheduledChange] | None = None,
        diagnose: Callable[[DiagnosisJob], Finding] | None = None,
        promises: PromiseStage | None = None,
    ) -> None:
        self._config = config
        self._units = [config.units.get(name, "") for name in config.outputs]
        self._update = ModelUpdate(config, deque() if changes is None else changes)
        self._diagnose = diagnose
        self._failures = Failures() if failures is None else failures
        self.promises = promises or PromiseStage(config, self._failures, points=points)
        self._board = board
        self._points = points
        self.model = _model(config, model)
        self._is_process = self._is_process_given = model is not None or config.reference == "equations"
        self._sampling = SamplingPeriod()
        self._charts = ChartWatch(config, board)
        self._numbers: Records = np.zeros(1, numbers_type(config))
        self._ranges, self._stated = possible_ranges(config, self.model), stated_ranges(config)
        self.signals = SignalChecks(config, board, self._ranges, self._numbers)
        self.signals.use_ranges(self._ranges if self._is_process else self._stated)
        units = {**config.units, **(self.model.units if self.model is not None else {})}
        self.operation = Operation(config, input_bounds(config, self.model), units)
        board.describe_operation = self._describe
        self._drift = DriftWatch(config, board, publish=points)
        self._shift = ShiftWatch(config, board)
        self._estimate_keys = [keys.key(config.plant, keys.ESTIMATE, signal) for signal in config.outputs]
        self._arx_keys = [f"{key}/{ArxReference.kind}" for key in self._estimate_keys]
        self._baseline_key = keys.key(config.plant, keys.BASELINE, NODE)
        self._model_keys = [keys.key(config.plant, keys.MODEL, signal) for signal in config.outputs]
        self._refusals = 0
        self._checks: list[Check] = []
        self._reference: Reference | None = None
        self._whiteners: list[Prewhitener] = []
        self._step: RowStep | None = None
        self._kalman: FilterNumbers | None = None
        self._row = np.empty(len(config.signals))
        self._inputs = len(config.inputs)
        self._whitened_sds: list[float] = []
        self._suspicion: Suspicion | None = None
        self._arl0 = 0.0
        self._bank: ArxBank | None = None
        self._quarantined = (False,) * len(config.outputs)
        self._evaluated = [True] * len(config.outputs)
        self._start_training(None)
        self._promise_checked = False
        self._is_training_open = False
        self._kept: list[KeptBaseline] = []
        self._modes = OperatingModes(config) if config.modes else None
        self._incident: Training | None = None
        self.notes: list[str] = []
        self.rows_watched = 0
        self.is_normal = False
        self.training_rows = 0
        self.left_out: dict[str, str] = {}
        self._noted: set[str] = set()

    # --- state -----------------------------------------------------------------------------------------------

    @property
    def state(self) -> PipelineState:
        """A copy of the state between two rows, without the alarms."""
        if self.is_normal:
            self._charts.store(self._numbers[0])
        return PipelineState(
            self._sampling.copy_state(),
            self.signals.state,
            [predictor.state for predictor in self._predictors],
            self._refusals,
            self._began_ns,
            self._update.rows or self._training.state,
            None if self._reference is None else self._trained_state(self._reference),
            self.operation.state,
            list(self._kept),
            b"" if self._reference is not None or self.baseline is None else self.baseline.SerializeToString(),
            None if self._incident is None else self._incident.state,
            None if self._modes is None else msgspec.structs.replace(self._modes.state),
            [command.SerializeToString() for command in self._update.commands],
        )

    def _trained_state(self, reference: Reference) -> TrainedState:
        return TrainedState(
            reference.state,
            [(check.name, check.result) for check in self._checks],
            dict(self.left_out),
            [whitener.state for whitener in self._whiteners],
            self._charts.state,
            None if self._suspicion is None else self._suspicion.state,
            self._arl0,
            list(self._quarantined),
            self.rows_watched,
            self._drift.until_next,
            b"" if self.baseline is None else self.baseline.SerializeToString(),
            self._shift.state,
            self.promises.state,
            None if self._bank is None else self._bank.state,
            self.promises.power,
        )

    def restore(self, state: PipelineState, now_ns: int) -> None:
        """Resume bit-identically from a state of the same settings; the alarms are restored before.

        Args:
            state: the state.
            now_ns: present time, from which the data timeout counts.

        Raises:
            ValueError: the state is damaged.
        """
        self._sampling.state = state.sampling
        self.operation.restore(state.operation)
        self.signals.restore(state.signals, now_ns)
        for predictor, of_predictor in zip(self._predictors, state.predictors, strict=True):
            predictor.restore(of_predictor)
        self._refusals, self._began_ns = state.refusals, state.began_ns
        self._kept = list(state.kept)
        self._update.changes.extend(ScheduledChange(None, Baseline.FromString(item)) for item in state.commands)
        if state.change:
            self._update.baseline = Baseline.FromString(state.change)
        if state.incident is not None:
            self._incident = self._new_incident()
            self._incident.restore(state.incident)
        if self._modes is not None and state.modes is not None:
            self._modes.state = msgspec.structs.replace(
                state.modes, baselines=dict(state.modes.baselines), trainings=dict(state.modes.trainings)
            )
        watched = state.watched
        if watched is None:
            self._training.restore(state.training)
            return
        if state.training.times_ns and self._config.diagnose_training:
            self._update.rows = state.training
        self._restore_training(watched)

    def _restore_training(self, watched: TrainedState) -> None:
        """Resume from the state after a training; the identified models are restored before."""
        if watched.baseline:
            self._update.baseline = Baseline.FromString(watched.baseline)
        self._drift.until_next = watched.until_drift
        self.promises.restore(watched.promise, watched.power)
        self._checks = [Check(name=name, result=result) for name, result in watched.checks]
        learned = [item.learned for item in watched.whiteners]
        outputs = len(self._config.outputs)
        if not len(learned) == len(watched.withheld) == outputs:
            raise ValueError(f"the state must be of {outputs} outputs, got {len(learned)}")
        self._leave_out(watched.left_out)
        self._set_reference(self._restore_reference(watched.reference), learned, watched.arl0)
        self._whiteners = [
            Prewhitener.from_state(item, self._numbers["whiteners"][0, i : i + 1])
            for i, item in enumerate(watched.whiteners)
        ]
        self._charts.restore(watched.charts, self._evaluated)
        if self._bank is not None:
            if watched.bank is None:
                raise ValueError("the state of a plant of many signals must have that of its models")
            self._bank.restore(watched.bank)
        self._shift.restore(watched.shift)
        if (watched.suspicion is None) != (self._suspicion is None):
            raise ValueError("the state must tell of the search for causes as it is set")
        if self._suspicion is not None and watched.suspicion is not None:
            self._suspicion.restore(watched.suspicion)
        self._quarantined, self.rows_watched = tuple(watched.withheld), watched.rows_watched

    def _restore_reference(
        self, state: ProcessReferenceState | BlackBoxReferenceState | ArxReferenceState
    ) -> Reference:
        if isinstance(state, ArxReferenceState):
            for predictor in () if has_values_only(self._config) else self._predictors:
                if not predictor.judges:  # in a state of an earlier version, where the reference judged
                    predictor.start_judging()
            return ArxReference(state)
        if isinstance(state, BlackBoxReferenceState):
            return BlackBoxReference.from_state(state)
        if self.equations is None:
            raise ValueError("the state must be of a plant without a process model")
        return ProcessReference.from_state(state, self.equations, self._config.outputs)

    @property
    def equations(self) -> ProcessModel | None:
        """Process model in force: as given, or as the change of the baseline has it; None: there is none."""
        return self.model if self.baseline is None or not self.baseline.model else read_equations(self.baseline.model)

    @property
    def awaits_diagnosis(self) -> bool:
        """True while the diagnosis of the training is pending."""
        return self._update.is_pending

    @property
    def diagnosis_job(self) -> DiagnosisJob | None:
        """The diagnosis of the training, while it is pending."""
        return self._update.job(equations_text(self.model)) if self._update.is_pending else None

    def on_finding(self, finding: Finding) -> None:
        """Process the result of a diagnosis; a change holds from the next row on."""
        note = self._update.resolve(finding)
        if note and (finding.equations or isinstance(self._reference, ProcessReference)):
            self.notes.append(note)

    @property
    def baseline(self) -> Baseline | None:
        """Change of the model in force; None: the model is as given."""
        return self._update.baseline

    def resume_from_alarms(self) -> None:
        """Follow alarms that were set from outside."""
        self._leave_normal()
        self.signals.silence.resume_from_alarms()

    @property
    def watching(self) -> bool:
        """True if rows are evaluated."""
        return self._reference is not None

    @property
    def is_judged(self) -> bool:
        """False in a mode in which signals are checked only."""
        return self._modes is None or self._modes.state.is_judged

    @property
    def reference(self) -> str:
        """Kind of the reference: `equations`, `black-box` or `arx`; empty before there is one."""
        return "" if self._reference is None else self._reference.kind

    @property
    def newest_reference(self) -> str:
        """Kind of the reference that judges, or judged last; empty before there was one."""
        return self.reference or ("" if self._modes is None else self._modes.state.reference)

    @property
    def noise_levels(self) -> dict[str, dict[str, float]] | None:
        """Noise levels of the equations, see `ProcessReference`; None with another reference."""
        return self._reference.noise_levels if isinstance(self._reference, ProcessReference) else None

    def trained_share(self, last_ns: int | None) -> float:
        """Share of the training that is done after a row, 0 to 1."""
        if self.watching:
            return 1.0
        if self._began_ns is None or last_ns is None:
            return 0.0
        return max(self._config.training_length.share((last_ns - self._began_ns) / MINUTE_NS, self._training.rows), 0.0)

    @property
    def unjudged_rows(self) -> int:
        """Number of rows that a black box did not judge, as it knew too little of the point of operation."""
        return self._reference.unjudged if isinstance(self._reference, BlackBoxReference) else 0

    @property
    def refused_trainings(self) -> int:
        """Number of refused trainings."""
        return self._refusals

    @property
    def opportunities(self) -> float:
        """Number of rows so far, times the alarms that chance can raise in each."""
        return self.rows_watched * self._chance_alarms

    @property
    def expected_false_alarms(self) -> float:
        """Mean number of false alarms expected so far."""
        before = 0.0 if self._modes is None else self._modes.state.expected
        return before + (self.opportunities / self._arl0 if self._arl0 else 0.0)

    def update(self, row: Row, units: list[str], publications: list[Publication]) -> None:
        """Process a row.

        Args:
            row: values, the inputs first.
            units: units of the outputs.
            publications: list to which publications are added; those before an error are published nevertheless.
        """
        time_ns = row.time_ns
        if self._update.changes:
            self._change_baseline(time_ns, publications)
        if self._modes is not None and self._modes.is_change(self.operation.values):
            self._change_mode(self._modes)
        interval = self._sampling.update(time_ns)
        if self.is_normal and not row.restarted and self._step_row(row, units, interval, publications):
            return
        self._leave_normal()
        self._units = units
        if row.restarted:
            self.operation.on_restart()
        measured = self._split_row(row, units, interval, publications)
        self.operation.inputs = measured.inputs
        publications.extend(self.signals.check_row(time_ns, row.values))
        if self._is_process or self._config.bounds:
            usable = self.signals.mask_values(time_ns, row.values, publications)
            measured.inputs, measured.values = usable[: self._inputs], list(usable[self._inputs :])
        if self._modes is not None and not self.is_judged:
            if self._modes.state.is_learned:
                publications.extend(self.signals.check_values(time_ns, measured.values, units))
        elif self._reference is None:
            self._train(measured)
        else:
            if row.restarted:
                self.signals.reset()
            before = len(publications)
            self._evaluate(measured)
            self._note(self.promises.count_alarms(time_ns, self.rows_watched, publications, before))
            self.is_normal = self._find_normal(time_ns)
        self.operation.inputs = ()

    def snapshots(self, time_ns: int) -> list[Publication]:
        """Snapshots of the promise and of each output's models: adaptive, fitted to the training, and the reference.

        The fitted model is only compared with the adaptive one, which is the reference if that is `arx`.
        """
        if not self._points:
            return []
        publications, reference = self.promises.messages(time_ns, self.rows_watched), self._reference
        outputs = zip(self._model_keys, self._config.outputs, self._predictors, strict=True)
        for index, (key, output, predictor) in enumerate(outputs):
            adaptive, fitted = predictor.adaptive_snapshot(), predictor.reference_snapshot()
            judging = _filter_snapshot(reference, output) if isinstance(reference, ProcessReference) else None
            if isinstance(reference, BlackBoxReference):
                judging = reference.snapshot(index, self._config.inputs, self._config.outputs)
            if fitted is not None:
                fitted.held = True
            if adaptive is not None:
                adaptive.reference = isinstance(reference, ArxReference)
            for snapshot in (adaptive if predictor.judges else fitted, judging):
                if snapshot is not None:
                    snapshot.checks.extend(self._checks)
            for snapshot in (adaptive, fitted, judging):
                if snapshot is not None:
                    snapshot.time_ns = time_ns
                    publications.append(Publication(key, snapshot))
        return publications

    # --- training --------------------------------------------------------------------------------------------

    def open_training(self) -> None:
        """Train until `end_training`, on all rows until then."""
        self._is_training_open = True
        self._training.keep_all_rows()

    def end_training(self, time_ns: int) -> None:
        """End the training with the rows so far; the next row is the first of another run of the plant.

        Args:
            time_ns: time of the last row.

        Raises:
            InputError: there are too few rows to learn from, or no output can be watched.
        """
        if not self._training.is_enough([False] * len(self._config.outputs)):
            raise InputError(
                f"must have at least {self._training.fewest_rows} rows with a value of each output to learn from, got "
                f"{self._training.rows} rows"
            )
        rows, self.training_rows = self._training.state, self._training.rows
        trained = self._training.finish(last_chance=True)
        if trained.refused:
            raise InputError(f"there is no output to watch: {trained.refused}")
        self._start(trained)
        self._start_diagnosis(rows)
        if not self._change_model(time_ns, []):
            self._check_training(rows)

    def new_trials(self) -> Callable[[MonitorConfig], "PlantPipeline"]:
        """Learn from the rows so far; returns a function that makes pipelines which start with what was learned.

        Their settings may differ in the false alarms.

        Raises:
            InputError: there are too few rows to learn from, or no output can be watched.
        """
        fewest = TIMES_FEWEST * self._training.fewest_rows
        if self._training.rows < fewest or not self._training.is_enough([False] * len(self._config.outputs)):
            raise InputError(f"must have at least {fewest} rows to be judged by, got {self._training.rows}")
        trained = self._training.finish(last_chance=True)
        if trained.refused:
            raise InputError(trained.refused)
        state, reference = self.state, trained.reference.state

        def start(config: MonitorConfig) -> "PlantPipeline":
            pipeline = PlantPipeline(config, Annunciator(config), points=False, model=self.model)
            pipeline.restore(state, 0)
            pipeline._start(
                trained._replace(reference=pipeline._restore_reference(reference), checks=list(trained.checks))
            )
            return pipeline

        return start

    def start_run(self) -> None:
        """Expect the first row of another run of the plant, whose times are unrelated to those of the training."""
        self._sampling.state = SamplingState(period_ns=self._sampling.state.period_ns)
        self._forget_rows()
        self._quarantined = (False,) * len(self._config.outputs)
        self.signals.reset()

    def _forget_rows(self) -> None:
        """Judge the next row without those before it, as after a gap; charts and alarms keep their memory."""
        if self._reference is not None:
            self._reference.restart()
        for whitener in self._whiteners:
            whitener.restart()
        self._shift.restart()
        self.signals.restart()

    def _start_training(self, time_ns: int | None) -> None:
        config = self._config
        self._began_ns = time_ns
        self._predictors: list[ArxPredictor] = self._new_predictors()
        self._training: Training = Training(config, self.model, self._predictors)

    def _new_predictors(self) -> list[ArxPredictor]:
        structure, forgetting = arx_structure(self._config), self._config.forgetting
        return [ArxPredictor(structure, forgetting, with_snapshots=self._points) for _ in self._config.outputs]

    def _train(self, row: MeasuredRow) -> None:
        config, time_ns, values, publications = self._config, row.time_ns, row.values, row.publications
        if not self._promise_checked and self._sampling.state.period_ns is not None:
            check_promise(config, self._sampling.period_ns / MINUTE_NS)
            self._promise_checked = True
        if self._began_ns is None or time_ns < self._began_ns:
            self._began_ns = time_ns
        share = config.training_length.share((time_ns - self._began_ns) / MINUTE_NS, self._training_rows())
        if self._modes is not None and self._modes.state.is_resumed:
            share = 1.0
        timed_out = self.signals.silence.silent[len(config.inputs) :]
        if share >= 1.0 and not self._is_training_open and self._training.is_enough(timed_out):
            rows, self.training_rows = self._training.state, self._training.rows
            trained = self._training.finish(last_chance=self._refusals >= MOST_REFUSALS)
            if trained.refused:
                self._refusals += 1
                self.notes.append(f"the training starts again: {trained.refused}")
                self._start_training(time_ns)
            else:
                self._start(trained)
                self._start_diagnosis(rows)
                if not self._change_model(time_ns, publications):
                    self._check_training(rows)
                self._evaluate(row)
                publications.extend(self.snapshots(time_ns))
                publications.extend(self.promises.messages(time_ns, self.rows_watched))
                return
        self._training.add(time_ns, row.inputs, values)
        if not self._points:
            self._buffer(row)
        else:
            for key, prediction, value, unit in zip(
                self._estimate_keys, self._predict(row), values, row.units, strict=True
            ):
                residual = value - prediction
                if isfinite(residual):
                    publications.append(Publication(key, _estimate(time_ns, prediction, residual, unit)))

    def _training_rows(self) -> int:
        """Rows of the training so far, those in other modes too, until one is learned."""
        is_learned = self._modes is None or self._modes.state.is_learned
        return self._training.rows + (0 if is_learned or self._modes is None else self._modes.rows)

    def _predict(self, row: MeasuredRow) -> list[float]:
        """Predict each output by its identified model, which is updated with the row."""
        return [
            predictor.update(row.time_ns, row.inputs, value, follows=row.follows)
            for predictor, value in zip(self._predictors, row.values, strict=True)
        ]

    def _predict_by_bank(self, row: MeasuredRow) -> list[float]:
        """Predict each output by its fitted model, for plants of many signals."""
        assert self._bank is not None
        if self._drift.wanted:
            self._buffer(row)
        return self._bank.predict(row.inputs, row.values, follows=row.follows)

    def _update_beside(self, row: MeasuredRow) -> None:
        """Update the identified models beside the reference; publish their predictions."""
        if not self._points:
            self._buffer(row)
            return
        for key, prediction, value, unit in zip(self._arx_keys, self._predict(row), row.values, row.units, strict=True):
            residual = value - prediction
            if isfinite(residual):
                row.publications.append(Publication(key, _estimate(row.time_ns, prediction, residual, unit)))

    def _buffer(self, row: MeasuredRow) -> None:
        """Buffer a row for the identified models, whose predictions nothing needs now."""
        for predictor, value in zip(self._predictors, row.values, strict=True):
            predictor.buffer(row.time_ns, row.inputs, value, follows=row.follows)

    def _leave_out(self, left_out: dict[str, str]) -> None:
        """Exclude signals from monitoring."""
        self.left_out = dict(left_out)
        self._evaluated = [name not in left_out for name in self._config.outputs]

    @property
    def _chance_alarms(self) -> int:
        """Number of alarms that can be false alarms."""
        of_signals = SignalChecks.CHANCE_ALARMS * sum(self._evaluated)
        return (
            self._charts.chance_alarms
            + of_signals
            + self._count_step_tests
            + self._drift.chance_alarms(self._evaluated)
        )

    @property
    def _count_step_tests(self) -> int:
        """Number of tests of lasting steps, each of which chance can raise an alarm of."""
        return sum(self._evaluated) if self._shift.is_active else 0

    def _start_diagnosis(self, rows: TrainingState) -> None:
        if self._config.diagnose_training and equations_text(self.model):
            self._update.rows = rows
        if self._diagnose is not None and (job := self.diagnosis_job) is not None:
            self.on_finding(self._diagnose(job))

    def _check_training(self, rows: TrainingState) -> None:
        """Judge the training by itself."""
        if self._reference is not None:
            model = self.equations if isinstance(self._reference, ProcessReference) else None
            self._note(self.promises.check(rows, model, self._reference.kind, self.rows_watched))

    def _note(self, text: str) -> None:
        if text:
            self.notes.append(text)

    def _describe(self, time_ns: int) -> str:
        """Operation of the plant, and a promise that it does not keep, as the text of an alarm has them."""
        return "; ".join(filter(None, (self.operation.describe(time_ns), self.promises.warning)))

    def _change_baseline(self, time_ns: int, publications: list[Publication]) -> None:
        """Execute the change that holds from a row on, if there is one."""
        if not is_command(self._update.changes[0].baseline):
            self._change_model(time_ns, publications)
        elif (change := self._update.pop_due(time_ns)) is not None:
            self._leave_normal()
            self._execute_change(change)
            publications.append(Publication(self._baseline_key, change))

    def _change_model(self, time_ns: int, publications: list[Publication]) -> bool:
        """Learn the baseline again with the model of a change, if one holds from this row on; returns True if so."""
        if self._update.changes and is_command(self._update.changes[0].baseline):
            return False
        rows, change = self._update.rows, self._update.pop_due(time_ns)
        if change is None or rows is None:
            return False
        self._leave_normal()
        try:
            trained = self._update.relearn(change, self._predictors)
        except Exception as error:  # noqa: BLE001 # the stage's border: the baseline before is right without it
            self._failures.add("baseline", error, "the plant is judged by the equations as given")
            return False
        if trained is None:
            self.notes.append("the identified models predict the training better; the baseline stays as it is")
            return False
        self._start(trained, again=True)
        self._check_training(rows)
        publications.append(Publication(self._baseline_key, change))
        if self.rows_watched:  # the filter stands at the end of the training, and rows have come since
            trained.reference.restart()
            self._quarantined = (False,) * len(self._config.outputs)
            publications.extend(self.snapshots(time_ns))
            publications.extend(self.promises.messages(time_ns, self.rows_watched))
        return True

    # --- commands --------------------------------------------------------------------------------------------

    @property
    def baselines(self) -> list[Baseline]:
        """Baselines that can be restored, the oldest first, then the one in force."""
        return [*(Baseline.FromString(item.change) for item in self._kept), self._in_force]

    @property
    def pending_commands(self) -> int:
        """Number of accepted commands on the baseline that hold from the next row on."""
        return len(self._update.commands)

    @property
    def _in_force(self) -> Baseline:
        return Baseline(what=TRAINED, by=NODE) if self.baseline is None else self.baseline

    def schedule_command(self, command: BaselineCommand) -> Baseline:
        """Schedule a command on the baseline for the next row; returns the change.

        Raises:
            InputError: the command is refused.
        """
        kept = [item.id for item in self.baselines[:-1]]
        change = check_command(command, kept, has_rows=self._began_ns is not None, has_alarm=self._incident is not None)
        self._update.changes.append(ScheduledChange(None, change))
        return change

    def _execute_change(self, change: Baseline) -> None:
        """Execute a command on the baseline: keep the one in force, and train again or restore another."""
        kept = {Baseline.FromString(item.change).id: item for item in self._kept}
        restored = kept.get(change.restored) if change.what == RESTORE else None
        if self._reference is not None:
            kept[self._in_force.id] = self._make_kept_baseline(self._reference)
        self._kept = list(kept.values())[-MOST_KEPT:]
        rows = self._incident.state if change.what == ACCEPT and self._incident is not None else None
        self._incident, self._update.rows = None, None
        if restored is not None:
            change.model = Baseline.FromString(restored.change).model
            self._restore_baseline(restored)
        else:
            self._train_again(change.time_ns, rows)
        self._update.baseline = change

    def _make_kept_baseline(self, reference: Reference) -> KeptBaseline:
        return KeptBaseline(
            self._in_force.SerializeToString(),
            self._trained_state(reference),
            [predictor.state for predictor in self._predictors],
            self.signals.state,
        )

    def _restore_baseline(self, kept: KeptBaseline) -> None:
        """Judge by a baseline that was replaced; its filters and charts start with the next row."""
        self._predictors = self._new_predictors()
        for predictor, state in zip(self._predictors, kept.predictors, strict=True):
            predictor.restore(state)
            predictor.restart()
        self.signals.restore_limits(kept.signals)
        change, self._update.baseline = self._update.baseline, None
        self._restore_training(msgspec.structs.replace(kept.trained, suspicion=None, baseline=b""))
        self._update.baseline = change
        if self._bank is not None:
            self._bank = ArxBank(self._predictors, self._inputs)
        self._forget_rows()
        self._charts.restart()
        self._quarantined = (False,) * len(self._config.outputs)

    def _train_again(self, time_ns: int, rows: TrainingState | None) -> None:
        """Train from a row on, after the given rows."""
        self._stop_judging()
        if self._modes is not None:
            self._modes.state.is_judged, self._modes.state.is_resumed = True, False
        self._start_training(time_ns)
        if rows is None:
            return
        self._training.restore(rows)
        times_ns = unpack_times(rows.times_ns)
        self._began_ns = times_ns[0]
        columns = unpack_numbers(rows.rows, len(self._config.signals))
        for index, predictor in enumerate(self._predictors):
            column = columns[:, self._inputs + index]
            predictor.learn_again(np.array(times_ns) / MINUTE_NS, columns[:, : self._inputs], column)

    def _new_incident(self) -> Training:
        return Training(self._config, self.model, self._predictors)

    def _keep_incident(self, row: MeasuredRow) -> None:
        """Keep the rows since an alarm without a known cause is active."""
        if not self._board.has_unexplained:
            self._incident = None
            return
        if self._incident is None:
            self._incident = self._new_incident()
        self._incident.add(row.time_ns, row.inputs, list(row.values))

    def _start(self, trained: TrainingResult, *, again: bool = False) -> None:
        """Start to evaluate rows.

        Args:
            trained: result of the training.
            again: True if rows are evaluated already, by another model; the drift of the identified models goes on.
        """
        if self._modes is not None:
            self._modes.state.is_learned, self._modes.state.reference = True, trained.reference.kind
        self._leave_out(trained.left_out)
        unmade = self._charts.choose(self._evaluated, trained.e, trained.values)
        self._shift.is_active = trained.responses is not None and not has_values_only(self._config)
        trained.checks.extend(
            Check(name="charts", result=f"{alarm} is left out: {why}") for alarm, why in unmade.items()
        )
        asked, period_min = self._config.false_alarms_per_30_days, self._sampling.period_ns / MINUTE_NS
        promised = self._promise(asked, period_min, trained.checks)
        if asked is None and promised != false_alarm_budget.USUAL_PER_30_DAYS:
            text = (
                f"{promised:.3g} false alarms in 30 days are promised instead of "
                f"{false_alarm_budget.USUAL_PER_30_DAYS:g}: that is the nearest that the charts can keep for "
                f"{self._chance_alarms} alarms and rows every {period_min:.3g} min"
            )
            trained.checks.append(Check(name="promise", result=text))
        arl0 = false_alarm_budget.share_arl0(promised, self._chance_alarms, period_min)
        self._checks = trained.checks
        self._set_reference(trained.reference, trained.learned, arl0)
        self._whiteners = [
            Prewhitener(item, self._numbers["whiteners"][0, i : i + 1]) for i, item in enumerate(trained.learned)
        ]
        if isinstance(trained.reference, ArxReference) and self._bank is None:
            for predictor in self._predictors:
                predictor.start_judging()
        self._charts.start(trained.learned, trained.e, trained.values, self._arl0)
        responses = trained.responses if self._shift.is_active else None
        self._shift.start(responses, trained.z, trained.learned, self._arl0)
        self.signals.start(trained.measured.T.tolist(), trained.e.T.tolist(), self._arl0)
        self.signals.learn_spike_rates(trained.outliers, len(trained.e), self._sampling.period_ns, self._arl0)
        self._start_promise(trained, period_min)
        if not again:
            self.operation.end_training()
            self.notes += self._drift.start(self._predictors, self._evaluated, self._arl0)
        notes = [check.result for check in trained.checks if check.result != "ok"]
        self.notes += [f"training: {note}" for note in notes]

    def _change_mode(self, modes: OperatingModes) -> None:
        """Leave a mode, and judge by what was learned in the next, or go on to learn it."""
        self._leave_normal()
        state, old, began_ns = modes.state, key_of(modes.state.mode), self._began_ns
        if state.is_judged and self._reference is not None:
            state.baselines[old] = self._make_kept_baseline(self._reference)
        elif state.is_judged and self._training.rows:
            state.trainings[old] = ModeTraining(self._training.state, [item.state for item in self._predictors])
        self._incident = None
        state.mode, state.expected = (
            [self.operation.values[name] for name in self._config.modes],
            self.expected_false_alarms,
        )
        new, change = key_of(state.mode), self._update.baseline
        self._stop_judging()
        state.is_judged = not modes.is_startup(state.mode)
        if not state.is_judged:
            return
        if (known := state.baselines.pop(new, None)) is not None:
            self._restore_baseline(known)
            self._update.baseline, state.expected = change, 2.0 * state.expected - self.expected_false_alarms
            return
        begun = state.trainings.pop(new, None)
        state.is_resumed = begun is not None and state.is_learned
        self._start_training(began_ns)
        if begun is not None:
            self._training.restore(begun.rows)
            for predictor, item in zip(self._predictors, begun.predictors, strict=True):
                predictor.restore(item)
                predictor.restart()
        if state.is_learned and not (begun and self._training.is_enough([False] * len(self._config.outputs))):
            state.is_judged = False
            self.notes.append(
                f"{modes.describe()} was not seen in the training: its rows are watched by signal checks only; "
                "`baseline relearn` learns them"
            )

    def _stop_judging(self) -> None:
        """Judge no rows."""
        self._reference = self._step = self._kalman = self._suspicion = self._bank = None
        self._is_process = self._is_process_given
        self.signals.use_ranges(self._ranges if self._is_process else self._stated)
        self._leave_out({})
        self._refusals = self.rows_watched = 0
        self.promises.promise = None

    def _start_promise(self, trained: TrainingResult, period_min: float) -> None:
        """State the promise of false alarms."""
        errors, arl0 = TrainingErrors.draw(len(trained.learned)), self._arl0
        rates = self._charts.relative_rates(trained.learned, trained.e, trained.values, arl0, errors)
        rates += self.signals.relative_rates(trained.learned, self._evaluated, arl0, errors)
        rates += self._drift.chance_alarms(self._evaluated) + self._count_step_tests
        watch = None
        if self.promises.states_power:
            watch = Watch(
                self._config,
                trained.reference,
                self._predictors,
                trained.learned,
                self._charts.detectors(trained.learned, trained.e, arl0),
                self._shift.sensitivities,
                self._evaluated,
                dict(zip(self._config.outputs, self._units, strict=True)),
                period_min,
            )
        excess = trained.after_moves.excess_rate(arl0)
        if isinstance(trained.reference, BlackBoxReference) and trained.reference.weakness:
            # each new set point may raise every alarm, and the next may come within the length of the training
            excess = max(excess, arl0 / len(trained.z))
        self.promises.start(rates / arl0, self._chance_alarms / arl0, period_min, excess, watch)

    def _promise(self, asked: float | None, period_min: float, checks: list[Check]) -> float:
        """False alarms in 30 days that are promised; tests of steps are left out if they would make it impossible."""
        try:
            return false_alarm_budget.promise_per_30_days(asked, self._chance_alarms, period_min)
        except InputError:
            if not self._shift.is_active:
                raise
            self._shift.is_active = False
            why = f"{asked:g} false alarms in 30 days cannot be kept with more alarms"
            checks.append(Check(name=SHIFT, result=f"lasting steps are not tested for: {why}"))
            return false_alarm_budget.promise_per_30_days(asked, self._chance_alarms, period_min)

    def _set_reference(self, reference: Reference, learned: list[Prewhitening], arl0: float) -> None:
        """Set the reference for the rows to come."""
        self._reference, self._arl0 = reference, arl0
        self._is_process = self._is_process_given or isinstance(reference, ProcessReference)
        self.signals.use_ranges(self._ranges if self._is_process else self._stated)
        self._whitened_sds = [item.sd for item in learned]
        self._suspicion = self._new_suspicion(reference)
        self._bank = None
        if isinstance(reference, ArxReference) and has_values_only(self._config):
            self._bank = ArxBank(self._predictors, self._inputs)
        self._kalman = None
        if isinstance(reference, BlackBoxReference):
            self._step = RowStep.of_black_box(self._config, reference, self._ranges)
        else:
            self._step = RowStep.of(self._config, self._reference_model, self._ranges)
        if self._step is not None and isinstance(reference, ProcessReference | BlackBoxReference):
            belief, variances = reference.numbers
            self._kalman = FilterNumbers(belief[None], variances[None])

    @property
    def _reference_model(self) -> ProcessModel | None:
        return self._reference.model if isinstance(self._reference, ProcessReference) else None

    def _new_suspicion(self, reference: Reference) -> Suspicion | None:
        if not (isinstance(reference, ProcessReference) and has_causes(self._config, reference.equations)):
            return None
        return Suspicion(self._config, self._board, reference)

    def _search_causes(self, row: MeasuredRow, stuck: Sequence[bool]) -> list[Publication]:
        """Search the causes of alarms; an error there costs the state of the search, and no alarm."""
        assert self._suspicion is not None
        try:
            return self._suspicion.update(row.time_ns, row.inputs, row.values, row.units, list(stuck))
        except Exception as error:  # noqa: BLE001 # the stage's border: alarms are right without it
            self._failures.add("isolation", error, "the search for the cause of this alarm starts again")
            assert self._reference is not None
            self._suspicion = self._new_suspicion(self._reference)
            return []

    # --- ordinary rows ----------------------------------------------------------------------------------------

    @property
    def numbers(self) -> tuple[Records, FilterNumbers]:
        """Numbers of the stages and of the filter, each with a first axis of one; of a plant in its normal state."""
        assert self._kalman is not None
        return self._numbers, self._kalman

    def _find_normal(self, time_ns: int) -> bool:
        """True if the compiled step may take the row after this one; it then finds its numbers."""
        reference, sampling, time_min = self._reference, self._sampling.state, time_ns / MINUTE_NS
        if self._step is None or self._board.has_unexplained or not self._charts.is_normal:
            return False
        assert isinstance(reference, ProcessReference | BlackBoxReference)
        if self.left_out or True in self._quarantined or sampling.period_ns is None or sampling.spacing_ns is None:
            return False
        if not (self.signals.is_normal and reference.is_normal(time_min)):
            return False
        p = self._numbers[0]
        if p["timeouts"]["last_ns"][0] != time_ns or not all(item.is_ready for item in self._whiteners):
            return False
        p["last_ns"], p["period_ns"] = time_ns, sampling.period_ns
        p["time_min"], p["inputs"] = time_min, reference.last_inputs
        self._charts.load(p)
        return True

    def _leave_normal(self) -> None:
        """Take over into the charts what compiled steps have computed."""
        if self.is_normal:
            self._charts.store(self._numbers[0])
            self.is_normal = False

    def _split_row(
        self, row: Row, units: list[str], interval: Interval, publications: list[Publication]
    ) -> MeasuredRow:
        inputs, values = row.values[: self._inputs], list(row.values[self._inputs :])
        follows = interval.follows and not row.restarted
        return MeasuredRow(row.time_ns, inputs, values, units, interval, follows, publications)

    def _step_row(self, row: Row, units: list[str], interval: Interval, publications: list[Publication]) -> bool:
        """Process a row by the compiled step; returns False if it is an event, for which nothing has changed."""
        assert self._step is not None
        assert self._kalman is not None
        reference = self._reference
        assert isinstance(reference, STEPPED)
        time_ns, time_min = row.time_ns, row.time_ns / MINUTE_NS
        self._row[:] = values = row.values
        verdict = self._step.update(self._numbers, self._kalman, time_ns, time_min, self._row)
        if verdict == EVENT:
            return False
        if verdict == VIOLATING:
            self._charts.store_delays(self._numbers[0])
        reference.accept_row(time_min, values[: self._inputs])
        self.rows_watched += 1
        if self._points or self._drift.wanted or self._shift.is_active:
            self._publish_stages(self._split_row(row, units, interval, publications))
        if self._suspicion is not None:
            self._suspicion.add(time_min, values[: self._inputs], values[self._inputs :])
        return True

    def _publish_stages(self, row: MeasuredRow) -> None:
        """Publish a row that the compiled step has taken, and pass it to the stages that the step does not have."""
        assert self._step is not None
        if self._points:
            self._publish_step(row)
        before = len(row.publications)
        if self._shift.is_active:
            count = len(row.values)
            self._shift.update(row, self._step.work[0]["outputs"][3 * count : 4 * count].tolist(), points=self._points)
        if self._drift.wanted:
            self._update_beside(row)
            row.publications.extend(self._drift.update(row.time_ns, self._predictors))
        self._note(self.promises.count_alarms(row.time_ns, self.rows_watched, row.publications, before))
        if self._board.has_unexplained:  # a lasting step
            self._leave_normal()
            self._set_learning()
            self._keep_incident(row)

    def _publish_step(self, row: MeasuredRow) -> None:
        assert self._step is not None
        work, count = self._step.work[0], len(row.values)
        outputs = work["outputs"].tolist()
        predictions, sds = outputs[:count], outputs[2 * count : 3 * count]
        scales = [sd * whitened for sd, whitened in zip(sds, self._whitened_sds, strict=True)]
        expected = work["expected"].tolist()
        row.publications.extend(self._estimates(row, predictions, sds, scales, expected))
        row.publications.extend(self._charts.points(row.time_ns, work["points"]))

    # --- events -----------------------------------------------------------------------------------------------

    def _evaluate(self, row: MeasuredRow) -> None:
        reference, time_ns, units, publications = self._reference, row.time_ns, row.units, row.publications
        assert reference is not None
        if self.left_out:
            self._note_late_signals(row.inputs, row.values)
            row.inputs = tuple(  # as in the training
                0.0 if name in self.left_out else value
                for name, value in zip(self._config.inputs, row.inputs, strict=True)
            )
            row.values = [
                value if evaluated else nan for value, evaluated in zip(row.values, self._evaluated, strict=True)
            ]
        publications.extend(self.signals.check_values(time_ns, row.values, units))
        stuck = self.signals.invalid()
        if True in stuck:
            row.values = [nan if still else value for value, still in zip(row.values, stuck, strict=True)]
        values = row.values
        if isinstance(reference, ArxReference):
            reference.predictions = self._predict(row) if self._bank is None else self._predict_by_bank(row)
            reference.extrapolation_sds = [predictor.extrapolation_sd for predictor in self._predictors]
        if row.interval.is_gap:  # the input in it is unknown
            self._forget_rows()
        predictions, sds, extrapolation = reference.update(
            time_ns, row.inputs, values, self._quarantined, row.interval.missing
        )
        z = [(value - prediction) / sd for value, prediction, sd in zip(values, predictions, sds, strict=True)]
        tested = z
        if extrapolation is not None:
            tested = [(value - known) / sd for value, known, sd in zip(values, *extrapolation, strict=True)]
        if isinstance(reference, ArxReference) and reference.beyond:
            self._note_inputs_beyond(reference.beyond)
        scales = [sd * whitened for sd, whitened in zip(sds, self._whitened_sds, strict=True)]
        if self._points:
            expected = [whitener.expected_value() for whitener in self._whiteners]
            publications.extend(self._estimates(row, predictions, sds, scales, expected))
        e = innovations(self._numbers["whiteners"][0], z)
        self.rows_watched += 1
        self._quarantined = quarantined = self.signals.check_residuals(time_ns, e, scales, units, publications)
        if True in quarantined:
            for whitener, outlier in zip(self._whiteners, quarantined, strict=True):
                if outlier:
                    whitener.reject_last()
        self._charts.update(row, e, quarantined, scales, points=self._points)
        self._shift.update(row, tested, points=self._points)
        if self._drift.wanted:
            if not isinstance(reference, ArxReference):
                self._update_beside(row)
            publications.extend(self._drift.update(time_ns, self._predictors))
        if self._suspicion is not None:
            publications.extend(self._search_causes(row, stuck))
        self._set_learning()
        self._keep_incident(row)
        if isinstance(reference, BlackBoxReference) and reference.unjudged and reference.kind not in self._noted:
            self._noted.add(reference.kind)
            self.notes.append(
                "rows are not judged while inputs have values that the black box has not learned, and teach it"
            )

    def _set_learning(self) -> None:
        """Let a reference that learns do so while no alarm without a known cause is active."""
        if isinstance(self._reference, BlackBoxReference):
            self._reference.set_learning(not self._board.has_unexplained)
        elif isinstance(self._reference, ArxReference) and self._bank is None:
            for predictor in self._predictors:
                predictor.set_learning(not self._board.has_unexplained)

    def _note_inputs_beyond(self, indices: list[int]) -> None:
        """Note once each input that leaves its range in the training, as rows are not judged then."""
        for name in (self._config.inputs[i] for i in indices):
            if name not in self._noted:
                self._noted.add(name)
                self.notes.append(
                    f"rows are not judged while {name} is beyond its range in the training: the identified model does "
                    "not hold there"
                )

    def _note_late_signals(self, inputs: Sequence[float], values: list[float]) -> None:
        """Note once each signal whose first value arrives after the training."""
        for name, value in zip(self._config.signals, (*inputs, *values), strict=True):
            if self.left_out.get(name) == NO_VALUE and isfinite(value):
                self.left_out[name] = "its first value came after the training"
                self.notes.append(
                    f"{name} comes now, and is not watched: start the monitor without its state to learn it"
                )

    def _estimates(
        self,
        row: MeasuredRow,
        predictions: Sequence[float],
        sds: Sequence[float],
        scales: list[float],
        expected: list[float],
    ) -> Iterator[Publication]:
        """Estimates of a row, with the values that the prewhitening filters expected before it."""
        for index, mean in enumerate(expected):
            prediction, residual = predictions[index], row.values[index] - predictions[index]
            if isfinite(residual):
                usual, reach = prediction + sds[index] * mean, scales[index] * self._charts.widths[index]
                estimate = _estimate(row.time_ns, prediction, residual, row.units[index])
                estimate.residual_sd = scales[index]
                estimate.lower_limit, estimate.upper_limit = usual - reach, usual + reach
                yield Publication(self._estimate_keys[index], estimate)


def _filter_snapshot(reference: ProcessReference, output: str) -> ModelSnapshot:
    """Snapshot of the equations' filter as reference of an output: its noise levels."""
    levels = reference.noise_levels
    sensor = Parameter(name="sensor_sd", value=levels["sensors"][output])
    states = [Parameter(name=f"{name}_sd", value=value) for name, value in levels["states"].items()]
    return ModelSnapshot(structure=reference.kind, parameters=[sensor, *states], reference=True, held=True)


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


def _estimate(time_ns: int, prediction: float, residual: float, unit: str) -> Estimate:
    return Estimate(
        time_ns=time_ns, prediction=prediction, residual=residual, lower_limit=nan, upper_limit=nan, unit=unit
    )
