"""Back-test: run the monitor's core over a recording at full speed, after checks of the record that it learns from."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.diagnosis_worker import find_deviations
from monitor_node.learn.arx import arx_structure
from monitor_node.learn.arx_fit import fewest_rows
from monitor_node.learn.baseline import FEWEST_ROWS
from monitor_node.monitor_state import MonitorMemory
from monitor_node.watch.pipeline import PipelineMemory
from monitor_node.watched_process import load_process
from reactorwatch.contract import keys
from reactorwatch.contract.alarm_states import Event
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Alarm, Baseline, Incident
from reactorwatch.contract.messages_pb2 import Promise as PromiseMessage
from reactorwatch.errors import UnfitRecordError
from reactorwatch.limits import parse_json
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import Record, format_utc, to_minutes
from reactorwatch.results.alarms import raised_alarms
from reactorwatch.results.backtest import Backtest, ChangedModel, LeftOut, NoiseLevels, WatchedSignals
from reactorwatch.results.promise import Power, Promise, state_promise, three_digits

RAISED, CLEARED = Event.RAISED.value, Event.CLEARED.value


class LoggedRow(NamedTuple):
    """A row and its alarms.

    Attributes:
        time_ns: time of the row.
        in_alarm: True if an alarm is active after the row, acknowledged or not.
        raised: True if an alarm was raised by the row.
    """

    time_ns: int
    in_alarm: bool
    raised: bool


class RowLog:
    """Follows the alarms from row to row."""

    def __init__(self) -> None:
        self.rows: list[LoggedRow] = []
        self._active: set[str] = set()

    def add(self, memory: MonitorMemory, time_ns: int, publications: Sequence[Publication]) -> None:
        """Add a row; one of the training is logged without alarms.

        Args:
            memory: memory of the monitor.
            time_ns: time of the row.
            publications: publications because of the row.
        """
        judged, raised = memory.watching_since_ns is not None, False
        for publication in publications:
            message = publication.message
            if not isinstance(message, Alarm):
                continue
            if message.event == RAISED:
                self._active.add(message.alarm)
                raised = True
            elif message.event == CLEARED or message.cleared_ns:
                self._active.discard(message.alarm)
        self.rows.append(LoggedRow(time_ns, judged and bool(self._active), judged and raised))


def rows_of_file(logged: Sequence[LoggedRow], times_ns: Sequence[int]) -> list[LoggedRow]:
    """Rows of a file with their alarms.

    Args:
        logged: the rows that were watched, in the order of the file.
        times_ns: times of the file's rows; one without any value was not watched, and its alarms are those before it.

    Returns:
        One row for each time.
    """
    rows: list[LoggedRow] = []
    index = 0
    for time_ns in times_ns:
        if index < len(logged) and logged[index].time_ns == time_ns:
            rows.append(logged[index])
            index += 1
        else:
            rows.append(LoggedRow(time_ns, bool(rows) and rows[-1].in_alarm, raised=False))
    return rows


class TrainedPlant(NamedTuple):
    """A plant after its training, to be judged on other records.

    Attributes:
        rows: number of rows of the training.
        memory: memory of the trained pipeline as stored, so that other processes can be given it.
        notes: notes on the training.
    """

    rows: int
    memory: bytes
    notes: list[str]


class RecordFacts(NamedTuple):
    """Facts about a record that its messages do not have.

    Attributes:
        file: name of the record.
        clock_shift_ns: shift from the times of its messages to clock time; None: unknown.
        still: inputs that never move, with the reason why they explain nothing.
    """

    file: str = "record"
    clock_shift_ns: int | None = None
    still: Mapping[str, str] = MappingProxyType({})


def train(
    messages: Iterable[Encoded], config: MonitorConfig, zero_ns: int = 0, model: ProcessModel | None = None
) -> TrainedPlant:
    """Train a monitor on all rows of a record; arguments as for `run`.

    Raises:
        InputError: as `run`; or the record has too few rows, or no output that can be watched.
    """
    monitor = _make_monitor(config, zero_ns, model)
    monitor.pipeline.training.open()
    for _ in _publications(monitor, messages):
        pass
    monitor.pipeline.end_training(monitor.memory.last_ns or 0)
    return TrainedPlant(monitor.pipeline.training.trained_rows, monitor.pipeline.memory.to_bytes(), [*monitor.notes])


def run(
    messages: Iterable[Encoded],
    config: MonitorConfig,
    zero_ns: int | None = 0,
    model: ProcessModel | None = None,
    trained: TrainedPlant | None = None,
    log: RowLog | None = None,
    facts: RecordFacts | None = None,
) -> Backtest:
    """Run the monitor over messages in the order of receipt.

    Args:
        messages: messages; all but samples of `config.plant` are ignored.
        config: settings of the monitor.
        zero_ns: time from which minutes are counted, those of the model, too, if its file does not have it; None: that
            of the first sample.
        model: model with the equations, with minutes from 1970-01-01 UTC; None: the one that the settings name.
        trained: result of a training with the same settings and model, by which all rows are judged; None: the rows
            begin with a training.
        log: log to which the rows are added; None: they are not logged.
        facts: facts about the record; None: its name and clock time are unknown.

    Raises:
        InputError: the settings are inconsistent, or the model's file is unusable.
    """
    monitor, facts = _make_monitor(config, zero_ns or 0, model), facts or RecordFacts()
    if trained is not None:
        monitor.pipeline.resume(PipelineMemory.from_bytes(trained.memory), 0)
        monitor.pipeline.start_run()
    if log is not None:
        monitor.on_row_end = partial(log.add, monitor.memory)
    alarms, incidents = list[Alarm](), list[Incident]()
    first_ns: int | None = None
    for publications in _publications(monitor, messages):
        if first_ns is None:
            first_ns = monitor.memory.first_ns
        alarms += (item.message for item in publications if isinstance(item.message, Alarm))
        incidents += (item.message for item in publications if isinstance(item.message, Incident))
    first_ns = first_ns or 0
    zero_ns = first_ns if zero_ns is None else zero_ns
    clock_zero_ns = None if facts.clock_shift_ns is None else zero_ns + facts.clock_shift_ns
    obstacle, since_ns, elsewhere = _describe_obstacle(monitor), monitor.memory.watching_since_ns, trained is not None
    expected, message = monitor.pipeline.baselines.expected_false_alarms, monitor.promise
    promise, power = _promise_of_rows(message, expected)
    return Backtest(
        file=facts.file,
        watched=not obstacle,
        why=obstacle or None,
        samples=monitor.rows,
        zero=None if clock_zero_ns is None else format_utc(clock_zero_ns),
        span_min=to_minutes(monitor.span_ns),
        runs=1 + monitor.intake.aligner.memory.counts.restarts,
        trained_until_min=0.0 if elsewhere else None if since_ns is None else to_minutes(since_ns, zero_ns),
        expected_false_alarms=three_digits(expected),
        promise=promise,
        power=power,
        signals=_watched_signals(monitor.config, {**facts.still, **monitor.excluded_signals}),
        reference=monitor.pipeline.reference or monitor.pipeline.baselines.modes.reference or None,
        noise_levels=_noise_levels(monitor),
        baseline=_changed_model(monitor.baseline, zero_ns),
        alarms=raised_alarms(alarms, incidents, zero_ns),
        training_rows=monitor.pipeline.training.trained_rows if trained is None else trained.rows,
        can_keep_per_30_days=None if message is None else message.can_keep_per_30_days,
        trained_elsewhere=elsewhere,
        notes=[*(trained.notes if trained is not None else ()), *monitor.notes],
        refused=dict(monitor.intake.rejects.by_reason),
        zero_ns=zero_ns,
        clock_zero_ns=clock_zero_ns,
        first_ns=first_ns,
        last_ns=monitor.memory.last_ns or 0,
        watching_since_ns=since_ns,
        alarm_messages=alarms,
        incident_messages=incidents,
    )


def _promise_of_rows(message: PromiseMessage | None, expected: float) -> tuple[Promise | None, list[Power]]:
    """Promise for the rows that were judged, and power.

    Args:
        message: the promise at the end of the record; None: no row was judged.
        expected: false alarms promised in these rows.
    """
    promise, power = state_promise(message)
    if promise is None or message is None:
        return None, power
    upper = expected * message.expected_90 / message.expected
    return replace(promise, expected=three_digits(expected), expected_90=three_digits(upper)), power


def _watched_signals(config: MonitorConfig, left_out: Mapping[str, str]) -> WatchedSignals:
    inputs, outputs = ([name for name in names if name not in left_out] for names in (config.inputs, config.outputs))
    return WatchedSignals(inputs, outputs, [LeftOut(name, why) for name, why in left_out.items()])


def _noise_levels(monitor: Monitor) -> NoiseLevels | None:
    reference = monitor.pipeline.evaluation.reference
    levels = None if reference is None else reference.noise_levels
    return None if levels is None else NoiseLevels(**levels)


def _changed_model(change: Baseline | None, zero_ns: int) -> ChangedModel | None:
    if change is None:
        return None
    return ChangedModel(change.what, to_minutes(change.time_ns, zero_ns), change.why, parse_json(change.model))


def _publications(monitor: Monitor, messages: Iterable[Encoded]) -> Iterator[list[Publication]]:
    """Publications of a monitor because of each sample of its plant, and of the end of the record."""
    prefix = keys.key(monitor.config.plant, keys.SAMPLE, "")
    for message in messages:
        if message.key.startswith(prefix):
            yield monitor.on_message(message, message.received_ns)
    yield monitor.finish()


def _describe_obstacle(monitor: Monitor) -> str:
    """Reason why no row could be judged; empty if one was."""
    pipeline = monitor.pipeline
    if pipeline.has_judged:
        return ""
    if not pipeline.baselines.modes.is_judged:
        return "the training has seen no row in the plant's mode of operation; train on rows in it"
    if pipeline.watching:
        return (
            "no row could be predicted: rows must come one by one period, that of the training, with values of the "
            "inputs that it has seen; train on rows like these"
        )
    if refused := pipeline.training.refused:
        return f"no training was fit to learn from: {refused}"
    return "too short: all of it went into the training; make it shorter with --training or --training-rows"


def _make_monitor(config: MonitorConfig, zero_ns: int, model: ProcessModel | None) -> Monitor:
    if model is None:
        config, model = load_process(config, zero_ns)
    return Monitor(config, start_ns=0, points=False, model=model, diagnose=find_deviations, power=True)


def check_training_record(record: Record, config: MonitorConfig, model: ProcessModel | None) -> dict[str, str]:
    """Check that a monitor can learn from a record.

    Args:
        record: the record, with the signals of the settings.
        config: settings of the monitor.
        model: equations; None: models are identified.

    Returns:
        Inputs that never move, with the reason why they explain nothing.

    Raises:
        InputError: there are too few rows, or no output ever changes.
    """
    constant = {name: value for name in config.signals if (value := _only_value(record, name)) is not None}
    still = [name for name in config.outputs if name in constant and not config.smallest_sd.get(name)]
    if len(still) == len(config.outputs):
        readings = ", ".join(f"{name} reads {constant[name]:g}" for name in still)
        raise UnfitRecordError(
            f"{record.name}: at least one output must change, got {readings} in all {record.rows} rows; "
            "name outputs that do, or a record in which they do"
        )
    structure = arx_structure(config)
    needed = FEWEST_ROWS if model is not None else fewest_rows(structure)
    if record.rows <= needed:
        of_what = "the noise of the sensors" if model is not None else f"{structure.parameters} parameters an output"
        raise UnfitRecordError(
            f"{record.name}: must have more than {needed} rows to learn {of_what} from, got {record.rows}; "
            "record for longer, or learn from another record (--train)"
        )
    return {
        name: f"it never moves: it reads {constant[name]:g} in all rows" for name in config.inputs if name in constant
    }


def check_watched(name: object, outputs: Sequence[str], result: Backtest) -> None:
    """Check that there was something to watch.

    Args:
        name: name of the record.
        outputs: names of its outputs.
        result: result of its back-test.

    Raises:
        InputError: it has no usable row, or no output that can be watched.
    """
    if not result.samples:
        why = ", ".join(f"{count} {reason}" for reason, count in sorted(result.refused.items()))
        raise UnfitRecordError(f"{name}: holds no sample that can be used{f'; refused: {why}' if why else ''}")
    if not result.signals.outputs:
        reasons = "; ".join(f"{output}: {result.exclusions[output]}" for output in outputs)
        raise UnfitRecordError(f"{name}: there is no output to watch ({reasons})")


def _only_value(record: Record, name: str) -> float | None:
    """Value that a signal has in all rows; None if it varies."""
    values = record.columns.get(name)
    if values is None or not np.isfinite(values).any():
        return None
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return low if low == high else None
