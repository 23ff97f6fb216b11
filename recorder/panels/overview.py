"""Measurements, predictions and limits of each signal, with alarms and the phase plane."""

from recorder.columns.process_annotations import is_input, signal_title
from recorder.columns.run import RunColumns
from recorder.panels.base import (
    INPUT,
    LIMIT,
    MEASURED,
    PREDICTED,
    RESIDUAL,
    Panel,
    Series,
    TimePlot,
    View,
    ViewReference,
)


def draw(run: RunColumns) -> tuple[View, ...]:
    """Plots of the measured signals, inputs last, with the alarm states, the log and the phase plane."""
    names = sorted(run.samples, key=lambda name: (is_input(name), name))
    plots = (_plot(run, name) for name in names)
    return (
        *plots,
        ViewReference("Alarms", "Alarm states"),
        ViewReference("Alarms", "Alarms and faults"),
        ViewReference("Phase plane", "Around the operating branch"),
    )


def _plot(run: RunColumns, name: str) -> TimePlot:
    measured, estimated, rebuilt = run.samples[name], run.estimates.get(name), run.reconstructions.get(name)
    series = [
        Series("measured", measured.time_ns, measured.value, INPUT, held=True)
        if is_input(name)
        else Series("measured", measured.time_ns, measured.value, MEASURED, width=2.5)
    ]
    if estimated is not None:
        # the prediction is drawn over the measurement and thinner, so that both are visible where they agree
        series = [
            Series("upper limit", estimated.time_ns, estimated.upper_limit, LIMIT, width=1.0, legend="limits"),
            Series("lower limit", estimated.time_ns, estimated.lower_limit, LIMIT, width=1.0, legend="limits"),
            *series,
            Series("predicted", estimated.time_ns, estimated.prediction, PREDICTED, width=1.0),
        ]
    if rebuilt is not None:
        series.append(Series("reconstructed", rebuilt.time_ns, rebuilt.value, RESIDUAL, width=1.5))
    unit = run.units.get(name, "")
    return TimePlot(signal_title(name, unit), unit, tuple(series))


PANEL = Panel("Overview", draw, arranged="beside")
