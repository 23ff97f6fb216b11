"""Watch a record by the scheme of the original report, with the alarms of a back-test."""

from collections.abc import Sequence

import numpy as np

from monitor_node.alarms.states import Event
from monitor_node.replay.backtest import Backtest
from monitor_node.replay.row_log import LoggedRow, RowLog
from reactorwatch.contract.messages_pb2 import PRIORITY_HIGH, Alarm, Contribution
from reactorwatch.errors import InputError
from reactorwatch.identification.batch import SINGULAR_CONDITION
from reactorwatch.identification.report_scheme import WIDTH, ReportChart, chart_output
from reactorwatch.records.record import Record, to_time_ns
from reactorwatch.spc.charts.shewhart import probability_out

OUTSIDE = probability_out(WIDTH)
"""Share of independent normal residuals that are outside mean +- 3 sigma."""


def watch(
    record: Record,
    inputs: Sequence[str],
    outputs: Sequence[str],
    training_rows: int,
    zero_ns: int = 0,
    log: RowLog | None = None,
) -> Backtest:
    """Watch outputs of a record: an alarm `report/NAME` lasts from a row whose residual is out to the next in limits.

    Args:
        record: the rows, of one run.
        inputs: names of the inputs.
        outputs: names of the outputs, each by a model of its own.
        training_rows: number of rows at the start that models and limits are learned from.
        zero_ns: time from which the minutes count.
        log: log to which the rows are added; None: they are not logged.

    Raises:
        InputError: the record is no longer than the training, has no input, or its rows determine no model.
    """
    if not inputs:
        raise InputError("the report's scheme needs an input, and this process has none: leave --scheme out")
    if record.rows <= training_rows:
        raise InputError(
            f"the report's scheme learns from {training_rows} rows and watches the others, got {record.rows}; state "
            "fewer with --training-rows"
        )
    u = np.column_stack([record.columns[name] for name in inputs])
    charts = {name: chart_output(u, record.columns[name], record.time_min, training_rows) for name in outputs}
    times = [to_time_ns(minutes, zero_ns) for minutes in record.time_min.tolist()]
    watched = np.arange(record.rows) >= training_rows
    messages = [
        message for name, chart in charts.items() for message in _alarms(name, chart, chart.out & watched, times)
    ]
    if log is not None:
        out = np.array([chart.out & watched for chart in charts.values()])
        raised = np.any(np.diff(out, axis=1, prepend=False) & out, axis=0)
        log.rows.extend(map(LoggedRow, times, np.any(out, axis=0).tolist(), raised.tolist()))
    return Backtest(
        inputs=tuple(inputs),
        outputs=tuple(outputs),
        rows=record.rows,
        first_ns=times[0],
        last_ns=times[-1],
        span_ns=times[-1] - times[0],
        runs=1,
        watching_since_ns=times[training_rows],
        # if residuals are independent and normal: rows that are out after one that is in
        expected_false_alarms=len(charts) * int(watched.sum()) * OUTSIDE * (1.0 - OUTSIDE),
        alarm_messages=sorted(messages, key=lambda message: message.time_ns),
        refused={},
        notes=[_describe(name, chart) for name, chart in charts.items()],
        left_out={},
        refused_trainings=0,
        reference="arx",
        training_rows=training_rows,
    )


def _alarms(
    name: str, chart: ReportChart, out: np.ndarray[tuple[int], np.dtype[np.bool_]], times: list[int]
) -> list[Alarm]:
    edges = np.flatnonzero(np.diff(out, prepend=False, append=False)).reshape(-1, 2)
    messages = []
    for number, (rise, fall) in enumerate(edges.tolist()):
        residual = float(chart.residuals[rise])
        limit = chart.limits[1] if residual > chart.mean else chart.limits[0]
        alarm = Alarm(
            time_ns=times[rise],
            alarm=f"report/{name}",
            priority=PRIORITY_HIGH,
            raised_ns=times[rise],
            value=residual,
            limit=limit,
            contributions=[Contribution(signal=name, share=1.0)],
            text=f"{name} differs from the report's model by {residual:.3g}, beyond {limit:.3g}",
            event=Event.RAISED.value,
            incident=number + 1,
        )
        messages.append(alarm)
        if fall < len(times):
            cleared = Alarm()
            cleared.CopyFrom(alarm)
            cleared.time_ns = cleared.cleared_ns = times[fall]
            cleared.event = Event.CLEARED.value
            messages.append(cleared)
    return messages


def _describe(name: str, chart: ReportChart) -> str:
    note = f"{name}: the report's limits are {chart.limits[0]:.3g} to {chart.limits[1]:.3g}"
    if chart.model.condition > SINGULAR_CONDITION:
        note += "; its rows do not determine the parameters, and those of least norm are taken"
    return note
