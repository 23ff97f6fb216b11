"""The input, and the outputs as measured, as predicted, and the limits between which they were expected."""

from recorder.panels.base import INPUT, LIMIT, MEASURED, PREDICTED, Panel, Series, TimePlot
from recorder.run import Run

_TITLES = {"qc": "Coolant flow qc", "C": "Concentration C", "T": "Temperature T"}


def draw(run: Run) -> tuple[TimePlot, ...]:
    """A plot for each signal that was measured: those that the model predicts first."""
    names = sorted(run.measured, key=lambda name: (name not in run.estimated, name))
    return tuple(_plot(run, name) for name in names)


def _plot(run: Run, name: str) -> TimePlot:
    measured, estimated = run.measured[name], run.estimated.get(name)
    series = [
        Series("measured", measured.time_ns, measured.value, MEASURED, width=2.5)
        if name != "qc"
        else Series("measured", measured.time_ns, measured.value, INPUT, held=True)
    ]
    if estimated is not None:
        # the prediction is drawn over the measurement, and thinner: where both agree both are seen
        series = [
            Series("upper limit", estimated.time_ns, estimated.upper_limit, LIMIT, width=1.0, legend="limits"),
            Series("lower limit", estimated.time_ns, estimated.lower_limit, LIMIT, width=1.0, legend="limits"),
            *series,
            Series("predicted", estimated.time_ns, estimated.prediction, PREDICTED, width=1.0),
        ]
    return TimePlot(_TITLES.get(name, name), run.units.get(name, ""), tuple(series))


PANEL = Panel("Signals", draw)
