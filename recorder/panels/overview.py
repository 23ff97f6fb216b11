"""Each signal as measured, as predicted, and its limits; beside it what was raised, and where the process went."""

from recorder.columns.process_annotations import is_input, titled
from recorder.columns.run import Run
from recorder.panels.base import (
    INPUT,
    LIMIT,
    MEASURED,
    PREDICTED,
    RESIDUAL,
    Again,
    Panel,
    Series,
    TimePlot,
    View,
)


def draw(run: Run) -> tuple[View, ...]:
    """A plot for each signal that was measured, the inputs last; below them the alarms, beside them the log."""
    names = sorted(run.measured, key=lambda name: (is_input(name), name))
    plots = (_plot(run, name) for name in names)
    return (
        *plots,
        Again("Alarms", "Alarm states"),
        Again("Alarms", "Alarms and faults"),
        Again("Phase plane", "Around the operating branch"),
    )


def _plot(run: Run, name: str) -> TimePlot:
    measured, estimated, rebuilt = run.measured[name], run.estimated.get(name), run.reconstructed.get(name)
    series = [
        Series("measured", measured.time_ns, measured.value, INPUT, held=True)
        if is_input(name)
        else Series("measured", measured.time_ns, measured.value, MEASURED, width=2.5)
    ]
    if estimated is not None:
        # the prediction is drawn over the measurement, and thinner: where both agree both are seen
        series = [
            Series("upper limit", estimated.time_ns, estimated.upper_limit, LIMIT, width=1.0, legend="limits"),
            Series("lower limit", estimated.time_ns, estimated.lower_limit, LIMIT, width=1.0, legend="limits"),
            *series,
            Series("predicted", estimated.time_ns, estimated.prediction, PREDICTED, width=1.0),
        ]
    if rebuilt is not None:
        series.append(Series("reconstructed", rebuilt.time_ns, rebuilt.value, RESIDUAL, width=1.5))
    unit = run.units.get(name, "")
    return TimePlot(titled(name, unit), unit, tuple(series))


PANEL = Panel("Overview", draw, arranged="beside")
