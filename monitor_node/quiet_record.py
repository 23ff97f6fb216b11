"""Between all that a monitor remembers of a plant and its record among the quiet plants (see `quiet_rows`).

What changes with a row is in the record and in the ring of the newest rows. What seldom changes, and is no number, is
kept beside it (`Rest`), and shared between plants where it is the same.

The ring holds when each row came, as the spacing before it: in a unit in which all are whole, and less the usual one,
in 32 bits. (What a search for causes wants of 600 rows is most of what a plant takes.) If that does not fit, as when a
plant whose times are in nanoseconds was away for more than two seconds, it has a monitor until the ring is past it.
"""

from collections.abc import Sequence
from math import inf, isfinite
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from monitor_node import quiet_rows
from monitor_node.alarm_board import AlarmBoard, BoardState
from monitor_node.alarm_kpis import KpiState
from monitor_node.alarm_states import State
from monitor_node.alarms import AlarmMemory
from monitor_node.alignment import REMEMBERED, AlignmentState, Counts, Waiting
from monitor_node.alignment import Sequence as Numbering
from monitor_node.chart_watch import ChartsState, alarm_names
from monitor_node.charts.base import SignalState
from monitor_node.charts.cusum import Cusum
from monitor_node.charts.ewma import Ewma
from monitor_node.charts.mewma import Mewma, MewmaState
from monitor_node.charts.shewhart import Shewhart
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.incidents import Incident
from monitor_node.monitor_state import MonitorState
from monitor_node.prewhitening import PrewhitenerState, Prewhitening
from monitor_node.quiet_rows import Array, Records
from monitor_node.references import ProcessReferenceState
from monitor_node.sample_run import MEMORY as FULL_RUN
from monitor_node.sample_run import SampleRun
from monitor_node.sampling import SamplingState
from monitor_node.signal_watch import SignalsState
from monitor_node.silence import SilenceState, Spacing
from monitor_node.spike import SpikeState
from monitor_node.stored_state import packed, unpacked
from monitor_node.stuck import StuckState, most_equal
from monitor_node.suspicion import SuspicionState
from monitor_node.watch_state import WatchedState, WatchState
from reactorwatch.contract import keys
from reactorwatch.contract.messages_pb2 import AlarmKpis
from reactorwatch.contract.sample_bytes import unit_digest
from reactorwatch.process.cstr import cstr
from reactorwatch.process.filter import FilterState, NoiseLevels, variances
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS

CHARTS = (Shewhart.name, Ewma.name, Cusum.name, Mewma.name)
"""That quiet plants may have, in the order of `quiet_rows.judge`."""

UNITS_NS = (1_000_000, 1_000, 1)
"""In which spacings are kept, the first in which all are whole."""

COUNTS = ("rows", "incomplete_rows", "late", "duplicated", "out_of_order", "lost", "restarts")


class Rest(NamedTuple):
    """What is remembered of a plant beside its record.

    Attributes:
        board: its alarms; None if none ever came up.
        refused: counts by reason.
        runs: of equal readings in the training, one an output, as MessagePack.
        units: of the signals.
        checks: what was said of the training.
        refusals: trainings that were refused.
        until_drift: rows until the next look at the drift.
        cause: what was looked for last: number of the incident, output and cause.
    """

    board: AlarmBoard | None
    refused: dict[str, int] | None
    runs: bytes
    units: tuple[str, ...]
    checks: tuple[tuple[str, str], ...]
    refusals: int
    until_drift: int
    cause: tuple[int, str, str]


class NewestRows(NamedTuple):
    """The newest rows of a plant, oldest first.

    Attributes:
        times_ns: of each.
        values: of each, input first, shape (rows, signals); without columns if they are not kept.
    """

    times_ns: list[int]
    values: Array


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
        places: of the first alarm of each kind of chart, see `quiet_rows.judge`.
        rules: of each chart's alarm, likewise.
        figures: of alarms that never came up, but for the time.
        least_s: see `Silence`.
    """

    def __init__(self, config: MonitorConfig, model: ProcessModel) -> None:
        self.config, self._model = config, model
        names = alarm_names(config)
        self._alarms = [keys.chart_name(*pair) for pair in names]
        self._signals = (config.input, *config.outputs)
        self.record = quiet_rows.record_type(len(config.outputs), len(model.states), len(names))
        self._looks = config.isolation and model.name == cstr().name  # as in `watch`
        remembered = REMEMBERED * config.reorder_rows
        self.keeps = config.isolation_rows if self._looks else remembered
        self.columns = len(self._signals) if self._looks else 0
        kinds = [chart for chart, _ in names]
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
        if not set(config.charts) <= set(CHARTS) or (len(config.outputs) < 2 and Mewma.name in config.charts):
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
        receipt = monitor.receipt
        if monitor.is_catching_up or monitor.phase != "watching":
            return None
        if receipt.received_ns is None or receipt.counted_ns is None:
            return None
        state = monitor.state
        watched, alignment = state.watch.watched, state.alignment
        board = msgspec.msgpack.decode(state.board, type=BoardState)
        if watched is None or not isinstance(watched.reference, ProcessReferenceState):
            return None
        if not _is_at_rest(board, self._alarms) or not _is_in_order(alignment) or not _run_on(state.runs, alignment):
            return None
        rows = self._rows(alignment, watched.suspicion)
        if rows is None or not _is_usual(state.watch, watched, watched.reference, rows.times_ns[-1]):
            return None
        record[:] = np.zeros(1, self.record)
        p = record[0]
        for name, known in receipt._asdict().items():
            p[name] = known
        p["run_spacing_ns"] = [run.spacing_ns for run in state.runs]
        p["run_deviation_ns"] = [run.deviation_ns for run in state.runs]
        p["received"], p["published"] = state.received, state.published
        p["first_ns"], p["watching_since_ns"] = state.first_ns, state.watching_since_ns
        p["began_ns"], p["width"] = state.watch.began_ns, watched.charts.widths
        p["heard_from_ns"] = [state.heard_from_ns[signal] for signal in self._signals]
        p["unit"] = [unit_digest(state.units[signal]) for signal in self._signals]
        p["kpi_minute"], p["arl0"], p["rows_watched"] = board.kpi_minute, watched.arl0, watched.rows_watched
        _write_alignment(p, alignment)
        sampling = state.watch.sampling
        p["last_ns"], p["period_ns"], p["spacing_ns"] = sampling.last_ns, sampling.period_ns, sampling.spacing_ns
        _write_signals(p, state.watch.signals)
        reference = watched.reference
        p["time_min"], p["input"] = reference.filter.time_min, reference.last_input
        p["memory"] = [*reference.filter.x, *reference.filter.P]
        p["noise"] = [*reference.noise.measurement_sd, *reference.noise.process_sd]
        p["variance"], p["typical_sd"] = variances(self._model, reference.noise), reference.typical_sd
        for place, item in enumerate(watched.whiteners):
            _write_whitener(p, place, item)
        self._write_charts(p, watched.charts)
        for place, name in enumerate(self._alarms):
            memory = board.alarms[name]
            p["recent"][place], p["in_a_row"][place] = memory.rule.recent, memory.rule.in_a_row
            p["above"][place] = memory.above
        looked = watched.suspicion
        rest = Rest(
            None if self._never_came_up(board) else monitor.alarms,
            state.refused or None,
            msgspec.msgpack.encode([(item.runs, item.arl0) for item in state.watch.signals.stuck]),
            tuple(state.units[signal] for signal in self._signals),
            tuple(watched.checks),
            state.watch.refusals,
            watched.until_drift,
            (0, "", "") if looked is None else (looked.incident, looked.output, looked.cause),
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
        rows = unpacked(looked.rows, 1 + len(self._signals))
        if len(rows) < len(left) or not np.isfinite(rows).all():
            return None
        known = _times_ns(rows[: len(rows) - len(left), 0]) + times_ns
        if [time_ns / MINUTE_NS for time_ns in known] != rows[:, 0].tolist():
            return None
        return NewestRows(known, rows[:, 1:])

    def _never_came_up(self, board: BoardState) -> bool:
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
            known = packed(np.column_stack([minutes, rows.values]))
            looked = SuspicionState(known, rest.cause[0], None, None, rest.cause[1], rest.cause[2], None)
        outputs = range(len(self.config.outputs))
        watched = WatchedState(
            _reference(p, len(self._model.states)),
            list(rest.checks),
            [_whitener(p, place) for place in outputs],
            self._charts(p),
            looked,
            float(p["arl0"]),
            [False] * len(outputs),
            int(p["rows_watched"]),
            rest.until_drift,
        )
        watch = WatchState(
            SamplingState(int(p["last_ns"]), [], float(p["period_ns"]), int(p["spacing_ns"])),
            self._signals_state(p, rest),
            self._predictors,
            rest.refusals,
            int(p["began_ns"]),
            self._training,
            watched,
        )
        return MonitorState(
            {},
            self._runs(p),
            self._alignment(p, [*rows.times_ns, *waiting]),
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
        )

    def _runs(self, p: np.void) -> list[SampleRun]:
        runs: list[SampleRun] = []
        for place in range(len(self._signals)):
            newest_ns = int(p["pending_ns"] if p["have"] >> place & 1 else p["left_ns"])
            spacing_ns, deviation_ns = float(p["run_spacing_ns"][place]), float(p["run_deviation_ns"][place])
            runs.append(SampleRun(int(p["expected"][place]) - 1, newest_ns, spacing_ns, deviation_ns, FULL_RUN))
        return runs

    def _alignment(self, p: np.void, times_ns: list[int]) -> AlignmentState:
        signals = range(len(self._signals))
        have = [bool(p["have"] >> signal & 1) for signal in signals]
        expected, pending_ns, left_ns = p["expected"].tolist(), int(p["pending_ns"]), int(p["left_ns"])
        newest = [number - 1 - here for number, here in zip(expected, have, strict=True)]
        kept = times_ns[-int(p["left"]) :]
        left: dict[int, list[int | None]] = {
            time_ns: [number - age for number in newest]
            for age, time_ns in zip(range(len(kept) - 1, -1, -1), kept, strict=True)
        }
        pending = {}
        if any(have):
            values = [float(value) if here else float("nan") for value, here in zip(p["values"], have, strict=True)]
            numbers = [number - 1 if here else None for number, here in zip(expected, have, strict=True)]
            pending[pending_ns] = Waiting(values, numbers, have.count(False))
        numbering = [
            Numbering(number, pending_ns if here else left_ns) for number, here in zip(expected, have, strict=True)
        ]
        counts = Counts(**dict(zip(COUNTS, p["counts"].tolist(), strict=True)))
        return AlignmentState(pending, left, left_ns, list(newest), numbering, False, counts)

    def _signals_state(self, p: np.void, rest: Rest) -> SignalsState:
        receipts = Spacing(int(p["receipt_count"]), float(p["receipt_mean"]), float(p["receipt_deviation"]))
        silences = []
        spacings = zip(*(p[f"silence_{field}"].tolist() for field in ("count", "mean", "deviation")), strict=True)
        for place, (count, mean, deviation) in enumerate(spacings):
            heard = Spacing() if place else receipts
            spacing = Spacing(count, mean, deviation)
            silences.append(
                SilenceState(self.config.silence_periods, self.least_s, spacing, heard, int(p["last_ns"]), False)
            )
        runs = msgspec.msgpack.decode(rest.runs, type=list[tuple[dict[int, int], float]])
        stuck = [
            StuckState(
                arl0,
                of_training,
                float(p["quietest"][place]),
                float(p["last"][place]),
                int(p["repeats"][place]),
                p["steps"][place, : p["stepped"][place]].tolist(),
                False,
            )
            for place, (of_training, arl0) in enumerate(runs)
        ]
        spikes = [
            SpikeState(float(limit), "quiet", 0.0) if isfinite(limit) else None for limit in p["spike_limit"].tolist()
        ]
        return SignalsState(silences, stuck, spikes)

    def _charts(self, p: np.void) -> ChartsState:
        charts: dict[str, bytes] = {}
        for name in dict.fromkeys(self.config.charts):
            if name == Mewma.name:
                mean, covariance, average = (p[field].tolist() for field in ("mean", "covariance", "average"))
                weight, limit = self.config.mewma_weight, float(p["mewma_limit"])
                charts[name] = MewmaState(mean, covariance, weight, limit, average).to_bytes()
            else:
                numbers = p[name].astype("<f8").tobytes()
                charts[name] = SignalState(name, len(self.config.outputs), numbers).to_bytes()
        passed = [_whitener(p, place).learned.passed for place in range(len(self.config.outputs))]
        return ChartsState(charts, p["width"].tolist(), passed)

    def _board_of(self, plant: str, p: np.void, rest: Rest) -> bytes:
        board = msgspec.msgpack.decode(self._board if rest.board is None else rest.board.to_bytes(), type=BoardState)
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


def _is_at_rest(board: BoardState, of_charts: list[str]) -> bool:
    """Whether no alarm stands or is shelved, and none but those of charts has anything in its memory."""
    if board.kpis_changed or board.told is None or board.kpi_minute is None:
        return False
    return all(
        not memory.rule.standing and memory.state is not State.SHELVED and (name in of_charts or not memory.rule.recent)
        for name, memory in board.alarms.items()
    )


def _is_in_order(alignment: AlignmentState) -> bool:
    """Whether no sample is missing, and at most one row waits, the newest."""
    left_ns, newest = alignment.newest_left_ns, alignment.newest_numbers
    if alignment.restarted or left_ns is None or len(alignment.pending) > 1:
        return False
    pending_ns, waiting = next(iter(alignment.pending.items()), (left_ns, None))
    if waiting is not None and pending_ns <= left_ns:
        return False
    for place, (before, numbering) in enumerate(zip(newest, alignment.sequences, strict=True)):
        number = None if waiting is None else waiting.numbers[place]
        last, last_ns = (before, left_ns) if number is None else (number, pending_ns)
        if before is None or last is None or (number is not None and number != before + 1):
            return False
        if (numbering.expected, numbering.newest_ns) != (last + 1, last_ns):
            return False
    return True


def _run_on(runs: list[SampleRun], alignment: AlignmentState) -> bool:
    """Whether no sample is held, the usual spacings are known, and the runs have come as far as the rows."""
    return all(
        not run.held
        and run.spacings == FULL_RUN
        and run.number is not None
        and (run.number + 1, run.time_ns) == (numbering.expected, numbering.newest_ns)
        for run, numbering in zip(runs, alignment.sequences, strict=True)
    )


def _is_usual(watch: WatchState, watched: WatchedState, reference: ProcessReferenceState, last_ns: int) -> bool:
    """Whether the newest row was judged by all, and left nothing undecided."""
    sampling, signals = watch.sampling, watch.signals
    if sampling.last_ns != last_ns or sampling.period_ns is None or sampling.spacing_ns is None:
        return False
    if reference.guessed or reference.filter.time_min != last_ns / MINUTE_NS or True in watched.withheld:
        return False
    return (
        reference.filter.inputs == (reference.last_input,)
        and all(not silence.standing and silence.last_ns == last_ns for silence in signals.silences)
        and all(not stuck.learning and stuck.last is not None for stuck in signals.stuck)
        and all(spike is None or spike.phase == "quiet" for spike in signals.spikes)
        and all(len(item.past) == max(len(item.learned.coefficients), 1) for item in watched.whiteners)
    )


def _times_ns(times_min: Array) -> list[int]:
    """Times of rows, as whole as minutes tell them: in milliseconds if these are they."""
    whole = np.floor(times_min)
    rest_ns = (times_min - whole) * MINUTE_NS
    for unit_ns in UNITS_NS:
        times_ns = [
            int(minute) * MINUTE_NS + round(over / unit_ns) * unit_ns
            for minute, over in zip(whole.tolist(), rest_ns.tolist(), strict=True)
        ]
        if [time_ns / MINUTE_NS for time_ns in times_ns] == times_min.tolist():
            break
    return times_ns


def kept_spacings(times_ns: list[int], usual_ns: int) -> tuple[int, NDArray[np.int32]] | None:
    """The spacings of rows as the ring keeps them, and the unit that they are in; None if they do not fit.

    Args:
        times_ns: of the rows; of the first no spacing is known, which is kept as the usual one.
        usual_ns: the usual spacing.
    """
    over = np.diff(times_ns, prepend=times_ns[0] - usual_ns) - usual_ns
    unit_ns = next(unit for unit in UNITS_NS if not np.any(over % unit))
    kept = over // unit_ns
    return None if np.any(np.abs(kept) >= 2**31) else (unit_ns, kept.astype(np.int32))


def _write_alignment(p: np.void, alignment: AlignmentState) -> None:
    p["expected"] = [numbering.expected or 0 for numbering in alignment.sequences]
    p["left"], p["left_ns"] = len(alignment.left), alignment.newest_left_ns or 0
    p["counts"] = [getattr(alignment.counts, name) for name in COUNTS]
    for pending_ns, waiting in alignment.pending.items():
        p["pending_ns"], p["values"] = pending_ns, waiting.values
        p["have"] = sum(1 << place for place, number in enumerate(waiting.numbers) if number is not None)


def _write_signals(p: np.void, signals: SignalsState) -> None:
    receipts = signals.silences[0].receipts
    p["receipt_count"], p["receipt_mean"], p["receipt_deviation"] = msgspec.structs.astuple(receipts)
    for place, silence in enumerate(signals.silences):
        count, mean, deviation = msgspec.structs.astuple(silence.rows)
        p["silence_count"][place], p["silence_mean"][place], p["silence_deviation"][place] = count, mean, deviation
    for place, (stuck, spike) in enumerate(zip(signals.stuck, signals.spikes, strict=True)):
        p["spike_limit"][place] = inf if spike is None else spike.limit
        p["equal_limit"][place], p["quietest"][place] = most_equal(stuck.runs, stuck.arl0), stuck.quietest
        p["last"][place], p["repeats"][place] = stuck.last, stuck.repeats
        p["stepped"][place] = len(stuck.steps)
        p["steps"][place, : len(stuck.steps)] = stuck.steps


def _write_whitener(p: np.void, place: int, state: PrewhitenerState) -> None:
    learned, order = state.learned, len(state.learned.coefficients)
    p["order"][place], p["learned_rows"][place] = order, learned.rows
    p["constant"][place], p["sigma"][place] = learned.constant, learned.sd
    p["coefficients"][place, :order] = learned.coefficients
    p["sigma_variance"][place], p["passed_variance"][place] = learned.sd_variance, learned.passed_variance
    p["past"][place, : len(state.past)] = state.past


def _whitener(p: np.void, place: int) -> PrewhitenerState:
    order = int(p["order"][place])
    learned = Prewhitening(
        float(p["constant"][place]),
        tuple(p["coefficients"][place, :order].tolist()),
        float(p["sigma"][place]),
        int(p["learned_rows"][place]),
        float(p["sigma_variance"][place]),
        float(p["passed_variance"][place]),
    )
    return PrewhitenerState(learned, p["past"][place, : max(order, 1)].tolist())


def _reference(p: np.void, states: int) -> ProcessReferenceState:
    memory, noise, outputs = p["memory"].tolist(), p["noise"].tolist(), len(p["typical_sd"])
    last_input = float(p["input"])
    return ProcessReferenceState(
        NoiseLevels(tuple(noise[:outputs]), tuple(noise[outputs:])),
        FilterState(float(p["time_min"]), (last_input,), tuple(memory[:states]), tuple(memory[states:])),
        last_input,
        False,
        p["typical_sd"].tolist(),
    )
