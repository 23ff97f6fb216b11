"""Run the monitor over a record from Python."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from monitor_node.replay.backtest import run as run_backtest
from monitor_node.replay.record_checks import check_training_record
from monitor_node.watched_process import WatchedProcess, limit_training, watch_process
from reactorwatch.api.backtest_report import backtest_object, backtest_text
from reactorwatch.api.monitor import Suspect, monitor_settings
from reactorwatch.api.records import ProcessLike
from reactorwatch.api.views import backtest as view
from reactorwatch.api.views.page import write_page
from reactorwatch.contract.codec import encode
from reactorwatch.description.find import find_process
from reactorwatch.errors import InputError
from reactorwatch.records.record import Record
from recorder.tools.player import samples_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame


class RaisedAlarm(msgspec.Struct, frozen=True):
    """An alarm of a back-test.

    Attributes:
        alarm: name of the alarm, `chart/signal`.
        priority: `low`, `medium`, `high` or `critical`.
        raised_min: minute in which it was raised.
        cleared_min: minute in which it was cleared; None: it is active at the end.
        signals: signals that contributed to it.
        contributions: share of each of them.
        suspect: likely causes, the likeliest first.
    """

    alarm: str
    priority: str
    raised_min: float
    cleared_min: float | None
    signals: list[str]
    contributions: list[dict[str, Any]]
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
        promise: promise of false alarms, and how training and rows bear it out; None: no row was judged.
        power: for each deviation the sizes that are seen within 10 min, an hour and a day.
        signals: inputs, outputs, and signals that are not watched with the reason.
        reference: model that the rows are judged by, `equations` or `arx`; None: no row was judged.
        noise_levels: standard deviations of the equations' noise; None: they did not judge.
        baseline: change of the equations after the diagnosis of the training; None: they stayed as given.
        alarms: the alarms in the order in which they were raised.
        text: report as `reactorwatch backtest` prints it.
        record: the record.
    """

    samples: int
    zero: str | None
    span_min: float
    runs: int
    trained_until_min: float | None
    expected_false_alarms: float
    promise: dict[str, Any] | None
    power: list[dict[str, Any]]
    signals: dict[str, Any]
    reference: str | None
    noise_levels: dict[str, dict[str, float]] | None
    baseline: dict[str, Any] | None
    alarms: list[RaisedAlarm]
    text: str
    record: Any = None

    def __str__(self) -> str:
        return self.text

    def __repr__(self) -> str:
        return f"<{view.summarise_alarms(self)}>"

    def _repr_html_(self) -> str:
        return view.backtest_html(self)

    def to_frame(self) -> "DataFrame":
        """A row for each alarm, with its likeliest cause.

        Raises:
            InputError: pandas is not installed.
        """
        return view.backtest_frame(self)

    def plot(self) -> "Figure":
        """Plot the watched signals with the training and the spans in which an alarm was active.

        Raises:
            InputError: matplotlib is not installed.
        """
        return view.plot_backtest(self, self.record)

    def to_html(self, file: str | Path) -> None:
        """Write the alarms and the plots as one page.

        Raises:
            InputError: the file cannot be written.
        """
        name = self.record.name
        write_page(file, f"Back-test of {name}", view.backtest_html(self), self.plot, name)


def backtest(record: Record, process: ProcessLike | None = None, **settings: Any) -> BacktestResult:
    """Run the monitor over a record.

    Args:
        record: with the signals of the process.
        process: name, path of a file that describes it, description or model; None: the process of the record, or as
            the settings say.
        settings: settings of the monitor, see `docs/watching.md`, such as `training_min=50` or `charts=("ewma", "t2")`.

    Raises:
        InputError: settings that do not fit together, or a record without a usable value.
    """
    still: dict[str, str] = {}
    named = getattr(record, "process", None) if process is None else process
    config = monitor_settings(settings)
    if named is None:
        watched = WatchedProcess(limit_training(config, record.rows), None)
    else:
        watched = watch_process(config, find_process(named, record.zero_ns), record.rows)
        still = check_training_record(record, *watched)
    zero_ns = replace(record, zero_ns=0).stored_zero_ns  # so that the minutes of a model are those of the record
    publications = samples_of(record, config.plant, zero_ns)
    result = run_backtest((encode(item) for item in publications), watched.config, zero_ns, watched.model)
    result.left_out = still | result.left_out
    if not result.rows:
        raise InputError(f"{record.name}: holds no sample that can be used")
    found = backtest_object(result, zero_ns, record.zero)
    text = backtest_text(result, zero_ns, Path(record.name), record.zero_ns or None)
    return msgspec.convert(found | {"text": text, "record": record}, BacktestResult)
