"""Residuals and control charts, with their limits."""

import numpy as np
from numpy.typing import NDArray

from recorder.columns.run import ChartColumns, EstimateColumns, RunColumns
from recorder.panels.base import ALARM, LIMIT, RESIDUAL, Panel, Series, TimePlot

MAX_EXCURSION = 25.0
"""Largest distance of a drawn statistic from the centre, in distances of the limit; beyond it the limits would be
invisible."""


def draw(run: RunColumns) -> tuple[TimePlot, ...]:
    """Plots of the residual of each predicted signal and of each chart, multivariate charts last."""
    residuals = [_residual(name, run.units.get(name, ""), item) for name, item in sorted(run.estimates.items())]
    names = sorted(run.charts, key=lambda name: (name.endswith("/all"), name))
    return (*residuals, *(_chart(name, run.charts[name]) for name in names))


def _residual(name: str, unit: str, estimated: EstimateColumns) -> TimePlot:
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


def _watched_range(estimated: EstimateColumns) -> tuple[float, float] | None:
    """Range of residuals and limits from the first limits on.

    Early in the training residuals are large; on their scale nothing later would be visible.
    """
    limits = (estimated.residual_lower_limit, estimated.residual_upper_limit)
    watched = np.isfinite(limits[0]) & np.isfinite(limits[1]) & np.isfinite(estimated.residual)
    if not watched.any():
        return None
    return _with_margin(np.concatenate([limits[0][watched], limits[1][watched], estimated.residual[watched]]))


def _chart(name: str, chart: ChartColumns) -> TimePlot:
    far = np.maximum(np.abs(chart.upper_limit - chart.centre), np.abs(chart.lower_limit - chart.centre)) * MAX_EXCURSION
    highest, lowest = chart.centre + far, chart.centre - far
    edge = np.where(chart.statistic > highest, highest, np.where(chart.statistic < lowest, lowest, np.nan))
    series = [
        Series("upper limit", chart.time_ns, chart.upper_limit, LIMIT, width=1.0, legend="limits"),
        Series("centre", chart.time_ns, chart.centre, LIMIT, width=0.6, legend="limits"),
        Series("lower limit", chart.time_ns, chart.lower_limit, LIMIT, width=1.0, legend="limits"),
        Series("statistic", chart.time_ns, chart.statistic, RESIDUAL),
    ]
    # Rerun draws lines in the order of their names: points out of limits are drawn last
    out = _select(chart.out == 1.0, chart.statistic)
    if np.isfinite(out).any():
        series.append(Series("statistic out", chart.time_ns, out, ALARM, legend="out of limits"))
    shown = None
    if np.isfinite(edge).any():
        series.append(
            Series("statistic out of the plot", chart.time_ns, edge, ALARM, width=4.0, legend="out of limits")
        )
        within = np.clip(chart.statistic, lowest, highest)
        shown = _with_margin(np.concatenate([within, chart.upper_limit, chart.lower_limit]))
    return TimePlot(f"Chart {name}", "", tuple(series), shown)


def _select(mask: NDArray[np.bool_], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values where `mask` is True, each with the value before it so that lines connect; NaN elsewhere."""
    following = np.append(mask[1:], False)
    return np.where(mask | following, values, np.nan)


def _with_margin(values: NDArray[np.float64]) -> tuple[float, float] | None:
    values = values[np.isfinite(values)]
    margin = 0.08 * float(np.ptp(values)) if values.size else 0.0
    return (float(values.min()) - margin, float(values.max()) + margin) if margin > 0.0 else None


PANEL = Panel("Residuals and charts", draw, arranged="grid")
