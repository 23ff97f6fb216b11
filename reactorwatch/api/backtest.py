"""Run the monitor over a record from Python."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from monitor_node.replay.backtest import RecordFacts, check_training_record, check_watched, run
from monitor_node.watched_process import WatchedProcess, limit_training, watch_process
from reactorwatch import html
from reactorwatch.api.monitor import monitor_settings
from reactorwatch.api.records import ProcessLike, signal_panels
from reactorwatch.api.shown import Shown, page_of
from reactorwatch.contract.codec import encode
from reactorwatch.description.read import find_process
from reactorwatch.figures import Mark, Panel
from reactorwatch.optional import frame_of_rows
from reactorwatch.records.record import Record
from reactorwatch.results.alarms import RaisedAlarm
from reactorwatch.results.backtest import Backtest
from reactorwatch.sentences.backtest import backtest_headline, backtest_text, exclusion_sentences, training_sentence
from recorder.tools.player import samples_of

if TYPE_CHECKING:
    from pandas import DataFrame

COLUMNS = ("alarm", "priority", "raised_min", "cleared_min", "signals", "cause", "probability")
"""Columns of the data frame."""


class BacktestResult(Shown[Backtest]):
    """A `Backtest` with its record: its attributes are the fields of `reactorwatch backtest --json`."""

    @property
    def headline(self) -> list[str]:
        """Outcome in a line for each incident, the largest first, after doubts about the training."""
        return backtest_headline(self.result)

    @property
    def text(self) -> str:
        """Report as `reactorwatch backtest` prints it."""
        return backtest_text(self.result)

    def __str__(self) -> str:
        return self.text

    def __repr__(self) -> str:
        return f"<{'; '.join(self.headline)}>"

    def _repr_html_(self) -> str:
        rows = []
        for alarm, cause in zip(self.alarms, _new_causes(self.alarms), strict=True):
            cleared = "" if alarm.cleared_min is None else f"{alarm.cleared_min:g}"
            rows.append((f"{alarm.raised_min:g}", cleared, alarm.alarm, alarm.priority, cause))
        parts = [
            *map(html.headline, self.headline),
            html.sentence(training_sentence(self.result)),
            html.table(("raised, min", "cleared, min", "alarm", "priority", "likely cause"), rows),
            *map(html.sentence, exclusion_sentences(self.result)),
        ]
        return "".join(parts)

    def to_frame(self) -> "DataFrame":
        """A row for each alarm, with its likeliest cause.

        Raises:
            InputError: pandas is not installed.
        """
        return frame_of_rows([_row(alarm) for alarm in self.alarms], COLUMNS)

    def _panels(self) -> list[Panel]:
        record: Record = self.record
        inputs, outputs = tuple(self.result.signals.inputs), tuple(self.result.signals.outputs)
        end_min = float(record.continuous_min[-1])
        marks = []
        if self.runs == 1:
            if self.trained_until_min is not None:
                marks.append(Mark(float(record.time_min[0]), "training", "measured", end=self.trained_until_min))
            spans = _merge_spans([(item.raised_min, item.cleared_min or end_min) for item in self.alarms])
            marks += [Mark(start, "alarm" if not n else "", "alarm", end=end) for n, (start, end) in enumerate(spans)]
        return signal_panels(record, inputs, names=(*outputs, *inputs), marks=tuple(marks))

    def _page(self) -> str:
        name = self.record.name
        return page_of(f"Back-test of {name}", self._repr_html_(), self._panels(), name)


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
    described = None if named is None else find_process(named, record.zero_ns)
    config = monitor_settings(settings, described)
    if described is None:
        watched = WatchedProcess(limit_training(config, record.rows), None)
    else:
        watched = watch_process(config, described, record.rows)
        still = check_training_record(record, *watched)
    zero_ns = replace(record, zero_ns=0).stored_zero_ns  # so that the minutes of a model are those of the record
    messages = (encode(item) for item in samples_of(record, config.plant, zero_ns))
    facts = RecordFacts(record.name, record.zero_ns - zero_ns if record.zero_ns else None, still)
    result = run(messages, watched.config, zero_ns, watched.model, facts=facts)
    check_watched(record.name, watched.config.outputs, result)
    return BacktestResult(result, record)


def _merge_spans(spans: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Union of spans, in order.

    >>> _merge_spans([(5, 7), (1, 2), (6, 9)])
    [(1, 2), (5, 9)]
    """
    merged: list[tuple[float, float]] = []
    for start, end in sorted(spans):
        if merged and start <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(merged[-1][1], end))
        else:
            merged.append((start, end))
    return merged


def _new_causes(alarms: Sequence[RaisedAlarm]) -> list[str]:
    """The likeliest cause of each alarm; empty where it is that of the alarm before."""
    causes = [str(alarm.suspect[0]) if alarm.suspect else "" for alarm in alarms]
    return [cause if i == 0 or cause != causes[i - 1] else "" for i, cause in enumerate(causes)]


def _row(alarm: RaisedAlarm) -> dict[str, Any]:
    likeliest = alarm.suspect[0] if alarm.suspect else None
    values = (
        *(alarm.alarm, alarm.priority, alarm.raised_min, alarm.cleared_min, ", ".join(alarm.signals)),
        *((None, None) if likeliest is None else (likeliest.cause, likeliest.probability)),
    )
    return dict(zip(COLUMNS, values, strict=True))
