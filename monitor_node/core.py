"""The watch over one plant: samples in; estimates, chart points, models, alarms and health out.

A plant's life with its monitor has three phases, told by the time of the samples alone: it waits for the first row, it
is in training, and it watches (see `watch`).

Nothing here reads a clock: `now_ns` only counts up-time and says when health is due. What is published about the
plant follows from the samples and from what people said of its alarms, so a replay of a run in which nobody said
anything says the same, value for value.
"""

from collections.abc import Iterable
from typing import Any

from monitor_node.alarms.annunciator import AlarmBoard
from monitor_node.alarms.commands import obey
from monitor_node.baseline.training import NO_VALUE
from monitor_node.config import MonitorConfig
from monitor_node.failures import Failures
from monitor_node.health import NODE, health_of
from monitor_node.ingest.alignment import Aligner, Row
from monitor_node.ingest.receive_stats import HEARD_AGAIN_NS, STALL_NS, Receipt
from monitor_node.ingest.rejects import Refusals
from monitor_node.ingest.replay_filter import ToldAgain
from monitor_node.ingest.sample_limits import LARGEST_NUMBER, LARGEST_SAMPLE, LARGEST_VALUE, USABLE, unusable
from monitor_node.ingest.sequence_check import Held, SampleRun
from monitor_node.pipeline import PlantWatch
from monitor_node.state.monitor_state import MonitorState, opened, sealed, settings_of
from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode
from reactorwatch.contract.messages_pb2 import Alarm, CommandReply, Sample
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS


class Monitor:
    """The monitor of one plant.

    Args:
        config: how it is watched.
        start_ns: now.
        points: whether estimates and points of charts are published; a back-test does without.
        model: whose equations the process reference is, in minutes since 1970-01-01 UTC; None: the nominal reactor.

    Raises:
        InputError: settings that do not fit together.

    Attributes:
        refusals: what could not be used.
        failures: errors of this software in the work on the plant.
        alarms: of the plant.
        first_ns: time of the first row; None before it.
        last_ns: time of the last row; None before the first.
        span_ns: that the rows span, summed over the runs of the plant, since this monitor was made.
        received: messages so far.
        not_stored: how often what is remembered could not be stored; who stores it counts.
    """

    def __init__(
        self, config: MonitorConfig, start_ns: int, *, points: bool = True, model: ProcessModel | None = None
    ) -> None:
        self.config = config
        self._points, self._model = points, model
        self._settings: dict[str, Any] | None = None
        self.refusals = Refusals()
        self.failures = Failures()
        self._signals = (config.input, *config.outputs)
        self._signal_by_key = {keys.key(config.plant, keys.SAMPLE, signal): signal for signal in self._signals}
        self._places = {signal: place for place, signal in enumerate(self._signals)}
        self._aligner = Aligner(self._signals, config.reorder_rows)
        self._runs = [SampleRun() for _ in self._signals]
        self._told_again: ToldAgain | None = None
        self.alarms = AlarmBoard(config)
        self._watch = self._new_watch(self.alarms)
        self._units = dict.fromkeys(self._signals, "")
        self._heard_from_ns: dict[str, int] = {}
        self._output_units = [""] * len(config.outputs)
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.span_ns = 0
        self._watching_since_ns: int | None = None
        self.received = 0
        self.not_stored = 0
        self._stalls, self._ticked = 0, False
        self._published = 0
        self._heard_ns = 0
        self._lag_ns = 0
        self._start_ns = start_ns
        self._health_due_ns = start_ns
        self._snapshot_due_ns: int | None = None
        self._snapshot_ns = int(config.snapshot_min * MINUTE_NS)

    # --- what the loop calls ---------------------------------------------------------------------------------

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """Take in whatever was published on a key of the plant's samples."""
        self.received += 1
        if message.received_ns and now_ns - message.received_ns > self._lag_ns:
            self._lag_ns = now_ns - message.received_ns
        signal = self._signal_by_key.get(message.key)
        if signal is None:
            self.refusals.add("unknown_signal", f"{message.key} is none of {', '.join(self._signals)}")
            return []
        if len(message.payload) > LARGEST_SAMPLE:
            self.refusals.add("too_large", f"{message.key}: {len(message.payload)} bytes are no Sample")
            return []
        try:
            sample = decode(message.payload, message.encoding)
        except DecodeError as error:
            self.refusals.add(error.reason, f"{message.key}: {error}")
            return []
        if not isinstance(sample, Sample):
            self.refusals.add("encoding", f"{message.key}: a Sample was expected, got {message.encoding}")
            return []
        return self.on_sample(signal, sample, now_ns)

    def on_sample(self, signal: str, sample: Sample, now_ns: int) -> list[Publication]:
        """Take in a sample of one of the plant's signals.

        Returns:
            What is to be published because of it.
        """
        quality, value = sample.quality, sample.value  # each look into the message costs as much as a line here
        if quality not in USABLE or not abs(value) < LARGEST_VALUE:
            self.refusals.add(*unusable(signal, sample))
            return []
        if self._told_again is not None and self._told_again.heard(
            self._places[signal], sample.time_ns, sample.sequence
        ):
            self._aligner.state.counts.duplicated += 1
            return []
        publications: list[Publication] = []
        place, time_ns, number = self._places[signal], sample.time_ns, sample.sequence
        run, heard = self._runs[place], True
        if run.goes_on(time_ns, number):  # as nearly always
            self._hear(signal, time_ns, number, value, sample.unit, publications)
        elif not (number < LARGEST_NUMBER and abs(time_ns) < LARGEST_NUMBER):
            self.refusals.add(
                "out_of_range", f"{signal} number {number} at {time_ns} ns: no plant counts or lasts so far"
            )
            return []
        else:
            believed, refused = run.take(Held(time_ns, number, value, sample.unit), self.config.reorder_rows)
            heard = bool(believed)
            for item in refused:
                self._refuse(signal, item, run)
            for item in believed:
                self._hear(signal, *item, publications)
        if heard and now_ns >= self._heard_ns + HEARD_AGAIN_NS:
            self._heard_ns = now_ns
            self._watch.signals.received(now_ns)
        self._published += len(publications)
        return publications

    def _hear(
        self, signal: str, time_ns: int, number: int, value: float, unit: str, publications: list[Publication]
    ) -> None:
        """Take a sample in that is of the plant."""
        if unit != self._units[signal] or signal not in self._heard_from_ns:
            self._heard_from_ns.setdefault(signal, time_ns)
            self._units[signal] = unit
            self._output_units = [self._units[output] for output in self.config.outputs]
        for row in self._aligner.update(signal, time_ns, number, value):
            self._on_row(row, publications)

    def _refuse(self, signal: str, sample: Held, run: SampleRun) -> None:
        self.refusals.add(
            "out_of_place",
            f"{signal} number {sample.number} at {sample.time_ns} ns does not follow number {run.number} at "
            f"{run.time_ns} ns; do two plants publish as {self.config.plant}?",
        )

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        """Let a person act on the alarms, at the time of the newest row; or say why not."""
        self.received += 1
        try:
            reply, publications = obey(self.alarms, question)
        except (InputError, DecodeError) as error:
            reason = error.reason if isinstance(error, DecodeError) else "command"
            self.refusals.add(reason, f"{question.key}: {error}")
            return CommandReply(accepted=False, text=str(error)), []
        self._published += len(publications)
        return reply, publications

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Publish health if it is due, and a silence of the plant."""
        if self._ticked and now_ns - self._due_ns() > STALL_NS:
            self._stalls += 1
        self._ticked = True
        publications = self._check_silence(now_ns)
        self._published += len(publications)
        if now_ns >= self._health_due_ns:
            self._health_due_ns = now_ns + int(self.config.health_period_s * 1e9)
            publications.append(self._health(now_ns, self.phase))
        return publications

    def next_tick_ns(self) -> int:
        """When health is due, or the plant overdue."""
        return self._due_ns()

    def _due_ns(self) -> int:
        overdue_ns = self._watch.signals.due_ns()
        return self._health_due_ns if overdue_ns is None else min(self._health_due_ns, overdue_ns)

    @property
    def finished(self) -> bool:
        """Never: a monitor watches until it is stopped."""
        return False

    def on_stop(self, now_ns: int) -> list[Publication]:
        """Publish health for the last time."""
        return [self._health(now_ns, "stopped")]

    # --- what survives a restart -----------------------------------------------------------------------------

    def to_bytes(self) -> bytes:
        """All that is remembered, between two messages: a monitor that goes on from it says the same, bit for bit."""
        return sealed(self._state(self._learned_with()))

    def from_bytes(self, data: bytes) -> None:
        """Go on from what `to_bytes` returned, of a monitor with the same settings.

        Samples that were heard before may come again, until `caught_up`: they are counted as duplicated, and passed
        over (see `replay_filter`).

        Raises:
            InputError: the bytes are not that; everything is as before.
            OtherSettingsError: they are, but of a monitor with other settings; likewise.
        """
        self.restore(opened(data, self._learned_with()))

    @property
    def state(self) -> MonitorState:
        """What `to_bytes` stores, without the settings: for this process. Parts of it are not copied."""
        return self._state({})

    def _state(self, settings: dict[str, Any]) -> MonitorState:
        return MonitorState(
            settings,
            self._runs,
            self._aligner.state,
            self.alarms.to_bytes(),
            self._watch.state,
            self._units,
            self._heard_from_ns,
            self.first_ns,
            self.last_ns,
            self._watching_since_ns,
            self._snapshot_due_ns,
            self.received,
            self._published,
            self.refusals.by_reason,
            self.failures.by_stage,
        )

    def restore(self, state: MonitorState) -> None:
        """Go on where a monitor with the same settings was when `state` was taken, see `from_bytes`.

        Raises:
            InputError: the state is damaged; everything is as before.
        """
        board = AlarmBoard(self.config)
        try:
            watch = self._new_watch(board)
            board.from_bytes(state.board)
            watch.restore(state.watch, self._start_ns)
        except ValueError as error:
            raise InputError(f"is no state of this software's monitor: {error}") from error
        self.alarms, self._watch = board, watch
        self._runs = state.runs
        self._aligner.state, self._told_again = state.alignment, ToldAgain(state.alignment)
        self._units, self._heard_from_ns = state.units, state.heard_from_ns
        self._output_units = [self._units[output] for output in self.config.outputs]
        self.first_ns, self.last_ns = state.first_ns, state.last_ns
        self._watching_since_ns, self._snapshot_due_ns = state.watching_since_ns, state.snapshot_due_ns
        self.received, self._published = state.received, state.published
        self.refusals.by_reason = state.refused
        self.failures.restore(state.failures)

    def _learned_with(self) -> dict[str, Any]:
        if self._settings is None:
            self._settings = settings_of(self.config, self._watch.model, points=self._points)
        return self._settings

    def pass_over(self) -> None:
        """A sample came that was judged before: count it."""
        self.received += 1
        self._aligner.state.counts.duplicated += 1

    @property
    def is_catching_up(self) -> bool:
        """Whether samples may come that were heard before a stop."""
        return self._told_again is not None and not self._told_again.is_over

    def caught_up(self) -> None:
        """What was published before has all come: from now on no sample is one that was heard before a stop."""
        self._told_again = None

    def restore_alarms(self, data: bytes) -> None:
        """Restore the alarms alone, from what `AlarmBoard.to_bytes` returned.

        Raises:
            InputError: see `AlarmBoard.from_bytes`; everything is as before.
        """
        self.alarms.from_bytes(data)
        self._watch.signals.go_on_from_alarms()

    def go_on_from_alarms(self, alarms: Iterable[Alarm]) -> None:
        """Go on from what another monitor of the plant said last of its alarms, where nothing else is left of it.

        The plant is learned anew; meanwhile what stands stands, and is cleared when it is found to be over.

        Args:
            alarms: the newest message of each.
        """
        self.alarms.go_on_from(alarms)
        self._watch.signals.go_on_from_alarms()

    @property
    def receipt(self) -> Receipt:
        """What a restart forgets: how messages came, by the clock."""
        received_ns, counted_ns = self._watch.signals.receipts_ns
        return Receipt(
            self._start_ns,
            self._heard_ns,
            received_ns,
            counted_ns,
            self._lag_ns,
            self._health_due_ns,
            self._ticked,
            self._stalls,
            self.not_stored,
        )

    @receipt.setter
    def receipt(self, receipt: Receipt) -> None:
        self._start_ns, self._heard_ns, self._lag_ns = receipt.start_ns, receipt.heard_ns, receipt.lag_ns
        self._watch.signals.receipts_ns = receipt.received_ns, receipt.counted_ns
        self._health_due_ns, self._ticked = receipt.health_due_ns, receipt.ticked
        self._stalls, self.not_stored = receipt.stalls, receipt.not_stored

    # --- what others may ask ---------------------------------------------------------------------------------

    @property
    def phase(self) -> str:
        """`waiting` for the first row, `training` or `watching`."""
        if self.first_ns is None:
            return "waiting"
        return "training" if self._watching_since_ns is None else "watching"

    @property
    def model(self) -> ProcessModel | None:
        """That the plant may be watched by; None: there is none."""
        return self._watch.model

    @property
    def reference(self) -> str:
        """The kind of reference that judges rows: `equations` or `arx`; empty before there is one."""
        return self._watch.reference

    @property
    def noise_levels(self) -> dict[str, dict[str, float]] | None:
        """The noise levels that the equations judge by, by sensor and by state; None where they do not judge."""
        return self._watch.noise_levels

    @property
    def rows(self) -> int:
        """Rows that have been lined up so far, incomplete ones too."""
        return self._aligner.state.counts.rows

    @property
    def restarts(self) -> int:
        """Number of times that the plant was restarted, or its clock set back, so far."""
        return self._aligner.state.counts.restarts

    @property
    def watching_since_ns(self) -> int | None:
        """Time of the first row that was judged; None while there is none."""
        return self._watching_since_ns

    @property
    def expected_false_alarms(self) -> float:
        """Alarms that chance alone would have raised by now, on average."""
        return self._watch.expected_false_alarms

    @property
    def left_out(self) -> dict[str, str]:
        """Signals that are not watched, each with the reason: those that never came and those not fit to be learned."""
        never_came = (signal for signal in self._signals if signal not in self._heard_from_ns)
        return dict.fromkeys(never_came, NO_VALUE) | self._watch.left_out

    @property
    def refused_trainings(self) -> int:
        """Number of trainings that were not fit to learn from."""
        return self._watch.refused_trainings

    @property
    def notes(self) -> list[str]:
        """What people are to be told of the training; whoever tells them empties it."""
        notes, failures = self._watch.notes, self.failures.notes
        notes += failures
        failures.clear()
        return notes

    # --- what a recording tells beside the samples -----------------------------------------------------------

    @property
    def silent_from_ns(self) -> int | None:
        """When the plant will have been silent, in the time of the samples, if nothing more comes; None: not known."""
        return self._watch.signals.deadline_ns

    def fall_silent(self) -> list[Publication]:
        """Take the plant as silent, as the clock of receipt told it when this was recorded."""
        return self._watch.signals.fall_silent()

    # --- rows ------------------------------------------------------------------------------------------------

    def on_rows(self, rows: Iterable[Row]) -> list[Publication]:
        """Judge rows that somebody else has lined up."""
        publications: list[Publication] = []
        for row in rows:
            self._on_row(row, publications)
        self._published += len(publications)
        return publications

    def finish(self) -> list[Publication]:
        """Judge the rows that still wait for samples, as at the end of a record."""
        publications: list[Publication] = []
        for signal, run in zip(self._signals, self._runs, strict=True):
            for sample in run.released():
                self._hear(signal, *sample, publications)
        for row in self._aligner.flush():
            self._on_row(row, publications)
        return publications

    def _on_row(self, row: Row, publications: list[Publication]) -> None:
        time_ns, due_ns = row.time_ns, self._snapshot_due_ns
        if self.first_ns is None or time_ns < self.first_ns:
            self.first_ns = time_ns
        if self.last_ns is not None and not row.restarted:
            self.span_ns += time_ns - self.last_ns
        self.last_ns = time_ns
        try:
            self._watch.update(row, self._output_units, publications)
            publications.extend(self.alarms.end_row(time_ns))
        except Exception as error:  # noqa: BLE001 # the plant's border: an error here ends neither node nor fleet
            self._start_again("row", error)
        if self._watching_since_ns is None and self._watch.watching:
            self._watching_since_ns = time_ns
        if due_ns is None or not 0 <= due_ns - time_ns <= self._snapshot_ns:
            self._snapshot_due_ns = time_ns + self._snapshot_ns
            if due_ns is not None:
                publications.extend(self._snapshots(time_ns))

    def _snapshots(self, time_ns: int) -> list[Publication]:
        try:
            return self._watch.snapshots(time_ns)
        except Exception as error:  # noqa: BLE001 # the plant's border, see `_on_row`
            self._start_again("models", error)
            return []

    def _check_silence(self, now_ns: int) -> list[Publication]:
        try:
            return self._watch.signals.check(now_ns)
        except Exception as error:  # noqa: BLE001 # the plant's border, see `_on_row`
            self._start_again("silence", error)
            return []

    # --- after an error of this software ---------------------------------------------------------------------

    def _new_watch(self, board: AlarmBoard) -> PlantWatch:
        return PlantWatch(self.config, board, points=self._points, model=self._model, failures=self.failures)

    def _start_again(self, stage: str, error: Exception) -> None:
        """Contain an error: count it and learn the plant again, as its memory may be inconsistent.

        The alarms stay as they are; an active one is cleared when it is found to be over.
        """
        self.failures.add(stage, error, "the plant is learned again, its alarms stay")
        alarms = self.alarms.all_alarms()
        notes, receipts_ns = self._watch.notes, self._watch.signals.receipts_ns
        self._watch = self._new_watch(self.alarms)
        self._watch.notes, self._watch.signals.receipts_ns = notes, receipts_ns
        self._watching_since_ns = None
        self.go_on_from_alarms(alarms)

    def _health(self, now_ns: int, phase: str) -> Publication:
        health = health_of(
            now_ns,
            phase,
            self._start_ns,
            self._aligner.state.counts,
            self.refusals.by_reason,
            received=self.received,
            published=self._published,
            lag_ns=self._lag_ns,
            heard_from_ns=self._heard_from_ns,
            not_stored=self.not_stored,
            stalls=self._stalls,
            failures=self.failures.by_stage,
            reference=self._watch.reference,
            training=self._watch.trained_share(self.last_ns),
        )
        self._lag_ns = 0
        return Publication(keys.key(self.config.plant, keys.HEALTH, NODE), health)
