"""The public names of the package, for use from Python; nothing below is promised.

    >>> import reactorwatch as rw
    >>> sorted(rw.processes)
    ['cstr', 'tanks', 'three_tanks']

A process is given by its name, by the path of a file that describes it (`.toml`, `.py`, or `extended.json`, as
`diagnose` writes it), or as a `Process` or `ProcessModel`. Times are in minutes, values in the units of the process.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeAlias

import msgspec

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor as MonitorCore
from monitor_node.diagnosis_worker import find_deviations
from monitor_node.process_settings import signal_settings
from monitor_node.replay.backtest import run as run_backtest
from reactorwatch.cli.read_record import DEFAULT_PLANT
from reactorwatch.cli.read_record import record as read_file
from reactorwatch.cli.reports import backtest_object, backtest_text
from reactorwatch.cli.simulation import simulate_along
from reactorwatch.contract import keys
from reactorwatch.contract.alarm_text import priority_word
from reactorwatch.contract.codec import Publication, encode
from reactorwatch.contract.messages_pb2 import Alarm, Quality, Sample
from reactorwatch.description.find import find_process
from reactorwatch.description.process import Process
from reactorwatch.diagnosis.diagnose import diagnose as find_causes
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.diagnosis.report.machine import report_object
from reactorwatch.diagnosis.result import Diagnosis
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.identification.dataset import Dataset
from reactorwatch.identification.identify import Identification, ModelForm
from reactorwatch.identification.identify import identify as identify_model
from reactorwatch.process import MODELS
from reactorwatch.process.effect import Effect
from reactorwatch.process.extended_model import parse_extended_model
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.atomic import atomic_write
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.record import Record, to_minutes, to_time_ns
from reactorwatch.records.several_files import join_files
from reactorwatch.runtime.config import section
from reactorwatch.spc.charts import catalogue as charts  # noqa: F401 # a public name
from recorder.tools.player import samples_of

ProcessLike: TypeAlias = str | Path | Process | ProcessModel

processes: Mapping[str, Callable[[], ProcessModel]] = {make().name: make for make in MODELS}
"""The processes that are shipped, by name: functions that build their models."""


def effects(process: ProcessLike = "cstr") -> tuple[Effect, ...]:
    """The effects of a process: what can be injected into its simulation and named as a cause.

    Args:
        process: name, path of an extended model, or model.

    >>> effects("tanks")[0].name
    'pump_gain'
    """
    return find_process(process).causes


def read_record(
    file: str | Path | Sequence[str | Path],
    process: ProcessLike = "cstr",
    *,
    plant: str | None = None,
    columns: Mapping[str, str] | None = None,
    **form: Any,
) -> Record:
    """Read a measured record.

    Args:
        file: a table (`.csv`, `.xlsx`, `.parquet` and others), a recording (`.mcap`), a folder of recordings, or
            several files in a row.
        process: decides which signals the file must have, and how it is read.
        plant: name of the plant in a recording; None: the only one in it.
        columns: names of the columns in a table, by signal, where they differ.
        form: what is not to be guessed about a table: `time`, `time_unit`, `time_format`, `zone`, `period`, `missing`,
            `separator`, `decimal`, `header`, `transposed`, like the options of the commands.

    Returns:
        The record; `read_as` has the guesses about a table.

    Raises:
        InputError: the file cannot be read, a signal is missing, or `form` has another name.
    """
    known = [item.name for item in fields(FileFormat)]
    for name in form:
        if name not in known:
            raise InputError(describe_unknown("argument", name, known))
    missing = form.pop("missing", ())
    words = (missing,) if isinstance(missing, str | float | int) else missing
    stated, described = FileFormat(**form, missing=tuple(map(str, words))), find_process(process)
    files = [file] if isinstance(file, str | Path) else file
    return join_files([read_file(Path(item), plant, dict(columns or {}), described, stated) for item in files])


def simulate(record: Record, process: ProcessLike = "cstr", faults: Sequence[str] = ()) -> Record:
    """Simulate a process from the first row of a record (of each run), driven by the record's inputs.

    Args:
        record: with the inputs and outputs of the process.
        process: name, path of an extended model, or model.
        faults: specifications such as `coolant_flow:step:-0.05@30min`, in the record's time.

    Returns:
        The inputs and the simulated outputs in the rows of the record.

    Raises:
        InputError: the record cannot drive the model, or a specification is malformed.
    """
    return simulate_along(record, _model_of(process, record), list(faults))


def identify(
    record: Record,
    output: str,
    *,
    process: ProcessLike = "cstr",
    input: str | Sequence[str] | None = None,
    validate: Record | None = None,
    settle: int = 0,
    **form: Any,
) -> Identification:
    """Fit a model of one output to the first half of a record and validate it on the second.

    Args:
        record: with columns of the inputs and the output.
        output: name of the output.
        process: decides which signals are the inputs.
        input: names of the inputs, none, one or several; None: those of the process.
        validate: record to validate on; all of `record` is then fitted.
        settle: number of first held-out rows that may set the state, and are left out of the fits.
        form: `model` (`arx`, `oe`, `armax`, `bj`, `narx`), `order`, `delay` and `recursive`, like the options of the
            command.

    Raises:
        InputError: a signal is missing, the record cannot determine the model, or `form` has another name.
    """
    known = ("model", "order", "delay", "recursive")
    for name in form:
        if name not in known:
            raise InputError(describe_unknown("argument", name, known))
    inputs = find_process(process).inputs if input is None else (input,) if isinstance(input, str) else tuple(input)
    held_out = None if validate is None else Dataset.of_record(validate, inputs, output)
    return identify_model(Dataset.of_record(record, inputs, output), ModelForm(**form), held_out, settle)


@dataclass(frozen=True)
class DiagnosisResult(Diagnosis):
    """A `Diagnosis` with the record and the model that it compares.

    Attributes:
        record: the measured record.
        model: the simulation before it was extended.
        effects: possible causes.
    """

    record: Record = field(kw_only=True, repr=False, compare=False)
    model: ProcessModel = field(kw_only=True, repr=False, compare=False)
    effects: tuple[Effect, ...] = field(kw_only=True, repr=False, compare=False)

    @property
    def extended(self) -> ProcessModel:
        """The model with the causes in it: a process for `simulate`, `diagnose` and `backtest`."""
        return parse_extended_model(msgspec.json.encode(self.extended_model)).build()

    def to_dict(self) -> dict[str, Any]:
        """The object that `reactorwatch diagnose --json` prints, and the differences of the simulation."""
        return report_object(self, self.record.name, 0.0, self.record.zero)

    def to_html(self, file: str | Path) -> None:
        """Write the report as one page.

        Raises:
            InputError: the file cannot be written.
        """
        from reactorwatch.diagnosis.report.page import as_page

        names = (self.record.name, "extended.json", "experiment.csv")
        page = as_page(self, self.model, self.effects, *names, on_the_bus=False)
        with atomic_write(Path(file)) as temporary:
            temporary.write_text(page, encoding="utf-8")


def diagnose(
    record: Record,
    process: ProcessLike = "cstr",
    *,
    effects: tuple[Effect, ...] | None = None,
    without: Sequence[str] = (),
    uncertain: Mapping[str, float] | None = None,
    tolerance: Mapping[str, float] | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> DiagnosisResult:
    """Find what a simulation gets wrong in a record, name the cause and extend the model with it.

    Args:
        record: with the inputs and outputs of the process.
        process: the simulation.
        effects: causes to search; None: those of the process.
        without: names of causes of the process that are left out.
        uncertain: standard deviations of parameters that are known only roughly, by name.
        tolerance: differences that do not matter in practice, by output.
        limits: smallest and largest value of signals that a proposed experiment may reach.

    Raises:
        InputError: the record cannot be diagnosed, or an argument is outside its range.
    """
    described, model = find_process(process, record.zero_ns), _model_of(process, record)
    make_run(record, model)
    causes = described.select_causes(without) if effects is None else effects
    known = described.uncertain | dict(uncertain or {})
    found = find_causes(record, model, causes, dict(tolerance or {}) or None, known, dict(limits or {}) or None)
    values = {item.name: getattr(found, item.name) for item in fields(found)}
    return DiagnosisResult(**values, record=record, model=model, effects=causes)


class Suspect(msgspec.Struct, frozen=True):
    """A cause that an alarm may come from, with its probability."""

    cause: str
    probability: float


class RaisedAlarm(msgspec.Struct, frozen=True):
    """An alarm of a back-test.

    Attributes:
        alarm: name of the alarm, `chart/signal`.
        priority: `low`, `medium`, `high` or `critical`.
        raised_min: minute in which it was raised.
        cleared_min: minute in which it was cleared; None: it is active at the end.
        signals: signals that contributed to it.
        suspect: likely causes, the likeliest first.
    """

    alarm: str
    priority: str
    raised_min: float
    cleared_min: float | None
    signals: list[str]
    suspect: list[Suspect]


class BacktestResult(msgspec.Struct, frozen=True):
    """Result of a back-test; its fields are those of `reactorwatch backtest --json`.

    Attributes:
        samples: number of rows.
        zero: clock time that the minutes count from, ISO 8601; None: unknown.
        span_min: time from the first row to the last, summed over the runs.
        runs: number of runs of the plant.
        trained_until_min: end of the training; None: the record is shorter.
        expected_false_alarms: number of alarms expected by chance after the training.
        signals: inputs, outputs, and signals that are not watched with the reason.
        reference: model that the rows are judged by, `equations` or `arx`; None: no row was judged.
        noise_levels: standard deviations of the equations' noise; None: they did not judge.
        baseline: change of the equations after the diagnosis of the training; None: they stayed as given.
        alarms: the alarms in the order in which they were raised.
        text: report as `reactorwatch backtest` prints it.
    """

    samples: int
    zero: str | None
    span_min: float
    runs: int
    trained_until_min: float | None
    expected_false_alarms: float
    signals: dict[str, Any]
    reference: str | None
    noise_levels: dict[str, dict[str, float]] | None
    baseline: dict[str, Any] | None
    alarms: list[RaisedAlarm]
    text: str

    def __str__(self) -> str:
        return self.text


def backtest(record: Record, process: ProcessLike | None = None, **settings: Any) -> BacktestResult:
    """Run the monitor over a record.

    Args:
        record: with the signals that the settings name (by default those of the reactor).
        process: model whose equations judge; None: as the settings say.
        settings: settings of the monitor, see `docs/watching.md`, such as `training_min=50` or `charts=("ewma", "t2")`.

    Raises:
        InputError: settings that do not fit together, or a record without a usable value.
    """
    config = _settings(process, settings)
    zero_ns = replace(record, zero_ns=0).stored_zero_ns  # so that the minutes of a model are those of the record
    publications = samples_of(record, config.plant, zero_ns)
    model = None if process is None else _model_of(process, record)
    result = run_backtest((encode(item) for item in publications), config, zero_ns, model)
    if not result.rows:
        raise InputError(f"{record.name}: holds no sample that can be used")
    found = backtest_object(result, zero_ns, record.zero)
    text = backtest_text(result, zero_ns, Path(record.name))
    return msgspec.convert(found | {"text": text}, BacktestResult)


class AlarmChange(msgspec.Struct, frozen=True):
    """A change of an alarm.

    Attributes:
        time_min: time of the row that caused it, in minutes.
        alarm: name of the alarm, `chart/signal`.
        event: `raised`, `cleared`, `suspects` and others, see `docs/alarms.md`.
        priority: `low`, `medium`, `high` or `critical`.
        text: a sentence for people.
        suspect: likely causes, the likeliest first.
    """

    time_min: float
    alarm: str
    event: str
    priority: str
    text: str
    suspect: list[Suspect]


class Monitor:
    """A monitor that is fed row by row, without a bus.

    The first row after the training takes some tenths of a second, in which the training is diagnosed.

    Args:
        process: model whose equations judge; None: as the settings say.
        settings: settings of the monitor, as for `backtest`.

    >>> monitor = Monitor(outputs=("T",), reference="arx", training_min=10.0)
    >>> monitor.update(0.0, {"qc": 100.0, "T": 440.0})
    []
    >>> monitor.phase
    'training'
    """

    def __init__(self, process: ProcessLike | None = None, **settings: Any) -> None:
        self._config = _settings(process, settings)
        model = None if process is None else _model_of(process)
        self._core = MonitorCore(self._config, 0, points=False, model=model, diagnose=find_deviations)
        self._rows = 0

    @property
    def phase(self) -> str:
        """`training` or `watching`."""
        return self._core.phase

    def update(
        self, time_min: float, values: Mapping[str, float], units: Mapping[str, str] | None = None
    ) -> list[AlarmChange]:
        """Process one row.

        Args:
            time_min: time of the row, at least 0.
            values: values by signal; a missing signal was not measured.
            units: units of the signals, by name; None: not known.

        Returns:
            The changes of alarms that the row causes.
        """
        time_ns, changes = to_time_ns(time_min), []
        for signal, value in values.items():
            sample = Sample(
                time_ns=time_ns,
                sequence=self._rows,
                value=value,
                unit=(units or {}).get(signal, ""),
                quality=Quality.QUALITY_GOOD,
            )
            message = encode(Publication(keys.key(self._config.plant, keys.SAMPLE, signal), sample))
            published = (item.message for item in self._core.on_message(message, time_ns))
            changes += [_change(item) for item in published if isinstance(item, Alarm)]
        self._rows += 1
        return changes

    def to_bytes(self) -> bytes:
        """The state; a monitor of the same settings that it is restored into goes on with bit-identical output."""
        return msgspec.msgpack.encode((self._rows, self._core.to_bytes()))

    def from_bytes(self, state: bytes) -> None:
        """Restore the state of a monitor of the same settings.

        Raises:
            InputError: the bytes are no such state.
        """
        try:
            rows, core = msgspec.msgpack.decode(state, type=tuple[int, bytes])
        except msgspec.DecodeError as error:
            raise InputError(f"the state of a monitor cannot be read: {error}") from error
        self._core.from_bytes(core)
        self._rows = rows


def _change(alarm: Alarm) -> AlarmChange:
    suspects = [Suspect(item.cause, item.probability) for item in alarm.suspects]
    return AlarmChange(
        to_minutes(alarm.time_ns), alarm.alarm, alarm.event, priority_word(alarm.priority), alarm.text, suspects
    )


def _settings(process: ProcessLike | None, settings: Mapping[str, Any]) -> MonitorConfig:
    """The monitor's settings.

    Raises:
        InputError: an unknown name or a value outside its range.
    """
    defaults: dict[str, Any] = {"plant": DEFAULT_PLANT}
    if process is not None:
        defaults |= signal_settings(find_process(process))
    return section(MonitorConfig, "monitor", {"monitor": defaults}, dict(settings))


def _model_of(process: ProcessLike, record: Record | None = None) -> ProcessModel:
    """The equations of a process, their clock that of a record.

    Raises:
        InputError: there is no such process, the file cannot be read, or the process has no equations.
    """
    return find_process(process, 0 if record is None else record.zero_ns).require_model()
