"""Back-tests in a notebook."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from reactorwatch.api.views.record import signal_panels, time_title
from reactorwatch.notebook import html
from reactorwatch.notebook.figures import ALARM, Mark, draw_panels
from reactorwatch.notebook.frames import frame_of_rows
from reactorwatch.records.record import Record

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from reactorwatch.api.backtest import BacktestResult

COLUMNS = ("alarm", "priority", "raised_min", "cleared_min", "signals", "cause", "probability")
TRAINING = "#7f7f7f"


def backtest_frame(result: "BacktestResult") -> "DataFrame":
    """A row for each alarm, with its likeliest cause."""
    return frame_of_rows([_row(alarm) for alarm in result.alarms], COLUMNS)


def backtest_html(result: "BacktestResult") -> str:
    """Number of alarms with the likeliest cause, the expected number of false ones, and a table of the alarms."""
    rows = [_row(alarm) for alarm in result.alarms]
    cells = [
        (
            f"{row['raised_min']:g}",
            "" if row["cleared_min"] is None else f"{row['cleared_min']:g}",
            row["alarm"],
            row["priority"],
            cause,
        )
        for row, cause in zip(rows, _new_causes(result.alarms), strict=True)
    ]
    trained = result.trained_until_min
    parts = [
        html.headline(summarise_alarms(result)),
        html.sentence(
            "All of it went into the training."
            if trained is None
            else f"Trained until {trained:g} min; {result.expected_false_alarms:.2g} false alarms are expected later."
        ),
        html.table(("raised, min", "cleared, min", "alarm", "priority", "likely cause"), cells),
    ]
    parts += [html.sentence(f"{item['signal']} is not watched: {item['why']}") for item in result.signals["left_out"]]
    return "".join(parts)


def summarise_alarms(result: "BacktestResult") -> str:
    """Number of alarms, the first of them, and the likeliest cause of the last that has suspects."""
    if not result.alarms:
        return "No alarms." if result.trained_until_min is not None else "Nothing was watched."
    first = result.alarms[0]
    suspects = [alarm.suspect[0] for alarm in result.alarms if alarm.suspect]
    count = "1 alarm" if len(result.alarms) == 1 else f"{len(result.alarms)} alarms"
    named = f"; likely cause: {suspects[-1]}" if suspects else ""
    return f"{count}, the first at {first.raised_min:g} min ({first.alarm}){named}."


def plot_backtest(result: "BacktestResult", record: Record) -> "Figure":
    """Watched signals with the training and the spans in which an alarm was active."""
    inputs, outputs = tuple(result.signals["inputs"]), tuple(result.signals["outputs"])
    end_min = float(record.continuous_min[-1])
    marks = []
    if result.trained_until_min is not None and result.runs == 1:
        marks.append(Mark(float(record.time_min[0]), "training", TRAINING, end=result.trained_until_min))
    spans = merge_spans([(item.raised_min, item.cleared_min or end_min) for item in result.alarms])
    if result.runs == 1:
        marks += [Mark(start, "alarm" if not n else "", ALARM, end=end) for n, (start, end) in enumerate(spans)]
    panels = signal_panels(record, inputs, names=(*outputs, *inputs))
    return draw_panels(panels, marks, time_title(record))


def merge_spans(spans: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Union of spans, in order.

    >>> merge_spans([(5, 7), (1, 2), (6, 9)])
    [(1, 2), (5, 9)]
    """
    merged: list[tuple[float, float]] = []
    for start, end in sorted(spans):
        if merged and start <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(merged[-1][1], end))
        else:
            merged.append((start, end))
    return merged


def _new_causes(alarms: Sequence[Any]) -> list[str]:
    """The likeliest cause of each alarm; empty where it is that of the alarm before."""
    causes = [str(alarm.suspect[0]) if alarm.suspect else "" for alarm in alarms]
    return [cause if i == 0 or cause != causes[i - 1] else "" for i, cause in enumerate(causes)]


def _row(alarm: Any) -> dict[str, Any]:
    likeliest = alarm.suspect[0] if alarm.suspect else None
    values = (
        *(alarm.alarm, alarm.priority, alarm.raised_min, alarm.cleared_min, ", ".join(alarm.signals)),
        *((None, None) if likeliest is None else (likeliest.cause, likeliest.probability)),
    )
    return dict(zip(COLUMNS, values, strict=True))
