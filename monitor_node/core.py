"""Monitor of one plant: samples in; estimates, chart points, models, alarms and health out.

A monitor has three phases, by sample time alone: it waits for the first row, it trains, and it monitors (`pipeline`).

Nothing here reads a clock: `now_ns` only gives up-time and the time of health messages. Publications about the plant
follow from its samples and from operators' actions. So a replay reproduces them, value for value.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, cast

import msgspec
from google.protobuf.message import Message

from monitor_node.alarms.annunciator import Annunciator, AnnunciatorMemory
from monitor_node.alarms.commands import COMMANDS as ALARM_COMMANDS
from monitor_node.alarms.commands import execute_command
from monitor_node.checks.signal_checks import SilenceCheck
from monitor_node.config import MonitorConfig
from monitor_node.health import HEARD_AGAIN_NS, NODE, STALL_NS, Failures, ReceiveStats
from monitor_node.ingest.alignment import Row
from monitor_node.ingest.intake import SampleIntake
from monitor_node.ingest.sequence_check import SequenceCheck
from monitor_node.learn.baseline import NO_VALUE
from monitor_node.learn.training_diagnosis import DiagnosisJob, Finding
from monitor_node.monitor_state import (
    MonitorMemory,
    MonitorState,
    OtherSettingsError,
    learning_settings,
    open_state,
    seal_state,
)
from monitor_node.watch.baselines import BASELINE, LIST
from monitor_node.watch.pipeline import PlantPipeline
from monitor_node.watch.promise import PromiseStage
from monitor_node.watch.promise_check import check_training
from monitor_node.watched_process import order_inputs
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Body, DecodeError, Encoded, Publication, decode, decode_command, encode
from reactorwatch.contract.messages_pb2 import Baseline, BaselineCommand, CommandReply, Health, Promise, Sample
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.stored_state import copy_of
from reactorwatch.version import version

COMMANDS: Mapping[str, type[Message]] = {**ALARM_COMMANDS, BASELINE: BaselineCommand}
"""Message type by command."""


class Monitor:
    """Monitor of one plant.

    Args:
        config: settings.
        start_ns: present time.
        points: True to publish estimates and chart points; a back-test does without.
        model: process model, in minutes since 1970-01-01 UTC; None: the nominal reactor.
        diagnose: diagnoses the training before the first row is evaluated; None: the caller takes the pipeline's
            `diagnosis_job`, and hands the result to its `on_finding`.
        power: True to state the deviations that would be seen; None: with points.

    Raises:
        InputError: the settings are inconsistent.

    Attributes:
        intake: makes rows of the samples, and counts what it rejects.
        failures: contained errors of this software.
        alarms: alarms of the plant.
        pipeline: pipeline of the plant's rows.
        memory: what the monitor remembers beside its parts.
        span_ns: time span of the rows, summed over the runs of the plant, since this monitor was made.
        on_row_end: called after each row with its time and the publications because of it; None: not called.
        unconfirmed: the newest publications, which a kill may keep from leaving the process; the caller sets them. They
            are stored with the state.
        stats: statistics by receive time, which a restart resets.
        is_behind: True while messages wait to be processed, as the caller states before a tick.
    """

    def __init__(
        self,
        config: MonitorConfig,
        start_ns: int,
        *,
        points: bool = True,
        model: ProcessModel | None = None,
        diagnose: Callable[[DiagnosisJob], Finding] | None = None,
        power: bool | None = None,
    ) -> None:
        self._power = points if power is None else power
        self.config = config = order_inputs(config, model)
        self._points, self._model, self._diagnose = points, model, diagnose
        self._changes: deque[Baseline] = deque()
        self._republishes_baseline = False
        self.memory = MonitorMemory(
            runs=[SequenceCheck() for _ in config.signals], units=dict.fromkeys(config.signals, "")
        )
        self.failures = Failures(self.memory.failures)
        self._alarms_with_other_settings: AnnunciatorMemory | None = None
        self.alarms = Annunciator(config)
        self.pipeline = self._new_pipeline(self.alarms)
        model_units = {} if self.pipeline.model is None else self.pipeline.model.units
        self.intake = SampleIntake(config, model_units, self.memory, self._on_row, self._on_label)
        self.span_ns = 0
        self.stats = ReceiveStats(start_ns, start_ns)
        self.on_row_end: Callable[[int, list[Publication]], None] | None = None
        self.unconfirmed: list[Publication] = []
        self.is_behind = False
        self._snapshot_ns = int(config.snapshot_min * MINUTE_NS)

    # --- event loop ------------------------------------------------------------------------------------------

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """Process a message on a key of the plant's samples; returns publications."""
        return self.on_messages((message,), now_ns)

    def on_messages(self, messages: Sequence[Encoded], now_ns: int) -> list[Publication]:
        """Process messages on keys of the plant's samples, in order; returns publications."""
        publications: list[Publication] = []
        self.memory.received += len(messages)
        received_ns = min((item.received_ns for item in messages if item.received_ns), default=now_ns)
        if now_ns - received_ns > self.stats.lag_ns:
            self.stats.lag_ns = now_ns - received_ns
        if self.intake.take(messages, publications):
            self._on_receipt(now_ns)
        self.memory.published += len(publications)
        return publications

    def on_sample(self, signal: str, sample: Sample, now_ns: int) -> list[Publication]:
        """Process a sample of one of the plant's signals; returns publications."""
        publications: list[Publication] = []
        if self.intake.take_sample(signal, sample, publications):
            self._on_receipt(now_ns)
        self.memory.published += len(publications)
        return publications

    def on_history_end(self) -> None:
        """End the history query: from now on no sample is one that was processed before a restart."""
        self.intake.end_history()

    def _on_receipt(self, now_ns: int) -> None:
        """Restart the plant's data timeout, as a usable sample has arrived."""
        if now_ns >= self.stats.heard_ns + HEARD_AGAIN_NS:
            self.stats.heard_ns = now_ns
            self.silence.of_plant.on_receipt(now_ns)

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        """Execute an operator's command at the time of the newest row, or refuse it."""
        self.memory.received += 1
        try:
            reply, publications = self._execute(question)
        except (InputError, DecodeError) as error:
            reason = error.reason if isinstance(error, DecodeError) else "command"
            self.intake.rejects.add(reason, f"{question.key}: {error}")
            return CommandReply(accepted=False, text=str(error)), []
        self.memory.published += len(publications)
        return reply, publications

    def _execute(self, question: Encoded) -> tuple[CommandReply, list[Publication]]:
        if question.key != keys.key(self.config.plant, keys.COMMAND, BASELINE):
            return execute_command(self.alarms, question)
        _, command = decode_command(question, COMMANDS)
        assert isinstance(command, BaselineCommand), "the catalogue says so"
        if command.what == LIST:
            baselines = self.pipeline.baselines.all
            return CommandReply(accepted=True, text=f"{len(baselines)} baselines", baselines=baselines), []
        change = self.pipeline.baselines.schedule(command)
        text = f"{change.what} by {change.by}, from the next row on"
        return CommandReply(accepted=True, text=text), []

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Publish health if it is due; raise the alarm of a plant without data."""
        if self.stats.ticked and now_ns - self.next_tick_ns() > STALL_NS:
            self.stats.stalls += 1
        self.stats.ticked = True
        if self.is_behind:
            self.silence.postpone(now_ns)
        publications = self._guard("silence", self.silence.check, now_ns)
        if self._republishes_baseline and self.baseline is not None:
            publications.append(Publication(keys.key(self.config.plant, keys.BASELINE, NODE), self.baseline))
        self._republishes_baseline = False
        self.memory.published += len(publications)
        if now_ns >= self.stats.health_due_ns:
            self.stats.health_due_ns = now_ns + int(self.config.health_period_s * 1e9)
            publications.append(self._health(now_ns, self.phase))
        return publications

    def next_tick_ns(self) -> int:
        """Time when health or the plant's data timeout is due."""
        overdue_ns = self.silence.of_plant.due_ns()
        return self.stats.health_due_ns if overdue_ns is None else min(self.stats.health_due_ns, overdue_ns)

    def on_stop(self, now_ns: int) -> list[Publication]:
        """Publish health for the last time."""
        return [self._health(now_ns, "stopped")]

    # --- state -----------------------------------------------------------------------------------------------

    def to_bytes(self) -> bytes:
        """Serialise the full state. A monitor restored from it produces bit-identical output."""
        state = MonitorState(
            **msgspec.structs.asdict(self.memory),
            settings={},
            alignment=self.intake.aligner.memory,
            board=self.alarms.memory,
            watch=self.pipeline.memory,
            unconfirmed=[encode(item)[:3] for item in self.unconfirmed],
        )
        return seal_state(state, self._learning_settings)

    def from_bytes(self, data: bytes) -> None:
        """Resume from what `to_bytes` of a monitor with the same settings returned.

        Until the history ends, samples that were processed before are dropped, see `SampleIntake.resume`.

        Raises:
            InputError: the bytes are no state; nothing has changed.
            OtherSettingsError: the state is of a monitor with other settings. The first such state gives its alarms,
                which are newer than those of a state that fits afterwards.
        """
        try:
            state = open_state(data, self._learning_settings)
        except OtherSettingsError as error:
            if self._alarms_with_other_settings is None:
                self._alarms_with_other_settings = error.alarms
                self._restore_alarms(error.alarms)
            raise
        self._restore(state)
        if self._alarms_with_other_settings is not None:
            self._restore_alarms(self._alarms_with_other_settings)

    def _restore(self, state: MonitorState) -> None:
        board = Annunciator(self.config)
        try:
            pipeline = self._new_pipeline(board)
            board.restore(state.board)
            pipeline.resume(state.watch, self.stats.start_ns)
            unconfirmed = [
                Publication(key, cast(Body, decode(payload, encoding))) for key, payload, encoding in state.unconfirmed
            ]
        except ValueError as error:
            raise InputError(f"is no state of this software's monitor: {error}") from error
        self.alarms, self.pipeline = board, pipeline
        self._republishes_baseline = True  # it may not have been published before the stop
        self.memory = memory = msgspec.convert(state, MonitorMemory, from_attributes=True)
        self.failures.by_stage = memory.failures
        self.intake.resume(memory, state.alignment)
        self.silence.unusable = memory.unusable
        self.unconfirmed = unconfirmed

    @cached_property
    def _learning_settings(self) -> dict[str, Any]:
        return learning_settings(self.config, self.pipeline.model, points=self._points)

    def _restore_alarms(self, memory: AnnunciatorMemory) -> None:
        """Restore the alarms alone from a copy of their memory.

        Raises:
            InputError: see `Annunciator.restore`; nothing has changed.
        """
        self.alarms.restore(copy_of(memory))
        self.pipeline.resume_from_alarms()

    def schedule(self, baseline: Baseline) -> None:
        """Schedule a recorded change of the baseline for the row that it names."""
        self._changes.append(baseline)

    @property
    def baseline(self) -> Baseline | None:
        """Change of the baseline in force; None: rows are evaluated by the equations as given."""
        return self.pipeline.baselines.update.baseline

    # --- status ----------------------------------------------------------------------------------------------

    @property
    def phase(self) -> str:
        """`waiting` for the first row, `training` or `watching`."""
        if self.memory.first_ns is None:
            return "waiting"
        return "watching" if self.pipeline.watching or not self.pipeline.baselines.modes.is_judged else "training"

    @property
    def rows(self) -> int:
        """Number of rows so far, including incomplete rows."""
        return self.intake.aligner.memory.counts.rows

    @property
    def silence(self) -> SilenceCheck:
        """Data timeouts of the plant and of its signals."""
        return self.pipeline.evaluation.signals.silence

    @property
    def promise(self) -> Promise | None:
        """Promise of false alarms, as it is now; None before the end of the training."""
        promise = self.pipeline.evaluation.promises.promise
        if promise is None:
            return None
        return promise.message(self.memory.last_ns or 0, self.pipeline.evaluation.memory.rows_watched)

    @property
    def excluded_signals(self) -> dict[str, str]:
        """Signals that are not monitored, with the reason: no value came, or the training could not use them."""
        never_came = (signal for signal in self.config.signals if signal not in self.memory.heard_from_ns)
        return dict.fromkeys(never_came, NO_VALUE) | self.pipeline.evaluation.memory.left_out

    @property
    def notes(self) -> list[str]:
        """Notes to log; the caller empties the list."""
        notes, failures = self.pipeline.evaluation.notes, self.failures.notes
        notes += failures
        failures.clear()
        return notes

    # --- rows ------------------------------------------------------------------------------------------------

    def finish(self) -> list[Publication]:
        """Evaluate pending rows, as at the end of a record."""
        publications: list[Publication] = []
        self.intake.finish(publications)
        return publications

    def _on_label(self, signal: str, time_ns: int, value: float) -> None:
        self.pipeline.operation.on_sample(signal, time_ns, value)

    def _on_row(self, row: Row, publications: list[Publication]) -> None:
        memory, time_ns, before = self.memory, row.time_ns, len(publications)
        due_ns = memory.snapshot_due_ns
        if memory.first_ns is None or time_ns < memory.first_ns:
            memory.first_ns = time_ns
        if memory.last_ns is not None and not row.restarted:
            self.span_ns += time_ns - memory.last_ns
        memory.last_ns = time_ns
        try:
            self.pipeline.update(row, self.intake.output_units, publications)
            publications.extend(self.alarms.end_row(time_ns))
        except Exception as error:  # noqa: BLE001 # the plant's border: an error here ends neither node nor fleet
            self._contain("row", error)
        if memory.watching_since_ns is None and self.pipeline.watching:
            memory.watching_since_ns = time_ns
        if due_ns is None or not 0 <= due_ns - time_ns <= self._snapshot_ns:
            memory.snapshot_due_ns = time_ns + self._snapshot_ns
            if due_ns is not None:
                publications.extend(self._guard("models", self.pipeline.snapshots, time_ns))
        if self.on_row_end is not None:
            self.on_row_end(time_ns, publications[before:])

    # --- after an error of this software ---------------------------------------------------------------------

    def _new_pipeline(self, board: Annunciator) -> PlantPipeline:
        pipeline = PlantPipeline(
            self.config,
            board,
            points=self._points,
            model=self._model,
            failures=self.failures,
            changes=self._changes,
            diagnose=self._diagnose,
            promises=PromiseStage(
                self.config, board, self.failures, check=check_training, states_power=self._power, points=self._points
            ),
        )
        pipeline.evaluation.signals.silence.unusable = self.memory.unusable
        return pipeline

    def _guard(self, stage: str, step: Callable[[int], list[Publication]], time_ns: int) -> list[Publication]:
        """Publications of a step at a time; none after an error, which is contained."""
        try:
            return step(time_ns)
        except Exception as error:  # noqa: BLE001 # the plant's border, see `_on_row`
            self._contain(stage, error)
            return []

    def _contain(self, stage: str, error: Exception) -> None:
        """Contain an error: count it and train again, as the pipeline's state may be inconsistent.

        The alarms stay; an active one is cleared when its condition is found to be over.
        """
        self.failures.add(stage, error, "the plant is learned again, its alarms stay")
        self._changes = deque(item for item in self._changes if item.time_ns)  # findings on its training
        notes, before = self.pipeline.evaluation.notes, self.silence.of_plant
        self.pipeline = self._new_pipeline(self.alarms)
        self.pipeline.evaluation.notes, timeout = notes, self.silence.of_plant
        timeout.received_ns, timeout.counted_ns = before.received_ns, before.counted_ns
        self.memory.watching_since_ns = None
        self.pipeline.resume_from_alarms()

    def _health(self, now_ns: int, phase: str) -> Publication:
        memory, stats, counts = self.memory, self.stats, self.intake.aligner.memory.counts
        health = Health(
            time_ns=now_ns,
            node=NODE,
            version=version(),
            phase=phase,
            uptime_s=(now_ns - stats.start_ns) / 1e9,
            received=memory.received,
            published=memory.published,
            refused=self.intake.rejects.total,
            refused_by_reason=self.intake.rejects.by_reason,
            failures=self.failures.by_stage,
            heard_from_ns=memory.heard_from_ns,
            lag_ms=stats.lag_ns / 1e6,
            not_stored=stats.not_stored,
            stalls=stats.stalls,
            lost=counts.lost,
            late=counts.late,
            duplicated=counts.duplicated,
            out_of_order=counts.out_of_order,
            rows=counts.rows,
            incomplete_rows=counts.incomplete_rows,
            reference=self.pipeline.reference,
            training=self.pipeline.trained_share,
        )
        self.stats.lag_ns = 0
        return Publication(keys.key(self.config.plant, keys.HEALTH, NODE), health)
