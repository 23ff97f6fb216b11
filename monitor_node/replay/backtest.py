"""Back-test: run the monitor's core over a recording at full speed, after checks of the record that it learns from."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

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
from reactorwatch.contract.alarm_text import set_suspects
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Alarm, Baseline, Incident, Promise
from reactorwatch.errors import UnfitRecordError
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import Record

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


@dataclass
class Backtest:
    """Result of a back-test.

    Attributes:
        inputs: names of the inputs.
        outputs: names of the outputs.
        rows: number of rows.
        first_ns: time of the first row; 0 without rows.
        last_ns: time of the last row; 0 without rows.
        span_ns: time span of the rows, summed over the runs of the plant.
        runs: number of runs of the plant: one more than restarts of the plant or its clock.
        watching_since_ns: time of the first evaluated row; None if the record is shorter than the training.
        expected_false_alarms: see `PlantPipeline.expected_false_alarms`.
        alarm_messages: every change of an alarm, in order.
        refused: number of rejected messages by reason.
        notes: notes on the training.
        left_out: signals that are not monitored, with the reason.
        reference: kind of the reference, `equations` or `arx`; None if no row was evaluated.
        noise_levels: standard deviations of the equations' filter: of each sensor in its unit (`sensors`), of each
            state in its unit per square root of a minute (`states`); None with another reference.
        training_rows: number of rows of the training; 0 if no row was evaluated.
        promise: promise of false alarms for the evaluated rows; None if no row was evaluated.
        not_watched: reason why no row could be judged; empty if one was.
        baseline: change of the model after the diagnosis of the training; None: rows were evaluated by the equations as
            given.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    rows: int
    first_ns: int
    last_ns: int
    span_ns: int
    runs: int
    watching_since_ns: int | None
    expected_false_alarms: float
    alarm_messages: list[Alarm]
    incident_messages: list[Incident]
    refused: dict[str, int]
    notes: list[str]
    left_out: dict[str, str]
    reference: str | None = None
    noise_levels: dict[str, dict[str, float]] | None = None
    baseline: Baseline | None = None
    training_rows: int = 0
    promise: Promise | None = None
    not_watched: str = ""

    @property
    def raised_alarms(self) -> list[tuple[Alarm, int | None]]:
        """Each alarm as raised, with its newest suspects, and the time when it was cleared (None: it is active)."""
        alarms: list[tuple[Alarm, int | None]] = []
        last: dict[str, int] = {}
        newest = {message.number: message.suspects for message in self.incident_messages}
        for message in self.alarm_messages:
            if message.event == RAISED:
                last[message.alarm] = len(alarms)
                alarm = Alarm()
                alarm.CopyFrom(message)
                alarms.append((alarm, None))
            elif message.alarm in last:
                alarm, cleared_ns = alarms[last[message.alarm]]
                if message.raised_ns == alarm.raised_ns and message.suspects:
                    set_suspects(alarm, message.suspects)
                if cleared_ns is None and (message.cleared_ns or message.event == CLEARED):
                    cleared_ns = message.cleared_ns
                alarms[last[message.alarm]] = (alarm, cleared_ns)
        for alarm, cleared_ns in alarms:
            if cleared_ns is None and not alarm.names_cause:
                set_suspects(alarm, newest.get(alarm.incident, ()))
        return alarms


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
    zero_ns: int = 0,
    model: ProcessModel | None = None,
    trained: TrainedPlant | None = None,
    log: RowLog | None = None,
) -> Backtest:
    """Run the monitor over messages in the order of receipt.

    Args:
        messages: messages; all but samples of `config.plant` are ignored.
        config: settings of the monitor.
        zero_ns: zero of the model's minutes, if its file does not have it.
        model: model with the equations, with minutes from 1970-01-01 UTC; None: the one that the settings name.
        trained: result of a training with the same settings and model, by which all rows are judged; None: the rows
            begin with a training.
        log: log to which the rows are added; None: they are not logged.

    Raises:
        InputError: the settings are inconsistent, or the model's file is unusable.
    """
    monitor = _make_monitor(config, zero_ns, model)
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
    reference = monitor.pipeline.evaluation.reference
    return Backtest(
        inputs=monitor.config.inputs,
        outputs=monitor.config.outputs,
        rows=monitor.rows,
        first_ns=first_ns or 0,
        last_ns=monitor.memory.last_ns or 0,
        span_ns=monitor.span_ns,
        runs=1 + monitor.intake.aligner.memory.counts.restarts,
        watching_since_ns=monitor.memory.watching_since_ns,
        expected_false_alarms=monitor.pipeline.baselines.expected_false_alarms,
        alarm_messages=alarms,
        incident_messages=incidents,
        refused=dict(monitor.intake.rejects.by_reason),
        notes=[*(trained.notes if trained is not None else ()), *monitor.notes],
        left_out=monitor.excluded_signals,
        reference=monitor.pipeline.reference or monitor.pipeline.baselines.modes.reference or None,
        noise_levels=None if reference is None else reference.noise_levels,
        baseline=monitor.baseline,
        training_rows=monitor.pipeline.training.trained_rows if trained is None else trained.rows,
        promise=monitor.promise,
        not_watched=_describe_obstacle(monitor),
    )


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


def check_watched(name: object, result: Backtest) -> None:
    """Check that there was something to watch.

    Args:
        name: name of the record.
        result: result of its back-test.

    Raises:
        InputError: it has no usable row, or no output that can be watched.
    """
    if not result.rows:
        why = ", ".join(f"{count} {reason}" for reason, count in sorted(result.refused.items()))
        raise UnfitRecordError(f"{name}: holds no sample that can be used{f'; refused: {why}' if why else ''}")
    if set(result.outputs) <= result.left_out.keys():
        reasons = "; ".join(f"{output}: {result.left_out[output]}" for output in result.outputs)
        raise UnfitRecordError(f"{name}: there is no output to watch ({reasons})")


def _only_value(record: Record, name: str) -> float | None:
    """Value that a signal has in all rows; None if it varies."""
    values = record.columns.get(name)
    if values is None or not np.isfinite(values).any():
        return None
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return low if low == high else None
