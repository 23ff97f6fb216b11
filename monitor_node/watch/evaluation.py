"""Stages by which a plant's rows are evaluated after its training, from one training to the next.

They are reference, prewhitening, signal checks, charts, tests of lasting steps, drift and the search for causes. The
way of a row through them is the pipeline's (`pipeline`).
"""

from collections.abc import Collection, Iterator, Sequence
from typing import Any

import msgspec
import numpy as np

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.causes.stage import Suspicion, SuspicionMemory, has_causes
from monitor_node.charts.chart_design import count_chance_alarms
from monitor_node.charts.charts import ChartsMemory, ChartWatch
from monitor_node.charts.shift_and_drift import NAME as SHIFT
from monitor_node.charts.shift_and_drift import ChangeWatch, DriftWatch, ShiftWatch
from monitor_node.checks.base import CheckTraining
from monitor_node.checks.signal_checks import SignalChecks
from monitor_node.config import MonitorConfig
from monitor_node.ingest.alignment import SamplingPeriod
from monitor_node.learn.arx import ArxMemory, ArxPredictor, ArxReference
from monitor_node.learn.arx_fit import adaptive_snapshot
from monitor_node.learn.baseline import TrainingResult
from monitor_node.learn.black_box_reference import BlackBoxMemory
from monitor_node.learn.process_reference import ProcessMemory
from monitor_node.learn.references import Reference
from monitor_node.learn.training_rows import TrainingRows
from monitor_node.watch.power import Watch
from monitor_node.watch.promise import PlantPromise, PromiseStage, share_budget
from monitor_node.watch.row_step import OrdinaryRows
from monitor_node.watched_process import possible_ranges, stated_ranges
from reactorwatch.arrays import Array
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Baseline, Check, ModelSnapshot
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.spc import false_alarm_budget
from reactorwatch.spc.charts.parameters import ParameterT2
from reactorwatch.spc.detection import error_factor
from reactorwatch.spc.false_alarm_budget import TrainingErrors
from reactorwatch.spc.level_change import LevelChange
from reactorwatch.spc.prewhitening import Prewhitener, Prewhitening
from reactorwatch.stored_state import Memory, Records, place_records


class EvaluationMemory(Memory, kw_only=True):
    """Memory of what judges the rows: in force, of an earlier baseline that can be restored, or of another mode.

    Attributes:
        predictors: identified models, one an output.
        signals: memory of each signal check by name; as it was read, until the checks go on from it.
        whiteners: prewhitening filters, one an output, see `WHITENER`.
        quarantined: one flag an output: its newest value may be a spike.
        reference: memory of the reference; None before the end of the training.
        checks: checks of the training.
        left_out: signals that are not monitored, with the reason.
        charts: memory of the charts.
        shift: tests for lasting steps, one an output, see `STEP_TEST`; None without them.
        level_change: test for changes within an incident; None without it.
        suspicion: memory of the search for causes; None if there is none.
        promise: the promise of false alarms.
        arl0: in-control run length of each alarm, in rows; 0 before the end of the training.
        rows_watched: number of evaluated rows.
        until_drift: number of rows until the next drift point.
        incident: rows since an alarm without a known cause is active; None: there is none.
        change: change of the baseline by which it came into force; None: the first training.
        training: rows of its training, of a mode that was left before the end; None else.
    """

    predictors: list[ArxPredictor]
    signals: dict[str, Any]
    whiteners: Records
    quarantined: tuple[bool, ...]
    reference: ProcessMemory | BlackBoxMemory | ArxMemory | None = None
    checks: list[Check] = msgspec.field(default_factory=list)
    left_out: dict[str, str] = msgspec.field(default_factory=dict)
    charts: ChartsMemory = msgspec.field(default_factory=ChartsMemory)
    shift: Records | None = None
    level_change: LevelChange | None = None
    suspicion: SuspicionMemory | None = None
    promise: PlantPromise | None = None
    arl0: float = 0.0
    rows_watched: int = 0
    until_drift: int = 0
    incident: TrainingRows | None = None
    change: Baseline | None = None
    training: TrainingRows | None = None


class Evaluation:
    """Stages of the evaluation of one plant's rows."""

    def __init__(
        self,
        config: MonitorConfig,
        board: Annunciator,
        models: ArxReference,
        *,
        model: ProcessModel | None,
        is_process: bool,
        promises: PromiseStage,
    ) -> None:
        self._config, self._board, self.models = config, board, models
        self.promises, self._is_process_given = promises, is_process
        self.reference: Reference | None = None
        self.is_ordinary = False
        self._ranges, self._stated = possible_ranges(config, model), stated_ranges(config)
        self.charts = ChartWatch(config, board)
        self.ordinary = OrdinaryRows(config, self._ranges)
        self.signals = SignalChecks(config, board, self._ranges, self.ordinary.numbers)
        self._use_ranges()
        self.drift = DriftWatch(config, board, publish=models.points)
        self.shift = ShiftWatch(config, board)
        self.change = ChangeWatch(config, board)
        self.suspicion: Suspicion | None = None
        self.whitener_numbers = self.ordinary.numbers["whiteners"][0]
        self.whiteners = [Prewhitener(None, self.whitener_numbers[i : i + 1]) for i in range(len(config.outputs))]
        self.whitened_sds: list[float] = []
        self.memory = self._new_memory()
        self.evaluated = [True] * len(config.outputs)
        self.nowhere = [False] * len(config.outputs)
        self.notes: list[str] = []

    # --- memory ----------------------------------------------------------------------------------------------

    def collect_memory(self) -> EvaluationMemory:
        """The memory, into which it takes over what the filter and the compiled step keep elsewhere."""
        memory = self.memory
        if self.is_ordinary:
            self.charts.store(self.ordinary.numbers[0])
        memory.reference = None if self.reference is None else self.reference.memory
        memory.until_drift = self.drift.until_next
        return memory

    def resume(
        self, memory: EvaluationMemory, equations: ProcessModel | None, now_ns: int | None = None, *, follows: bool
    ) -> None:
        """Go on from a memory of the same settings, which is then the one that runs; the alarms are restored before.

        Args:
            memory: the memory, as it was read.
            equations: process model in force; None: there is none.
            now_ns: present time, from which the data timeout counts; None: the data timeouts stay as they are.
            follows: True if the next row follows the ones before.

        Raises:
            ValueError: the memory is damaged, or of other settings.
        """
        outputs = self._config.outputs
        if len(memory.quarantined) != len(outputs):
            raise ValueError(f"the state must be of {len(outputs)} outputs, got {len(memory.quarantined)}")
        self.signals.resume(memory.signals, now_ns)
        self.models.resume(memory.predictors, follows=follows)
        self.memory, self.drift.until_next = memory, memory.until_drift
        memory.signals, memory.predictors = self.signals.memory, self.models.predictors
        memory.whiteners = place_records(memory.whiteners, self.whitener_numbers)
        self.promises.promise = memory.promise
        self._leave_out(memory.left_out)
        if memory.reference is None:
            return
        learned = [whitener.autoregression for whitener in self.whiteners]
        self._set_reference(memory.reference.reference(equations, outputs, self.models), learned, memory.suspicion)
        self.charts.resume(memory.charts, self.evaluated)
        self.shift.resume(memory.shift)
        memory.shift, self.change.memory = self.shift.memory, memory.level_change

    def _new_memory(self) -> EvaluationMemory:
        return EvaluationMemory(
            predictors=self.models.predictors,
            signals=self.signals.memory,
            whiteners=self.whitener_numbers,
            quarantined=(False,) * len(self._config.outputs),
        )

    # --- start and stop --------------------------------------------------------------------------------------

    def start(self, trained: TrainingResult, period_ns: float, *, again: bool, excessive: Collection[str] = ()) -> None:
        """Start to evaluate rows, or `again` by another model: the drift of the identified models then goes on.

        Args:
            trained: result of the training.
            period_ns: sampling period.
            again: see above.
            excessive: charts that break the promise in the training, and are left out.
        """
        self._leave_out(trained.left_out)
        design, checks = self.charts.design, list(trained.checks)
        design.is_identified = trained.reference.is_identified
        design.memory_shares = np.ones(1) if trained.extrapolation is None else trained.extrapolation.memory_shares
        unmade = design.choose(
            self.evaluated, trained.e, trained.values, has_equations=trained.reference.follows_equations
        )
        design.chosen = [name for name in design.chosen if name not in excessive]
        unmade |= dict.fromkeys(
            excessive, "in the second half of the training it broke the promise; the others have its false alarms"
        )
        self.shift.is_active = trained.responses is not None and not self._config.has_values_only
        checks += [Check(name="charts", result=f"{alarm} is left out: {why}") for alarm, why in unmade.items()]
        period_min = period_ns / MINUTE_NS
        arl0 = self._share_budget(period_min, checks)
        memory, trained = self.memory, self._widen(trained, arl0)
        memory.checks, memory.arl0 = checks, arl0
        self._set_reference(trained.reference, trained.learned)
        for whitener, item in zip(self.whiteners, trained.learned, strict=True):
            whitener.start(item)
        self.charts.start(trained.learned, trained.e, trained.values, arl0)
        self.shift.start(trained.responses if self.shift.is_active else None, trained.z, trained.learned, arl0)
        self.change.start(trained.values[:, len(self._config.inputs) :])
        memory.charts, memory.shift, memory.level_change = self.charts.memory, self.shift.memory, self.change.memory
        values, e = trained.measured.T.tolist(), trained.e.T.tolist()
        self.signals.start(CheckTraining(values, e, trained.outliers, period_ns, arl0))
        rates, mean_rate = self._alarm_rates(trained, arl0), self.chance_alarms / arl0
        self.promises.start(rates, mean_rate, period_min, trained.excess_rate(arl0, self.chance_alarms))
        memory.promise = self.promises.promise
        if not again:
            self.notes += self.drift.start(self.models.predictors, self.evaluated, arl0)
        told = [f"training: {check.result}" for check in checks if check.result != "ok"]
        self.notes += [note for note in told if note not in self.notes]

    def _widen(self, trained: TrainingResult, arl0: float) -> TrainingResult:
        """Training with wider limits, where the reference errs.

        Correlations of such errors do not last: charts of all outputs are made from rows that have none, as each output
        has those of another time.
        """
        if not trained.reference.errs:
            return trained
        rows, outputs = trained.e.shape
        e = np.column_stack([np.roll(column, i * rows // outputs) for i, column in enumerate(trained.e.T)])
        detectors = self.charts.design.detectors(trained.learned, e, arl0)
        return trained.widen(error_factor(trained.e, detectors, arl0), e)

    def check_training(
        self, trained: TrainingResult, model: ProcessModel | None, period_ns: float, units: Sequence[str]
    ) -> None:
        """Judge the training by itself, and state the power of the watch that has started with it.

        Charts that break the promise in it are left out.
        """
        check, watch = self.promises.check(trained, model), None
        if check.excessive:
            self.start(trained, period_ns, again=True, excessive=check.excessive)
        trained = self._widen(trained, self.memory.arl0)
        if self.promises.states_power:
            watch = Watch(
                self._config,
                trained.reference,
                trained.learned,
                self.charts.design.detectors(trained.learned, trained.e, self.memory.arl0),
                self.charts.design.level_reaches(trained.values, self.memory.arl0),
                self.shift.sensitivities,
                (1.0,) if trained.extrapolation is None else trained.extrapolation.usual_sds,
                self.evaluated,
                dict(zip(self._config.outputs, units, strict=True)),
                period_ns / MINUTE_NS,
            )
        note = self.promises.conclude(check, watch, trained.rows, self.memory.rows_watched)
        self.notes += [note] if note else []

    def _set_reference(
        self, reference: Reference, learned: list[Prewhitening], suspicion: SuspicionMemory | None = None
    ) -> None:
        """Set the reference for the rows to come; the search for causes goes on from its memory."""
        self.reference = reference
        self._use_ranges()
        self.whitened_sds = [item.sd for item in learned]
        self.start_search(reference, suspicion)
        self.ordinary.start(reference)

    def start_search(self, reference: Reference, memory: SuspicionMemory | None = None) -> None:
        """Start the search for causes, or go on with it, if there is one."""
        plant, self.suspicion = reference.plant, None
        if plant is not None and has_causes(self._config, plant.equations):
            self.suspicion = Suspicion(self._config, self._board, plant, memory)
        self.memory.suspicion = None if self.suspicion is None else self.suspicion.memory

    def _use_ranges(self) -> None:
        follows_equations = self.reference is not None and self.reference.follows_equations
        self.is_process = self._is_process_given or follows_equations
        self.signals.use_ranges(self._ranges if self.is_process else self._stated)

    def _leave_out(self, left_out: dict[str, str]) -> None:
        """Exclude signals from monitoring."""
        self.memory.left_out = dict(left_out)
        self.evaluated = [name not in left_out for name in self._config.outputs]

    def stop(self) -> None:
        """Evaluate no rows."""
        self.reference = self.suspicion = None
        self.ordinary.stop()
        self._use_ranges()
        self.memory, self.promises.promise = self._new_memory(), None
        self._leave_out({})

    def find_away(self) -> list[bool]:
        """For each output, True if it is not yet back: by its level up to the row before, or else by the reference."""
        levels = self.charts.away
        if levels is not None or self.reference is None:
            return levels or self.nowhere
        return [self.reference.is_away] * len(self.nowhere)

    def restart(self) -> None:
        """Judge the next row without those before it, as after a gap; charts and alarms keep their memory."""
        if self.reference is not None:
            self.reference.restart()
        for whitener in self.whiteners:
            whitener.restart()
        self.shift.restart()
        self.change.restart()
        self.signals.on_gap()

    def restart_residuals(self) -> None:
        """Judge the next row without the residuals before it, which were those of a fault that is over."""
        for whitener in self.whiteners:
            whitener.restart()
        self.charts.restart()

    def restart_charts(self) -> None:
        """Forget the rows seen, in the charts too."""
        self.restart()
        self.charts.restart()
        self.release_values()

    def release_values(self) -> None:
        """Take no value for a possible spike any more."""
        self.memory.quarantined = (False,) * len(self._config.outputs)

    # --- models ----------------------------------------------------------------------------------------------

    def model_snapshots(self, time_ns: int) -> Iterator[Publication]:
        """Snapshots of each output's models: adaptive, fitted to the training, and the reference.

        The fitted model is only compared with the adaptive one, which is the reference if that is `arx`.
        """
        inputs, outputs, reference = self._config.inputs, self._config.outputs, self.reference
        for index, (signal, predictor) in enumerate(zip(outputs, self.models.predictors, strict=True)):
            adaptive, stored = adaptive_snapshot(predictor), predictor.reference_model
            fitted = ModelSnapshot.FromString(stored) if stored else None
            judging = None if reference is None else reference.snapshot(index, inputs, outputs)
            if fitted is not None:
                fitted.held = True
            if adaptive is not None:
                adaptive.reference = reference is not None and reference.is_identified
            for snapshot in (adaptive if predictor.judges else fitted, judging):
                if snapshot is not None:
                    snapshot.checks.extend(self.memory.checks)
            for snapshot in (adaptive, fitted, judging):
                if snapshot is not None:
                    snapshot.time_ns = time_ns
                    yield Publication(keys.key(self._config.plant, keys.MODEL, signal), snapshot)

    # --- budget of false alarms ------------------------------------------------------------------------------

    @property
    def chance_alarms(self) -> int:
        """Number of alarms that can be false alarms: they share the promised ones."""
        of_signals = SignalChecks.CHANCE_ALARMS * sum(self.evaluated)
        return self.charts.design.chance_alarms + of_signals + self._count_tests()

    def _count_tests(self) -> int:
        """Number of tests of lasting steps and of drift charts, each of which chance can raise an alarm of."""
        of_steps = sum(self.evaluated) if self.shift.is_active else 0
        return of_steps + self.drift.chance_alarms(self.evaluated)

    def _share_budget(self, period_min: float, checks: list[Check]) -> float:
        """In-control run length of each alarm, in rows; lasting steps are not tested for where that is in the way.

        Raises:
            InputError: the charts cannot keep the rate that the settings ask for.
        """
        asked = self._config.false_alarms_per_30_days
        try:
            return share_budget(asked, self.chance_alarms, period_min, checks)
        except InputError:
            if not self.shift.is_active:
                raise
        self.shift.is_active = False
        why = f"{asked:g} false alarms in 30 days cannot be kept with more alarms"
        checks.append(Check(name=SHIFT, result=f"lasting steps are not tested for: {why}"))
        return share_budget(asked, self.chance_alarms, period_min, checks)

    def _alarm_rates(self, trained: TrainingResult, arl0: float) -> Array:
        """False alarms a row by the errors that the training may have made, shape (draws,)."""
        errors = TrainingErrors.draw(len(trained.learned))
        rates = self.charts.design.relative_rates(trained.learned, trained.e, trained.values, arl0, errors)
        rates += self.signals.relative_rates(trained.learned, self.evaluated, arl0, errors)
        rates += self._count_tests()
        return rates / arl0

    @property
    def expected_false_alarms(self) -> float:
        """Mean number of false alarms expected so far."""
        memory = self.memory
        return memory.rows_watched * self.chance_alarms / memory.arl0 if memory.arl0 else 0.0

    # --- ordinary rows ---------------------------------------------------------------------------------------

    def find_ordinary(self, time_ns: int, sampling: SamplingPeriod) -> bool:
        """True if the compiled step may take the row after this one, while no alarm is active; fills its numbers."""
        reference, time_min = self.ordinary.reference, time_ns / MINUTE_NS
        if reference is None or not self.charts.is_ordinary:
            return False
        if self.memory.left_out or True in self.memory.quarantined:
            return False
        if sampling.learned_ns is None or sampling.spacing_ns is None:
            return False
        if not (self.signals.is_ordinary and reference.is_ordinary(time_min)):
            return False
        p = self.ordinary.numbers[0]
        if p["timeouts"]["last_ns"][0] != time_ns or not all(item.is_ready for item in self.whiteners):
            return False
        p["last_ns"], p["period_ns"] = time_ns, sampling.learned_ns
        p["time_min"], p["inputs"] = time_min, reference.last_inputs
        self.charts.load(p)
        return True

    def leave_ordinary(self) -> None:
        """Take over into the charts what compiled steps have computed."""
        if self.is_ordinary:
            self.charts.store(self.ordinary.numbers[0])
            self.is_ordinary = False


def check_promise(config: MonitorConfig, period_min: float) -> None:
    """Check that charts can keep the promised number of false alarms, with every output monitored.

    Raises:
        InputError: charts cannot keep the promise.
    """
    outputs = len(config.outputs)
    of_drift = outputs if ParameterT2.name in config.charts else 0
    alarms = count_chance_alarms(config) + SignalChecks.CHANCE_ALARMS * outputs + of_drift
    false_alarm_budget.promise_per_30_days(config.false_alarms_per_30_days, alarms, period_min)
