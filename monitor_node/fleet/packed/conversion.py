"""Conversion of a monitor to a packed plant and back.

The numbers of the stages are copied. What changes with a row is in them, in the record and in the ring of the newest
rows. What seldom changes, and is no number, is kept beside them (`Rest`), and shared between plants where it is equal.
"""

from collections.abc import Sequence
from dataclasses import asdict
from math import isfinite
from typing import NamedTuple, TypeAlias

import msgspec
import numpy as np

from monitor_node.alarms.alarms import AlarmMemory
from monitor_node.alarms.annunciator import Annunciator, AnnunciatorState
from monitor_node.alarms.incidents import Incident
from monitor_node.alarms.kpis import KpiState
from monitor_node.baseline.process_reference import ProcessReferenceState
from monitor_node.baseline.promise import NUMBERS, PromiseState
from monitor_node.baseline.training_rows import TrainingState
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.fleet.packed.pending import (
    alignment_of,
    are_runs_complete,
    is_in_order,
    runs_of,
    write_alignment,
    write_runs,
)
from monitor_node.fleet.packed.record import MOST_SIGNALS, Array, Records, record_type
from monitor_node.fleet.packed.ring import NewestRows, times_ns_of
from monitor_node.ingest.alignment import REMEMBERED, AlignmentState
from monitor_node.ingest.sampling import SamplingState
from monitor_node.isolation.stage import SuspicionState, has_causes
from monitor_node.pipeline.pipeline_state import PipelineState, TrainedState
from monitor_node.pipeline.row_step import RowStep
from monitor_node.signal_checks.spike import Spike
from monitor_node.signal_checks.stage import SignalChecksState
from monitor_node.signal_checks.stuck import Stuck
from monitor_node.signal_checks.timeout import DataTimeout
from monitor_node.stages.chart_alarms import alarm_names
from monitor_node.stages.charts import ChartsState
from monitor_node.state.monitor_state import MonitorState
from reactorwatch.contract import keys
from reactorwatch.contract.messages_pb2 import AlarmKpis
from reactorwatch.contract.sample_bytes import unit_digest
from reactorwatch.kalman.ekf import FilterState, NoiseLevels
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.spc.charts.mewma import Mewma
from reactorwatch.spc.compiled_chart import SignalState
from reactorwatch.spc.prewhitening import Prewhitener
from reactorwatch.stored_state import pack_numbers, unpack_numbers

EqualRuns: TypeAlias = tuple[dict[int, int], float]
"""Training of a check for stuck sensors, see `Stuck.training`."""


class Rest(NamedTuple):
    """State of a plant beside its numbers.

    Attributes:
        board: the plant's alarms; None if there was never one.
        refused: number of rejected messages by reason.
        failures: number of contained errors of this software by stage.
        runs: training of the checks for stuck sensors, one an output, as MessagePack.
        units: units of the signals.
        checks: checks of the training.
        refusals: number of refused trainings.
        until_drift: number of rows until the next drift point.
        cause: newest search: number of the incident, output and cause.
        undiagnosed: rows of the training while its diagnosis is pending, then empty.
    """

    board: Annunciator | None
    refused: dict[str, int] | None
    failures: dict[str, int] | None
    runs: bytes
    units: tuple[str, ...]
    checks: tuple[tuple[str, str], ...]
    refusals: int
    until_drift: int
    cause: tuple[int, str, str]
    undiagnosed: TrainingState


class Conversion:
    """Conversion between monitors with certain settings and packed plants.

    Args:
        config: settings of the monitors.
        model: process model of the plants.
        step: compiled step of the plants.

    Attributes:
        record: type of a record.
        step: compiled step of the plants.
        keeps: number of the newest rows that are kept.
        remembered: number of these by which repeated samples are recognised.
        columns: number of values that are kept of each row.
        inputs: number of inputs.
        figures: KPIs of alarms that were never raised, but for the time.
        least_s: see `DataTimeout`.
    """

    def __init__(self, config: MonitorConfig, model: ProcessModel, step: RowStep) -> None:
        self.config, self._model, self.step = config, model, step
        self._alarms = [keys.chart_name(*pair) for pair in alarm_names(config)]
        self._signals = config.signals
        self.record = record_type(len(config.inputs), len(config.outputs), len(model.states))
        self._looks = has_causes(config, model)
        self.remembered = REMEMBERED * config.reorder_rows
        self.keeps = config.isolation_rows if self._looks else self.remembered
        self.columns = len(self._signals) if self._looks else 0
        self.inputs = len(config.inputs)
        fresh = Monitor(config, 0, points=False, model=model)
        state = fresh.state
        self._predictors, self._training = state.watch.predictors, state.watch.training
        self._board = state.board
        self.least_s = state.watch.signals.silences[0].least_s
        (self.figures,) = (item.message for item in fresh.alarms.end_row(0) if isinstance(item.message, AlarmKpis))

    @staticmethod
    def of(config: MonitorConfig, model: ProcessModel | None) -> "Conversion | None":
        """The form of plants with these settings; None if they cannot be packed.

        Args:
            config: settings of the monitors.
            model: process model of the plants; None: there is none.
        """
        step = RowStep.of(config, model)
        if model is None or step is None:
            return None
        if config.carried_signals or len(config.signals) > MOST_SIGNALS:  # the ring keeps inputs and outputs alone
            return None
        form = Conversion(config, model, step)
        return form if form.keeps >= form.remembered else None

    # --- from a monitor --------------------------------------------------------------------------------------

    def demote(self, monitor: Monitor, record: Records) -> tuple[Rest, NewestRows] | None:
        """Fill a record with the state of a monitor; None if the plant is not in its normal state.

        Args:
            monitor: monitor of the plant.
            record: filled, shape (1,).
        """
        pipeline = monitor.pipeline
        if not monitor.is_normal or None in monitor.silence.of_plant.receipts_ns:
            return None
        state = monitor.state
        watched, alignment = state.watch.watched, state.alignment
        board = msgspec.msgpack.decode(state.board, type=AnnunciatorState)
        if any(item is not None and item.usual is not None for item in state.watch.signals.spikes):
            return None
        if watched is None or not isinstance(watched.reference, ProcessReferenceState):
            return None
        if watched.baseline or watched.power:
            return None
        if board.kpis_changed or board.told is None or board.kpi_minute is None:
            return None
        if not is_in_order(alignment) or not are_runs_complete(state.runs, alignment):
            return None
        rows = self._rows(alignment, watched.suspicion)
        sampling, reference = state.watch.sampling, watched.reference
        if rows is None or sampling.last_ns != rows.times_ns[-1]:
            return None
        record[:] = np.zeros(1, self.record)
        p = record[0]
        for name, number in asdict(monitor.stats).items():
            p[name] = number
        p["receipts"] = pipeline.evaluation.signals.silence.of_plant.receipts[0]
        write_runs(p, state.runs)
        p["received"], p["published"] = state.received, state.published
        p["first_ns"], p["watching_since_ns"] = state.first_ns, state.watching_since_ns
        p["began_ns"], p["width"] = state.watch.began_ns, watched.charts.widths
        p["heard_from_ns"] = [state.heard_from_ns[signal] for signal in self._signals]
        p["unit"] = [unit_digest(state.units[signal]) for signal in self._signals]
        p["kpi_minute"], p["arl0"], p["rows_watched"] = board.kpi_minute, watched.arl0, watched.rows_watched
        write_alignment(p, alignment)
        p["spacing_ns"], p["reach"] = sampling.spacing_ns, reference.reach
        p["noise"] = [*reference.noise.measurement_sd, *reference.noise.process_sd]
        p["typical_sd"] = reference.typical_sd
        p["promise"] = np.zeros(NUMBERS) if watched.promise is None else watched.promise.numbers
        looked = watched.suspicion
        rest = Rest(
            None if self._never_came_up(board) else monitor.alarms,
            state.refused or None,
            state.failures or None,
            msgspec.msgpack.encode(pipeline.evaluation.signals.trainings),
            tuple(state.units[signal] for signal in self._signals),
            tuple(watched.checks),
            state.watch.refusals,
            watched.until_drift,
            (0, "", "") if looked is None else (looked.incident, looked.output, looked.cause),
            state.watch.training if state.watch.training.times_ns else self._training,
        )
        return rest, rows

    def _rows(self, alignment: AlignmentState, looked: SuspicionState | None) -> NewestRows | None:
        """Newest rows; None if not enough are known, or not all were complete and in order."""
        left = list(alignment.left.items())
        times_ns = [time_ns for time_ns, _ in left]
        newest = alignment.newest_numbers
        for age, (_, numbers) in enumerate(reversed(left)):
            if any(known is None or number != known - age for number, known in zip(numbers, newest, strict=True)):
                return None
        if not left or sorted(times_ns) != times_ns or alignment.newest_left_ns != times_ns[-1]:
            return None
        if not self._looks:
            return NewestRows(times_ns, np.empty((len(times_ns), 0)))
        if looked is None or looked.since is not None or looked.way is not None or looked.reconstruction is not None:
            return None
        rows = unpack_numbers(looked.rows, 1 + len(self._signals))
        if len(rows) < len(left) or not np.isfinite(rows).all():
            return None
        known = times_ns_of(rows[: len(rows) - len(left), 0]) + times_ns
        if [time_ns / MINUTE_NS for time_ns in known] != rows[:, 0].tolist():
            return None
        return NewestRows(known, rows[:, 1:])

    def _never_came_up(self, board: AnnunciatorState) -> bool:
        plain = AlarmMemory()
        same = all(msgspec.structs.replace(memory, rule=plain.rule) == plain for memory in board.alarms.values())
        return same and board.incident == Incident() and board.kpis == KpiState() and not board.suspects

    # --- to a monitor ----------------------------------------------------------------------------------------

    def promote(
        self,
        plant: str,
        p: np.void,
        numbers: np.void,
        belief: Array,
        rest: Rest,
        rows: NewestRows,
        waiting: Sequence[int],
    ) -> MonitorState:
        """State of a monitor of a plant.

        Args:
            plant: name of the plant.
            p: record of the plant.
            numbers: numbers of its stages.
            belief: belief of its filter.
            rest: state beside the numbers.
            rows: newest rows.
            waiting: times of rows that were aligned and are not processed yet.
        """
        looked = None
        if self._looks:
            minutes = np.array([time_ns / MINUTE_NS for time_ns in rows.times_ns])
            known = pack_numbers(np.column_stack([minutes, rows.values]))
            incident, output, cause = rest.cause
            looked = SuspicionState(rows=known, incident=incident, output=output, cause=cause)
        outputs = range(len(self.config.outputs))
        whiteners = [Prewhitener(None, numbers["whiteners"][i : i + 1]).state for i in outputs]
        last_ns, inputs = int(numbers["last_ns"]), numbers["inputs"].tolist()
        noise, states = p["noise"].tolist(), len(self._model.states)
        x, P = tuple(belief[:states].tolist()), tuple(belief[states:].tolist())
        reference = ProcessReferenceState(
            NoiseLevels(tuple(noise[: len(outputs)]), tuple(noise[len(outputs) :])),
            FilterState(float(numbers["time_min"]), tuple(inputs), x, P),
            inputs,
            [False] * len(inputs),
            p["typical_sd"].tolist(),
            0,
            p["reach"].tolist(),
        )
        watched = TrainedState(
            reference,
            list(rest.checks),
            {},
            whiteners,
            ChartsState(self._charts(numbers), p["width"].tolist(), [item.learned.shift_gain for item in whiteners]),
            looked,
            float(p["arl0"]),
            [False] * len(outputs),
            int(p["rows_watched"]),
            rest.until_drift,
            promise=PromiseState.from_numbers(p["promise"].tolist()) if p["promise"].any() else None,
        )
        watch = PipelineState(
            SamplingState(last_ns, [], float(numbers["period_ns"]), int(p["spacing_ns"])),
            self._signals_of(p, numbers, msgspec.msgpack.decode(rest.runs, type=list[EqualRuns])),
            self._predictors,
            rest.refusals,
            int(p["began_ns"]),
            rest.undiagnosed,
            watched,
        )
        return MonitorState(
            settings={},
            runs=runs_of(p),
            alignment=alignment_of(p, [*rows.times_ns, *waiting]),
            board=self._board_of(plant, p, numbers, rest),
            watch=watch,
            units=dict(zip(self._signals, rest.units, strict=True)),
            heard_from_ns=dict(zip(self._signals, p["heard_from_ns"].tolist(), strict=True)),
            first_ns=int(p["first_ns"]),
            last_ns=last_ns,
            watching_since_ns=int(p["watching_since_ns"]),
            received=int(p["received"]),
            published=int(p["published"]),
            refused=dict(rest.refused or {}),
            failures=dict(rest.failures or {}),
        )

    def _signals_of(self, p: np.void, numbers: np.void, trainings: list[EqualRuns]) -> SignalChecksState:
        receipts = np.array([p["receipts"]])
        return SignalChecksState(
            [
                DataTimeout(
                    self.config.silence_periods, self.least_s, numbers["timeouts"][i : i + 1], None if i else receipts
                ).state
                for i in range(len(numbers["timeouts"]))
            ],
            [
                Stuck.of_numbers(arl0, runs, numbers["stuck"][i : i + 1]).state
                for i, (runs, arl0) in enumerate(trainings)
            ],
            [Spike(limit) if isfinite(limit) else None for limit in numbers["spike_limits"].tolist()],
        )

    def _charts(self, numbers: np.void) -> dict[str, bytes]:
        charts: dict[str, bytes] = {}
        for name in dict.fromkeys(self.config.charts):
            if name == Mewma.name:
                state = Mewma.state_of_numbers(numbers["mewma"], self.config.chart_settings["mewma_weight"])
                charts[name] = state.to_bytes()
            else:
                values = numbers[name].astype("<f8").tobytes()
                charts[name] = SignalState(name, len(self.config.outputs), values).to_bytes()
        return charts

    def _board_of(self, plant: str, p: np.void, numbers: np.void, rest: Rest) -> bytes:
        board = msgspec.msgpack.decode(
            self._board if rest.board is None else rest.board.to_bytes(), type=AnnunciatorState
        )
        for (recent, in_a_row, _), name in zip(numbers["delays"].tolist(), self._alarms, strict=False):
            rule = board.alarms[name].rule
            rule.recent, rule.in_a_row = recent, in_a_row
        last_ns = int(numbers["last_ns"])
        if rest.board is None:
            told = AlarmKpis()
            told.CopyFrom(self.figures)
            told.time_ns = last_ns
            board = msgspec.structs.replace(board, plant=plant, told=told.SerializeToString())
        board = msgspec.structs.replace(board, time_ns=last_ns, kpi_minute=int(p["kpi_minute"]), kpis_changed=False)
        return msgspec.msgpack.encode(board)
