"""Stages by which a plant's rows are evaluated after its training, from one training to the next.

They are reference, prewhitening, signal checks, charts, tests of lasting steps, drift and the search for causes. The
way of a row through them is the pipeline's (`pipeline`).
"""

from collections.abc import Sequence

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.causes.stage import Suspicion, SuspicionMemory, has_causes
from monitor_node.charts.charts import ChartWatch
from monitor_node.charts.drift import DriftWatch
from monitor_node.charts.shift import ShiftWatch
from monitor_node.checks.base import CheckTraining
from monitor_node.checks.stage import SignalChecks
from monitor_node.config import MonitorConfig
from monitor_node.ingest.rows import SamplingPeriod
from monitor_node.learn.arx import ArxReference
from monitor_node.learn.baseline import TrainingResult
from monitor_node.learn.references import Reference
from monitor_node.learn.signal_range import possible_ranges, stated_ranges
from monitor_node.watch.budget import AlarmBudget
from monitor_node.watch.pipeline_memory import EvaluationMemory
from monitor_node.watch.power import Watch
from monitor_node.watch.promise import PromiseStage
from monitor_node.watch.row_step import OrdinaryRows
from reactorwatch.contract.messages_pb2 import Check
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.spc.prewhitening import Prewhitener, Prewhitening
from reactorwatch.stored_state import place_records


class Evaluation:
    """Stages of the evaluation of one plant's rows.

    Args:
        config: settings of the monitor.
        board: alarms of the plant; those of the stages are declared here.
        models: identified models.
        model: process model of the plant; None if there is none.
        is_process: True if the plant is known to be the model's, whatever judges it.
        promises: stage of the promise of false alarms.

    Attributes:
        memory: memory of the stages; `collect_memory` completes it.
        models: identified models.
        ordinary: the compiled step, with the numbers of the stages.
        signals: signal checks.
        charts: charts.
        drift: drift charts.
        shift: tests of lasting steps.
        promises: stage of the promise of false alarms.
        whiteners: prewhitening filters, one an output.
        whitener_numbers: numbers of these filters, shape (outputs,).
        whitened_sds: standard deviation of each prewhitened residual, in those of the residual.
        reference: the reference; None if rows are not evaluated.
        suspicion: search for causes; None if there is none.
        evaluated: for each output, True if it is evaluated.
        is_process: True if the plant is the model's.
        is_ordinary: True if the compiled step may take the next row, see `row_step`.
        notes: notes to log, oldest first; the caller empties the list.
    """

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
        self._budget = AlarmBudget(config, self.charts.design, self.signals, self.shift, self.drift)
        self.suspicion: Suspicion | None = None
        self.whitener_numbers = self.ordinary.numbers["whiteners"][0]
        self.whiteners = [Prewhitener(None, self.whitener_numbers[i : i + 1]) for i in range(len(config.outputs))]
        self.whitened_sds: list[float] = []
        self.memory = self._new_memory()
        self.evaluated = [True] * len(config.outputs)
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
        memory.shift = self.shift.memory

    def _new_memory(self) -> EvaluationMemory:
        return EvaluationMemory(
            predictors=self.models.predictors,
            signals=self.signals.memory,
            whiteners=self.whitener_numbers,
            quarantined=(False,) * len(self._config.outputs),
        )

    # --- start and stop --------------------------------------------------------------------------------------

    def start(self, trained: TrainingResult, period_ns: float, units: Sequence[str], *, again: bool) -> None:
        """Start to evaluate rows.

        Args:
            trained: result of the training.
            period_ns: sampling period.
            units: units of the outputs.
            again: True if rows are evaluated already, by another model; the drift of the identified models goes on.
        """
        self._leave_out(trained.left_out)
        unmade = self.charts.design.choose(self.evaluated, trained.e, trained.values)
        self.shift.is_active = trained.responses is not None and not self._config.has_values_only
        trained.checks.extend(
            Check(name="charts", result=f"{alarm} is left out: {why}") for alarm, why in unmade.items()
        )
        period_min = period_ns / MINUTE_NS
        arl0 = self._budget.share(self.evaluated, period_min, trained.checks)
        memory = self.memory
        memory.checks, memory.arl0 = trained.checks, arl0
        self._set_reference(trained.reference, trained.learned)
        for whitener, item in zip(self.whiteners, trained.learned, strict=True):
            whitener.start(item)
        self.charts.start(trained.learned, trained.e, trained.values, arl0)
        self.shift.start(trained.responses if self.shift.is_active else None, trained.z, trained.learned, arl0)
        memory.charts, memory.shift = self.charts.memory, self.shift.memory
        values, e = trained.measured.T.tolist(), trained.e.T.tolist()
        self.signals.start(CheckTraining(values, e, trained.outliers, period_ns, arl0))
        watch = self._watch(trained, units, period_min) if self.promises.states_power else None
        rates = self._budget.alarm_rates(trained, self.evaluated, arl0)
        self.promises.start(rates, self.chance_alarms / arl0, period_min, trained.excess_rate(arl0), watch)
        memory.promise = self.promises.promise
        if not again:
            self.notes += self.drift.start(self.models.predictors, self.evaluated, arl0)
        self.notes += [f"training: {check.result}" for check in trained.checks if check.result != "ok"]

    def _watch(self, trained: TrainingResult, units: Sequence[str], period_min: float) -> Watch:
        return Watch(
            self._config,
            trained.reference,
            trained.learned,
            self.charts.design.detectors(trained.learned, trained.e, self.memory.arl0),
            self.shift.sensitivities,
            self.evaluated,
            dict(zip(self._config.outputs, units, strict=True)),
            period_min,
        )

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

    def restart(self) -> None:
        """Judge the next row without those before it, as after a gap; charts and alarms keep their memory."""
        if self.reference is not None:
            self.reference.restart()
        for whitener in self.whiteners:
            whitener.restart()
        self.shift.restart()
        self.signals.on_gap()

    def restart_charts(self) -> None:
        """Forget the rows seen, in the charts too."""
        self.restart()
        self.charts.restart()
        self.release_values()

    def release_values(self) -> None:
        """Take no value for a possible spike any more."""
        self.memory.quarantined = (False,) * len(self._config.outputs)

    # --- rates -----------------------------------------------------------------------------------------------

    @property
    def chance_alarms(self) -> int:
        """Number of alarms that can be false alarms."""
        return self._budget.count(self.evaluated)

    @property
    def expected_false_alarms(self) -> float:
        """Mean number of false alarms expected so far."""
        memory = self.memory
        return memory.rows_watched * self.chance_alarms / memory.arl0 if memory.arl0 else 0.0

    # --- ordinary rows ---------------------------------------------------------------------------------------

    def find_ordinary(self, time_ns: int, sampling: SamplingPeriod) -> bool:
        """True if the compiled step may take the row after this one; it then finds its numbers."""
        reference, time_min = self.ordinary.reference, time_ns / MINUTE_NS
        if reference is None or self._board.has_unexplained or not self.charts.is_ordinary:
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
