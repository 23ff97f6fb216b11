"""What the model could not predict, and every control chart: a statistic, and the limits that it should keep."""

import numpy as np
from numpy.typing import NDArray

from recorder.columns.run import Charted, Estimated, Run
from recorder.panels.base import ALARM, LIMIT, RESIDUAL, Panel, Series, TimePlot

ROOM = 25.0
"""So many times as far from its centre as its limit a statistic may go and set the scale; beyond that the limits, which
it is all about, could not be seen any more."""


def draw(run: Run) -> tuple[TimePlot, ...]:
    """A plot for the residual of each signal that is predicted, and one for each chart, those of all signals last."""
    residuals = [_residual(name, run.units.get(name, ""), item) for name, item in sorted(run.estimated.items())]
    names = sorted(run.charts, key=lambda name: (name.endswith("/all"), name))
    return (*residuals, *(_chart(name, run.charts[name]) for name in names))


def _residual(name: str, unit: str, estimated: Estimated) -> TimePlot:
    time_ns, lower, upper = estimated.time_ns, estimated.residual_lower_limit, estimated.residual_upper_limit
    return TimePlot(
        f"Residual of {name}",
        unit,
        (
            Series("upper limit", time_ns, upper, LIMIT, width=1.0, legend="limits"),
            Series("lower limit", time_ns, lower, LIMIT, width=1.0, legend="limits"),
            Series("measured - predicted", time_ns, estimated.residual, RESIDUAL),
        ),
        _watched_range(estimated),
    )


def _watched_range(estimated: Estimated) -> tuple[float, float] | None:
    """What residuals and limits span once there are limits.

    A model that has seen few rows predicts wildly; drawn to that scale nothing later could be seen.
    """
    limits = (estimated.residual_lower_limit, estimated.residual_upper_limit)
    watched = np.isfinite(limits[0]) & np.isfinite(limits[1]) & np.isfinite(estimated.residual)
    if not watched.any():
        return None
    return _with_room(np.concatenate([limits[0][watched], limits[1][watched], estimated.residual[watched]]))


def _chart(name: str, chart: Charted) -> TimePlot:
    far = np.maximum(np.abs(chart.upper_limit - chart.centre), np.abs(chart.lower_limit - chart.centre)) * ROOM
    highest, lowest = chart.centre + far, chart.centre - far
    edge = np.where(chart.statistic > highest, highest, np.where(chart.statistic < lowest, lowest, np.nan))
    series = [
        Series("upper limit", chart.time_ns, chart.upper_limit, LIMIT, width=1.0, legend="limits"),
        Series("centre", chart.time_ns, chart.centre, LIMIT, width=0.6, legend="limits"),
        Series("lower limit", chart.time_ns, chart.lower_limit, LIMIT, width=1.0, legend="limits"),
        Series("statistic", chart.time_ns, chart.statistic, RESIDUAL),
    ]
    # Rerun draws lines in the order of their names: what is out lies over the rest
    out = _where(chart.out == 1.0, chart.statistic)
    if np.isfinite(out).any():
        series.append(Series("statistic out", chart.time_ns, out, ALARM, legend="out of limits"))
    shown = None
    if np.isfinite(edge).any():
        series.append(
            Series("statistic out of the plot", chart.time_ns, edge, ALARM, width=4.0, legend="out of limits")
        )
        within = np.clip(chart.statistic, lowest, highest)
        shown = _with_room(np.concatenate([within, chart.upper_limit, chart.lower_limit]))
    return TimePlot(f"Chart {name}", "", tuple(series), shown)


def _where(there: NDArray[np.bool_], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The values where they are, each with the one before so that the line comes from where it was; else gaps."""
    before = np.append(there[1:], False)
    return np.where(there | before, values, np.nan)


def _with_room(values: NDArray[np.float64]) -> tuple[float, float] | None:
    values = values[np.isfinite(values)]
    room = 0.08 * float(np.ptp(values)) if values.size else 0.0
    return (float(values.min()) - room, float(values.max()) + room) if room > 0.0 else None


PANEL = Panel("Residuals and charts", draw, arranged="grid")
