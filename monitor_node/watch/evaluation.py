"""Evaluation of a plant's rows after its training: reference, prewhitening, charts, drift and the search for causes.

An ordinary row is taken by the compiled step. Any other row passes the stages here one by one, with the same numbers.
A reference that learns does so while nothing is wrong: otherwise it would learn a fault as normal.
"""

from collections.abc import Sequence
from math import isfinite, nan

from monitor_node.alarms.alarms import AlarmChange
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.causes.stage import Suspicion, SuspicionMemory, has_causes
from monitor_node.charts.charts import ChartWatch
from monitor_node.charts.drift import DriftWatch
from monitor_node.charts.shift import ShiftWatch
from monitor_node.checks.base import CheckTraining
from monitor_node.checks.stage import SignalChecks
from monitor_node.config import MonitorConfig
from monitor_node.health import Failures
from monitor_node.ingest.alignment import MeasuredRow, Row
from monitor_node.ingest.sampling import SamplingPeriod
from monitor_node.learn.arx_reference import ArxReference
from monitor_node.learn.baseline import NO_VALUE, TrainingResult
from monitor_node.learn.references import Reference
from monitor_node.learn.signal_range import possible_ranges, stated_ranges
from monitor_node.learn.training_rows import TrainingRows
from monitor_node.watch.budget import AlarmBudget
from monitor_node.watch.estimates import chart_limits, estimate_keys, estimates
from monitor_node.watch.pipeline_memory import EvaluationMemory
from monitor_node.watch.power import Watch
from monitor_node.watch.promise import PromiseStage
from monitor_node.watch.row_step import EVENT, VIOLATING, OrdinaryRows
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, Check
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.spc.prewhitening import Prewhitener, Prewhitening, expected_values, innovations
from reactorwatch.stored_state import place_records


class Evaluation:
    """Evaluation of one plant's rows.

    Args:
        config: settings of the monitor.
        board: alarms of the plant; those of the stages are declared here.
        models: identified models.
        model: process model of the plant; None if there is none.
        is_process: True if the plant is known to be the model's, whatever judges it.
        failures: counter of errors in the search for causes.
        promises: stage of the promise of false alarms.

    Attributes:
        ordinary: the compiled step, with the numbers of the stages.
        signals: signal checks.
        promises: stage of the promise of false alarms.
        reference: the reference; None if rows are not evaluated.
        is_process: True if the plant is the model's.
        is_ordinary: True if the compiled step may take the next row, see `row_step`.
        needs_rows: True if there is anything to publish or to update after a row that the compiled step has taken.
        has_judged: True if a chart could judge an evaluated row since this object was made.
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
        failures: Failures,
        promises: PromiseStage,
    ) -> None:
        self._config, self._board, self._models = config, board, models
        self._failures, self.promises, self._points = failures, promises, models.points
        self._inputs = len(config.inputs)
        self._paths, self._paths_beside = estimate_keys(config), estimate_keys(config, ArxReference.kind)
        self._is_process_given = is_process
        self.reference: Reference | None = None
        self.is_ordinary, self.needs_rows = False, True
        self._ranges, self._stated = possible_ranges(config, model), stated_ranges(config)
        self._charts = ChartWatch(config, board)
        self.ordinary = OrdinaryRows(config, self._ranges)
        self.signals = SignalChecks(config, board, self._ranges, self.ordinary.numbers)
        self._use_ranges()
        self._drift = DriftWatch(config, board, publish=self._points)
        self._shift = ShiftWatch(config, board)
        self._budget = AlarmBudget(config, self._charts.design, self.signals, self._shift, self._drift)
        self._suspicion: Suspicion | None = None
        self._whitener_numbers = self.ordinary.numbers["whiteners"][0]
        self._whiteners = [Prewhitener(None, self._whitener_numbers[i : i + 1]) for i in range(len(config.outputs))]
        self._whitened_sds: list[float] = []
        self._memory = self._new_memory()
        self._evaluated = [True] * len(config.outputs)
        self._noted: set[str] = set()
        self.has_judged = False
        self.notes: list[str] = []

    # --- memory ----------------------------------------------------------------------------------------------

    @property
    def memory(self) -> EvaluationMemory:
        """The memory that runs, with what filter and compiled step keep elsewhere; the alarms belong to the board."""
        memory = self._memory
        if self.is_ordinary:
            self._charts.store(self.ordinary.numbers[0])
        memory.reference = None if self.reference is None else self.reference.memory
        memory.until_drift = self._drift.until_next
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
        self._models.resume(memory.predictors, follows=follows)
        self._memory, self._drift.until_next = memory, memory.until_drift
        memory.signals, memory.predictors = self.signals.memory, self._models.predictors
        memory.whiteners = place_records(memory.whiteners, self._whitener_numbers)
        self.promises.promise = memory.promise
        self._leave_out(memory.left_out)
        if memory.reference is None:
            return
        learned = [whitener.autoregression for whitener in self._whiteners]
        self._set_reference(memory.reference.reference(equations, outputs, self._models), learned, memory.suspicion)
        self._charts.resume(memory.charts, self._evaluated)
        self._shift.resume(memory.shift)
        memory.shift = self._shift.memory

    def _new_memory(self) -> EvaluationMemory:
        return EvaluationMemory(
            predictors=self._models.predictors,
            signals=self.signals.memory,
            whiteners=self._whitener_numbers,
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
        unmade = self._charts.design.choose(self._evaluated, trained.e, trained.values)
        self._shift.is_active = trained.responses is not None and not self._config.has_values_only
        trained.checks.extend(
            Check(name="charts", result=f"{alarm} is left out: {why}") for alarm, why in unmade.items()
        )
        period_min = period_ns / MINUTE_NS
        arl0 = self._budget.share(self._evaluated, period_min, trained.checks)
        memory = self._memory
        memory.checks, memory.arl0 = trained.checks, arl0
        self._set_reference(trained.reference, trained.learned)
        for whitener, item in zip(self._whiteners, trained.learned, strict=True):
            whitener.start(item)
        self._charts.start(trained.learned, trained.e, trained.values, arl0)
        self._shift.start(trained.responses if self._shift.is_active else None, trained.z, trained.learned, arl0)
        memory.charts, memory.shift = self._charts.memory, self._shift.memory
        values, e = trained.measured.T.tolist(), trained.e.T.tolist()
        self.signals.start(CheckTraining(values, e, trained.outliers, period_ns, arl0))
        watch = self._watch(trained, units, period_min) if self.promises.states_power else None
        rates = self._budget.alarm_rates(trained, self._evaluated, arl0)
        self.promises.start(rates, self.chance_alarms / arl0, period_min, trained.excess_rate(arl0), watch)
        memory.promise = self.promises.promise
        if not again:
            self.notes += self._drift.start(self._models.predictors, self._evaluated, arl0)
        self.notes += [f"training: {check.result}" for check in trained.checks if check.result != "ok"]

    def _watch(self, trained: TrainingResult, units: Sequence[str], period_min: float) -> Watch:
        return Watch(
            self._config,
            trained.reference,
            trained.learned,
            self._charts.design.detectors(trained.learned, trained.e, self._memory.arl0),
            self._shift.sensitivities,
            self._evaluated,
            dict(zip(self._config.outputs, units, strict=True)),
            period_min,
        )

    def _set_reference(
        self, reference: Reference, learned: list[Prewhitening], suspicion: SuspicionMemory | None = None
    ) -> None:
        """Set the reference for the rows to come; the search for causes goes on from its memory."""
        self.reference = reference
        self._use_ranges()
        self._whitened_sds = [item.sd for item in learned]
        self._start_search(reference, suspicion)
        self.ordinary.start(reference)

    def _use_ranges(self) -> None:
        follows_equations = self.reference is not None and self.reference.follows_equations
        self.is_process = self._is_process_given or follows_equations
        self.signals.use_ranges(self._ranges if self.is_process else self._stated)

    def _leave_out(self, left_out: dict[str, str]) -> None:
        """Exclude signals from monitoring."""
        self._memory.left_out = dict(left_out)
        self._evaluated = [name not in left_out for name in self._config.outputs]

    def stop(self) -> None:
        """Evaluate no rows."""
        self.reference = self._suspicion = None
        self.ordinary.stop()
        self._use_ranges()
        self._memory, self.promises.promise = self._new_memory(), None
        self._leave_out({})

    def restart(self) -> None:
        """Judge the next row without those before it, as after a gap; charts and alarms keep their memory."""
        if self.reference is not None:
            self.reference.restart()
        for whitener in self._whiteners:
            whitener.restart()
        self._shift.restart()
        self.signals.on_gap()

    def restart_charts(self) -> None:
        """Forget the rows seen, in the charts too."""
        self.restart()
        self._charts.restart()
        self.release_values()

    def release_values(self) -> None:
        """Take no value for a possible spike any more."""
        self._memory.quarantined = (False,) * len(self._config.outputs)

    # --- rates -----------------------------------------------------------------------------------------------

    @property
    def chance_alarms(self) -> int:
        """Number of alarms that can be false alarms."""
        return self._budget.count(self._evaluated)

    @property
    def expected_false_alarms(self) -> float:
        """Mean number of false alarms expected so far."""
        memory = self._memory
        return memory.rows_watched * self.chance_alarms / memory.arl0 if memory.arl0 else 0.0

    # --- ordinary rows ---------------------------------------------------------------------------------------

    def find_ordinary(self, time_ns: int, sampling: SamplingPeriod) -> bool:
        """True if the compiled step may take the row after this one; it then finds its numbers."""
        reference, time_min = self.ordinary.reference, time_ns / MINUTE_NS
        if self.ordinary.kalman is None or self._board.has_unexplained or not self._charts.is_ordinary:
            return False
        assert reference is not None
        if (
            self._memory.left_out
            or True in self._memory.quarantined
            or sampling.learned_ns is None
            or sampling.spacing_ns is None
        ):
            return False
        if not (self.signals.is_ordinary and reference.is_ordinary(time_min)):
            return False
        p = self.ordinary.numbers[0]
        if p["timeouts"]["last_ns"][0] != time_ns or not all(item.is_ready for item in self._whiteners):
            return False
        p["last_ns"], p["period_ns"] = time_ns, sampling.learned_ns
        p["time_min"], p["inputs"] = time_min, reference.last_inputs
        self._charts.load(p)
        return True

    def leave_ordinary(self) -> None:
        """Take over into the charts what compiled steps have computed."""
        if self.is_ordinary:
            self._charts.store(self.ordinary.numbers[0])
            self.is_ordinary = False

    def step(self, row: Row) -> bool:
        """Evaluate a row by the compiled step; returns False if it is an event, for which nothing has changed."""
        reference, values, time_min = self.ordinary.reference, row.values, row.time_ns / MINUTE_NS
        assert reference is not None
        verdict = self.ordinary.take(row.time_ns, values)
        if verdict == EVENT:
            return False
        if verdict == VIOLATING:
            self._charts.store_delays(self.ordinary.numbers[0])
        inputs = values[: self._inputs]
        reference.accept_row(time_min, inputs)
        self._memory.rows_watched += 1
        self.has_judged = True
        if self._suspicion is not None:
            self._suspicion.add(time_min, inputs, values[self._inputs :])
        return True

    def publish_step(self, row: MeasuredRow) -> None:
        """Publish a row that the compiled step has taken, and pass it to the stages that the step does not have."""
        before = len(row.publications)
        predictions, sds, z, expected, points = self.ordinary.results
        if self._points:
            scales = [sd * whitened for sd, whitened in zip(sds, self._whitened_sds, strict=True)]
            limits = chart_limits(predictions, sds, scales, expected, self._charts.memory.widths)
            row.publications.extend(estimates(row, self._paths, predictions, limits))
            row.publications.extend(self._charts.points(row.time_ns, points))
        changes = self._shift.update(row, z, points=self._points) if self._shift.is_active else []
        changes += self._update_drift(row)
        if changes:
            row.publications.extend(self._board.apply(row.time_ns, changes))
        self._count_alarms(row, before)
        if self._board.has_unexplained:  # a lasting step
            self.leave_ordinary()
            self._set_learning()
            self._keep_incident(row)

    def _count_alarms(self, row: MeasuredRow, before: int) -> None:
        """Count a row's alarms that chance can raise, among its publications from an index on."""
        alarms = [item.message for item in row.publications[before:] if isinstance(item.message, Alarm)]
        if alarms and (
            note := self.promises.count_alarms(row.time_ns, self._memory.rows_watched, alarms, row.publications)
        ):
            self.notes.append(note)

    # --- events ----------------------------------------------------------------------------------------------

    def update(self, row: MeasuredRow, sampling: SamplingPeriod, changes: list[AlarmChange]) -> None:
        """Evaluate a row, count its false alarms, and find whether the compiled step may take the next one.

        Args:
            row: the row.
            sampling: sampling period.
            changes: changes of alarms that the checks of the row have found.
        """
        before = len(row.publications)
        self.evaluate(row, changes)
        self._count_alarms(row, before)
        self.is_ordinary = self.find_ordinary(row.time_ns, sampling)
        self.needs_rows = self._points or self._drift.wanted or self._shift.is_active

    def evaluate(self, row: MeasuredRow, changes: list[AlarmChange]) -> None:
        """Evaluate a row, stage by stage; its changes of alarms, with those given, are applied once."""
        reference, time_ns, units, publications = self.reference, row.time_ns, row.units, row.publications
        assert reference is not None
        if self._memory.left_out:
            self._mask_signals(row)
        stuck = self.signals.check_values(time_ns, row.values, units, changes)
        if True in stuck:
            row.values = [nan if still else value for value, still in zip(row.values, stuck, strict=True)]
        values = row.values
        if row.interval.is_gap:  # the input in it is unknown
            self.restart()
        predictions, sds, extrapolation = reference.update(
            time_ns, row.inputs, values, self._memory.quarantined, row.interval.missing, follows=row.follows
        )
        z = [(value - prediction) / sd for value, prediction, sd in zip(values, predictions, sds, strict=True)]
        tested = z
        if extrapolation is not None:
            tested = [(value - known) / sd for value, known, sd in zip(values, *extrapolation, strict=True)]
        scales = [sd * whitened for sd, whitened in zip(sds, self._whitened_sds, strict=True)]
        if self._points:
            expected = expected_values(self._whitener_numbers)
            limits = chart_limits(predictions, sds, scales, expected, self._charts.memory.widths)
            publications.extend(estimates(row, self._paths, predictions, limits))
        e = innovations(self._whitener_numbers, z)
        self._memory.rows_watched += 1
        if not self.has_judged:
            judged = (*e, *(tested if self._shift.is_active else ()), *(values if self._charts.reads_values else ()))
            self.has_judged = any(map(isfinite, judged))
        quarantined = tuple(self.signals.check_residuals(time_ns, e, scales, units, changes))
        self._memory.quarantined = quarantined
        if True in quarantined:
            for whitener, outlier in zip(self._whiteners, quarantined, strict=True):
                if outlier:
                    whitener.reject_last()
        changes += self._charts.update(row, e, quarantined, scales, points=self._points)
        if self._shift.is_active:
            changes += self._shift.update(row, tested, points=self._points)
        changes += self._update_drift(row)
        if changes:
            publications.extend(self._board.apply(time_ns, changes))
        if self._suspicion is not None:
            publications.extend(self._search_causes(row, stuck))
        self._set_learning()
        self._keep_incident(row)
        self._note_unjudged(reference)

    def _update_drift(self, row: MeasuredRow) -> list[AlarmChange]:
        if not self._drift.wanted:
            return []
        is_beside = self.reference is not self._models
        if is_beside or self._models.stays_as_fitted:
            predictions = self._models.adapt(row)
            if is_beside and predictions:
                row.publications.extend(estimates(row, self._paths_beside, predictions))
        return self._drift.update(row, self._models.predictors)

    def _set_learning(self) -> None:
        """Let a reference that learns do so while no alarm without a known cause is active."""
        if self.reference is not None:
            self.reference.set_learning(not self._board.has_unexplained)

    def _keep_incident(self, row: MeasuredRow) -> None:
        """Keep the rows since an alarm without a known cause is active."""
        memory = self._memory
        if not self._board.has_unexplained:
            memory.incident = None
            return
        if memory.incident is None:
            memory.incident = TrainingRows([0] * len(self._config.outputs))
        memory.incident.add(row.time_ns, row.inputs, row.values)

    def _start_search(self, reference: Reference, memory: SuspicionMemory | None = None) -> None:
        """Start the search for causes, or go on with it, if there is one."""
        plant, self._suspicion = reference.plant, None
        if plant is not None and has_causes(self._config, plant.equations):
            self._suspicion = Suspicion(self._config, self._board, plant, memory)
        self._memory.suspicion = None if self._suspicion is None else self._suspicion.memory

    def _search_causes(self, row: MeasuredRow, stuck: Sequence[bool]) -> list[Publication]:
        """Search the causes of alarms; an error there costs the state of the search, and no alarm."""
        assert self._suspicion is not None
        try:
            return self._suspicion.update(row.time_ns, row.inputs, row.values, row.units, list(stuck))
        except Exception as error:  # noqa: BLE001 # the stage's border: alarms are right without it
            self._failures.add("isolation", error, "the search for the cause of this alarm starts again")
            assert self.reference is not None
            self._start_search(self.reference)
            return []

    def _note_unjudged(self, reference: Reference) -> None:
        """Note once each reason why rows are not judged."""
        for about, text in reference.obstacles(self._config.inputs):
            if about not in self._noted:
                self._noted.add(about)
                self.notes.append(text)

    def _mask_signals(self, row: MeasuredRow) -> None:
        """Mask the signals that are left out, as in the training; note once each that comes after it."""
        left_out = self._memory.left_out
        for name, value in zip(self._config.signals, (*row.inputs, *row.values), strict=True):
            if left_out.get(name) == NO_VALUE and isfinite(value):
                left_out[name] = "its first value came after the training"
                self.notes.append(
                    f"{name} comes now, and is not watched: start the monitor without its state to learn it"
                )
        row.inputs = tuple(
            0.0 if name in left_out else value for name, value in zip(self._config.inputs, row.inputs, strict=True)
        )
        row.values = [value if evaluated else nan for value, evaluated in zip(row.values, self._evaluated, strict=True)]
