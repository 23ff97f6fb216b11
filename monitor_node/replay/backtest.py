"""Back-test: run the monitor's core over a recording at full speed."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from monitor_node.alarms.states import Event
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.diagnosis_worker import find_deviations
from monitor_node.pipeline.pipeline_state import PipelineState
from monitor_node.replay.row_log import RowLog
from monitor_node.watched_process import load_process
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Alarm, Baseline, Promise
from reactorwatch.process.model import ProcessModel

RAISED, CLEARED = Event.RAISED.value, Event.CLEARED.value


class TrainedPlant(NamedTuple):
    """A plant after its training, to be judged on other records.

    Attributes:
        rows: number of rows of the training.
        state: the trained pipeline.
        notes: notes on the training.
    """

    rows: int
    state: PipelineState
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
        refused_trainings: number of refused trainings.
        reference: kind of the reference, `equations` or `arx`; None if no row was evaluated.
        noise_levels: standard deviations of the equations' filter: of each sensor in its unit (`sensors`), of each
            state in its unit per square root of a minute (`states`); None with another reference.
        training_rows: number of rows of the training; 0 if no row was evaluated.
        promise: promise of false alarms for the evaluated rows; None if no row was evaluated.
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
    refused: dict[str, int]
    notes: list[str]
    left_out: dict[str, str]
    refused_trainings: int
    reference: str | None = None
    noise_levels: dict[str, dict[str, float]] | None = None
    baseline: Baseline | None = None
    training_rows: int = 0
    promise: Promise | None = None

    @property
    def raised_alarms(self) -> list[tuple[Alarm, int | None]]:
        """Each alarm as raised, with its newest suspects, and the time when it was cleared (None: it is active)."""
        alarms: list[tuple[Alarm, int | None]] = []
        last: dict[str, int] = {}
        for message in self.alarm_messages:
            if message.event == RAISED:
                last[message.alarm] = len(alarms)
                alarm = Alarm()
                alarm.CopyFrom(message)
                alarms.append((alarm, None))
            elif message.alarm in last:
                alarm, cleared_ns = alarms[last[message.alarm]]
                if message.raised_ns == alarm.raised_ns and message.suspects:
                    del alarm.suspects[:]
                    alarm.suspects.extend(message.suspects)
                if cleared_ns is None and (message.cleared_ns or message.event == CLEARED):
                    cleared_ns = message.cleared_ns
                alarms[last[message.alarm]] = (alarm, cleared_ns)
        return alarms


def train(
    messages: Iterable[Encoded], config: MonitorConfig, zero_ns: int = 0, model: ProcessModel | None = None
) -> TrainedPlant:
    """Train a monitor on all rows of a record; arguments as for `run`.

    Raises:
        InputError: as `run`; or the record has too few rows, or no output that can be watched.
    """
    monitor = _make_monitor(config, zero_ns, model)
    monitor.pipeline.open_training()
    prefix = keys.key(config.plant, keys.SAMPLE, "")
    for message in messages:
        if message.key.startswith(prefix):
            monitor.on_message(message, message.received_ns)
    monitor.finish()
    monitor.pipeline.end_training(monitor.memory.last_ns or 0)
    return TrainedPlant(monitor.pipeline.training_rows, monitor.pipeline.state, [*monitor.notes])


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
        monitor.pipeline.restore(trained.state, 0)
        monitor.pipeline.start_run()
    alarms: list[Alarm] = []
    first_ns: int | None = None
    if log is not None:
        rows = log  # the same log for the checker of types

        def log_row(time_ns: int, publications: list[Publication]) -> None:
            rows.add(time_ns, publications, judged=monitor.memory.watching_since_ns is not None)

        monitor.on_row_end = log_row

    def keep(publications: list[Publication]) -> None:
        alarms.extend(item.message for item in publications if isinstance(item.message, Alarm))

    prefix = keys.key(config.plant, keys.SAMPLE, "")
    for message in messages:
        if message.key.startswith(prefix) and (publications := monitor.on_message(message, message.received_ns)):
            keep(publications)
        if first_ns is None:
            first_ns = monitor.memory.first_ns
    keep(monitor.finish())
    return Backtest(
        inputs=monitor.config.inputs,
        outputs=monitor.config.outputs,
        rows=monitor.rows,
        first_ns=(monitor.memory.first_ns or 0) if first_ns is None else first_ns,
        last_ns=monitor.memory.last_ns or 0,
        span_ns=monitor.span_ns,
        runs=1 + monitor.restarts,
        watching_since_ns=monitor.memory.watching_since_ns,
        expected_false_alarms=monitor.pipeline.expected_false_alarms,
        alarm_messages=alarms,
        refused=dict(monitor.rejects.by_reason),
        notes=[*(trained.notes if trained is not None else ()), *monitor.notes],
        left_out=monitor.excluded_signals,
        refused_trainings=monitor.pipeline.refused_trainings,
        reference=monitor.pipeline.newest_reference or None,
        noise_levels=monitor.pipeline.noise_levels,
        baseline=monitor.baseline,
        training_rows=monitor.pipeline.training_rows if trained is None else trained.rows,
        promise=monitor.promise,
    )


def _make_monitor(config: MonitorConfig, zero_ns: int, model: ProcessModel | None) -> Monitor:
    if model is None:
        config, model = load_process(config, zero_ns)
    return Monitor(config, start_ns=0, points=False, model=model, diagnose=find_deviations, power=True)
