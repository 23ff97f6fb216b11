"""Between all that a monitor remembers of a plant and its record.

What changes with a row is in the record and in the ring of the newest rows. What seldom changes, and is no number, is
kept beside it (`Rest`), and shared between plants where it is the same.
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import NamedTuple

import msgspec
import numpy as np

from monitor_node.alarms.alarms import AlarmMemory
from monitor_node.alarms.annunciator import Annunciator, AnnunciatorState
from monitor_node.alarms.incidents import Incident
from monitor_node.alarms.kpis import KpiState
from monitor_node.alarms.states import State
from monitor_node.baseline.references import ProcessReferenceState
from monitor_node.baseline.training import TrainingState
from monitor_node.chart_stage import ChartsState, alarm_names
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.ingest.alignment import REMEMBERED, AlignmentState
from monitor_node.ingest.sampling import SamplingState
from monitor_node.isolation.stage import SuspicionState
from monitor_node.quiet.layout import Records, record_type
from monitor_node.quiet.learned import (
    EqualRuns,
    is_usual,
    reference_of,
    signals_of,
    whitener_of,
    write_reference,
    write_signals,
    write_whitener,
)
from monitor_node.quiet.lining_up import (
    alignment_of,
    is_in_order,
    run_on,
    runs_of,
    write_alignment,
    write_runs,
)
from monitor_node.quiet.ring import NewestRows, times_ns_of
from monitor_node.signal_checks.catalogue import CHECKS
from monitor_node.state.monitor_state import MonitorState
from monitor_node.state.pipeline_state import PipelineState, TrainedState
from reactorwatch.contract import keys
from reactorwatch.contract.messages_pb2 import AlarmKpis
from reactorwatch.contract.sample_bytes import unit_digest
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.spc.charts.cusum import Cusum
from reactorwatch.spc.charts.ewma import Ewma
from reactorwatch.spc.charts.mewma import Mewma, MewmaState
from reactorwatch.spc.charts.shewhart import Shewhart
from reactorwatch.spc.compiled_chart import SignalState
from reactorwatch.stored_state import pack_numbers, unpack_numbers

CHARTS = (Shewhart.name, Ewma.name, Cusum.name, Mewma.name)
"""That quiet plants may have, in the order of `rows.judge`."""

CHECKED = {"silence", "stuck", "spike", "range"}
"""The signal checks that `rows.judge` has compiled; with another one every plant keeps its monitor."""


class Rest(NamedTuple):
    """What is remembered of a plant beside its record.

    Attributes:
        board: its alarms; None if none ever came up.
        refused: counts by reason.
        failures: contained errors of this software, by stage.
        runs: of equal readings in the training, one an output, as MessagePack.
        units: of the signals.
        checks: what was said of the training.
        refusals: trainings that were refused.
        until_drift: rows until the next look at the drift.
        cause: what was looked for last: number of the incident, output and cause.
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


class QuietForm:
    """What records of plants with certain settings are like.

    Args:
        config: of their monitors.
        model: that their rows are expected by.

    Attributes:
        record: the type of a record.
        keeps: the newest rows that are kept.
        remembered: of these, by which samples are told that come twice.
        columns: of the rows, what is kept beside their times.
        places: of the first alarm of each kind of chart, see `rows.judge`.
        rules: of each chart's alarm, likewise.
        figures: of alarms that never came up, but for the time.
        least_s: see `DataTimeout`.
    """

    def __init__(self, config: MonitorConfig, model: ProcessModel) -> None:
        self.config, self._model = config, model
        names = alarm_names(config)
        self._alarms = [keys.chart_name(*pair) for pair in names]
        self._signals = (config.input, *config.outputs)
        self.record = record_type(len(config.outputs), len(model.states), len(names))
        self._looks = config.isolation and model.name == cstr().name  # as in `watch`
        remembered = REMEMBERED * config.reorder_rows
        self.keeps = config.isolation_rows if self._looks else remembered
        self.columns = len(self._signals) if self._looks else 0
        kinds = [chart for chart, _ in names]
        self._charts_made = set(kinds) & set(CHARTS)
        self.places = np.array([kinds.index(kind) if kind in kinds else -1 for kind in CHARTS], dtype=np.int32)
        self.rules = np.array(
            [(1, 1) if kind != Shewhart.name else (config.raise_count, (1 << config.window) - 1) for kind in kinds],
            dtype=np.int32,
        )
        fresh = Monitor(config, 0, points=False, model=model)
        state = fresh.state
        self._predictors, self._training = state.watch.predictors, state.watch.training
        self._board = state.board
        self.least_s = state.watch.signals.silences[0].least_s
        (self.figures,) = (item.message for item in fresh.alarms.end_row(0) if isinstance(item.message, AlarmKpis))
        self.remembered = remembered

    @staticmethod
    def of(config: MonitorConfig, model: ProcessModel | None) -> "QuietForm | None":
        """The form of plants with these settings; None if they cannot be held.

        Args:
            config: of their monitors.
            model: of the plant; None: there is none.
        """
        if model is None or model.breakpoints or len(model.input_names) != 1 or model.output_names != config.outputs:
            return None
        if (
            {check.name for check in CHECKS} != CHECKED
            or not set(config.charts) <= set(CHARTS)
            or (len(config.outputs) < 2 and Mewma.name in config.charts)
        ):
            return None
        form = QuietForm(config, model)
        return form if form.keeps >= form.remembered else None

    # --- from a monitor --------------------------------------------------------------------------------------

    def written(self, monitor: Monitor, record: Records) -> tuple[Rest, NewestRows] | None:
        """Fill a record with what a monitor remembers; None if the plant is not quiet.

        Args:
            monitor: of the plant.
            record: shape (1,).
        """
        if monitor.is_replaying_history or monitor.phase != "watching":
            return None
        received_ns, counted_ns = monitor.receipts_ns
        if received_ns is None or counted_ns is None:
            return None
        state = monitor.state
        watched, alignment = state.watch.watched, state.alignment
        board = msgspec.msgpack.decode(state.board, type=AnnunciatorState)
        if watched is None or not isinstance(watched.reference, ProcessReferenceState):
            return None
        if watched.left_out or watched.baseline or set(watched.charts.charts) != self._charts_made:
            return None
        if not _is_at_rest(board, self._alarms) or not is_in_order(alignment) or not run_on(state.runs, alignment):
            return None
        rows = self._rows(alignment, watched.suspicion)
        if rows is None or not is_usual(state.watch, watched, watched.reference, rows.times_ns[-1]):
            return None
        record[:] = np.zeros(1, self.record)
        p = record[0]
        p["received_ns"], p["counted_ns"] = received_ns, counted_ns
        for name, known in asdict(monitor.stats).items():
            p[name] = known
        write_runs(p, state.runs)
        p["received"], p["published"] = state.received, state.published
        p["first_ns"], p["watching_since_ns"] = state.first_ns, state.watching_since_ns
        p["began_ns"], p["width"] = state.watch.began_ns, watched.charts.widths
        p["heard_from_ns"] = [state.heard_from_ns[signal] for signal in self._signals]
        p["unit"] = [unit_digest(state.units[signal]) for signal in self._signals]
        p["kpi_minute"], p["arl0"], p["rows_watched"] = board.kpi_minute, watched.arl0, watched.rows_watched
        write_alignment(p, alignment)
        sampling = state.watch.sampling
        p["last_ns"], p["period_ns"], p["spacing_ns"] = sampling.last_ns, sampling.period_ns, sampling.spacing_ns
        write_signals(p, state.watch.signals)
        write_reference(p, watched.reference, self._model)
        for place, item in enumerate(watched.whiteners):
            write_whitener(p, place, item)
        self._write_charts(p, watched.charts)
        for place, name in enumerate(self._alarms):
            memory = board.alarms[name]
            p["recent"][place], p["in_a_row"][place] = memory.rule.recent, memory.rule.in_a_row
            p["above"][place] = memory.above
        looked = watched.suspicion
        rest = Rest(
            None if self._never_came_up(board) else monitor.alarms,
            state.refused or None,
            state.failures or None,
            msgspec.msgpack.encode([(item.runs, item.arl0) for item in state.watch.signals.stuck]),
            tuple(state.units[signal] for signal in self._signals),
            tuple(watched.checks),
            state.watch.refusals,
            watched.until_drift,
            (0, "", "") if looked is None else (looked.incident, looked.output, looked.cause),
            state.watch.training if state.watch.training.times_ns else self._training,
        )
        return rest, rows

    def _rows(self, alignment: AlignmentState, looked: SuspicionState | None) -> NewestRows | None:
        """The newest rows; None if they are not known that far back, or not all were complete and in order."""
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

    def _write_charts(self, p: np.void, charts: ChartsState) -> None:
        for kind in (Shewhart, Ewma, Cusum):
            if kind.name in charts.charts:
                numbers = SignalState.from_bytes(charts.charts[kind.name]).numbers
                p[kind.name] = np.frombuffer(numbers, dtype="<f8").reshape(-1, len(self.config.outputs))
        if Mewma.name in charts.charts:
            state = MewmaState.from_bytes(charts.charts[Mewma.name])
            p["mean"], p["covariance"], p["average"] = state.mean, state.covariance, state.average
            p["whitening"] = Mewma.from_state(state).whitening.matrix
            p["mewma_limit"] = state.limit

    # --- to a monitor ----------------------------------------------------------------------------------------

    def read(self, plant: str, p: np.void, rest: Rest, rows: NewestRows, waiting: Sequence[int]) -> MonitorState:
        """All that a monitor of the plant would remember.

        Args:
            plant: its name.
            p: its record.
            rest: of it.
            rows: its newest.
            waiting: times of rows that were lined up and are not judged yet.
        """
        looked = None
        if self._looks:
            minutes = np.array([time_ns / MINUTE_NS for time_ns in rows.times_ns])
            known = pack_numbers(np.column_stack([minutes, rows.values]))
            looked = SuspicionState(known, rest.cause[0], None, None, rest.cause[1], rest.cause[2], None)
        equal = msgspec.msgpack.decode(rest.runs, type=list[EqualRuns])
        outputs = range(len(self.config.outputs))
        watched = TrainedState(
            reference_of(p, len(self._model.states)),
            list(rest.checks),
            {},
            [whitener_of(p, place) for place in outputs],
            self._charts(p),
            looked,
            float(p["arl0"]),
            [False] * len(outputs),
            int(p["rows_watched"]),
            rest.until_drift,
        )
        watch = PipelineState(
            SamplingState(int(p["last_ns"]), [], float(p["period_ns"]), int(p["spacing_ns"])),
            signals_of(p, equal, self.config.silence_periods, self.least_s),
            self._predictors,
            rest.refusals,
            int(p["began_ns"]),
            rest.undiagnosed,
            watched,
        )
        return MonitorState(
            {},
            runs_of(p),
            alignment_of(p, [*rows.times_ns, *waiting]),
            self._board_of(plant, p, rest),
            watch,
            dict(zip(self._signals, rest.units, strict=True)),
            dict(zip(self._signals, p["heard_from_ns"].tolist(), strict=True)),
            int(p["first_ns"]),
            int(p["last_ns"]),
            int(p["watching_since_ns"]),
            None,
            int(p["received"]),
            int(p["published"]),
            dict(rest.refused or {}),
            dict(rest.failures or {}),
        )

    def _charts(self, p: np.void) -> ChartsState:
        charts: dict[str, bytes] = {}
        for name in dict.fromkeys(self.config.charts):
            if name == Mewma.name:
                mean, covariance, average = (p[field].tolist() for field in ("mean", "covariance", "average"))
                weight, limit = self.config.chart_settings["mewma_weight"], float(p["mewma_limit"])
                charts[name] = MewmaState(mean, covariance, weight, limit, average).to_bytes()
            else:
                numbers = p[name].astype("<f8").tobytes()
                charts[name] = SignalState(name, len(self.config.outputs), numbers).to_bytes()
        passed = [whitener_of(p, place).learned.shift_gain for place in range(len(self.config.outputs))]
        return ChartsState(charts, p["width"].tolist(), passed)

    def _board_of(self, plant: str, p: np.void, rest: Rest) -> bytes:
        board = msgspec.msgpack.decode(
            self._board if rest.board is None else rest.board.to_bytes(), type=AnnunciatorState
        )
        for place, name in enumerate(self._alarms):
            rule = board.alarms[name].rule
            rule.recent, rule.in_a_row = int(p["recent"][place]), int(p["in_a_row"][place])
        last_ns = int(p["last_ns"])
        if rest.board is None:
            told = AlarmKpis()
            told.CopyFrom(self.figures)
            told.time_ns = last_ns
            board = msgspec.structs.replace(board, plant=plant, told=told.SerializeToString())
        board = msgspec.structs.replace(board, time_ns=last_ns, kpi_minute=int(p["kpi_minute"]), kpis_changed=False)
        return msgspec.msgpack.encode(board)


def _is_at_rest(board: AnnunciatorState, of_charts: list[str]) -> bool:
    """Whether no alarm stands or is shelved, and none but those of charts has anything in its memory."""
    if board.kpis_changed or board.told is None or board.kpi_minute is None:
        return False
    return all(
        not memory.rule.standing and memory.state is not State.SHELVED and (name in of_charts or not memory.rule.recent)
        for name, memory in board.alarms.items()
    )
