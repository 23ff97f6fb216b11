"""Figure 18: the model's residual when nothing is wrong, and the limits mean +- 3 sigma."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benchmarks.study_figures.canvas import BLACK, BLUE, GREEN, VERMILION, label, panels
from benchmarks.study_figures.figure import Finding, verdict
from benchmarks.study_figures.flow_chart import Conclusion, follow
from benchmarks.study_figures.study import TRAINING_ROWS, Study
from reactorwatch.arrays import Array
from reactorwatch.identification.structure import Structure
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.records.record import Record
from reactorwatch.spc.charts.shewhart import Shewhart, probability_out

UNITS = cstr().units

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

ORDER = 3
_PRESET, _OUTPUT = "fault-free", "T"


def monitor_record(record: Record, output: str) -> tuple[Conclusion, Array, Shewhart | None]:
    """Monitor a record; returns its flow chart, the residual of all rows, and the control chart if there is a model.

    Args:
        record: record whose first `TRAINING_ROWS` rows are trusted.
        output: name of the output.
    """
    u, y, t = record.columns["qc"], record.columns[output], record.time_min
    conclusion = follow(Structure.of_order(ORDER), u, y, t, TRAINING_ROWS)
    if conclusion.model is None:
        return conclusion, np.full(y.size, np.nan), None
    centre = 0.5 * (conclusion.lower_limit + conclusion.upper_limit)
    chart = Shewhart(centre, (conclusion.upper_limit - centre) / 3.0)
    return conclusion, conclusion.model.residuals(u, y, t)[:, 0], chart


def out_of(chart: Shewhart, residuals: Array) -> Array:
    """Flags of the residuals that are out, shape (rows,); missing ones are not."""
    return np.array([bool(np.isfinite(x)) and chart.update(float(x)).out for x in residuals])


def draw_residuals(axes: Axes, time_min: Array, residuals: Array, chart: Shewhart, out: Array) -> None:
    """A residual with its limits, the points that are out marked."""
    axes.plot(time_min, residuals, color=BLUE, linewidth=0.5)
    axes.plot(time_min[out], residuals[out], ".", color=VERMILION, markersize=3.5)
    for limit in (chart.lower_limit, chart.upper_limit):
        axes.axhline(limit, color=BLACK, linewidth=1, linestyle="--")


def draw(study: Study, drawing: Drawing) -> Finding:
    """The residual over time, and how it is distributed."""
    record = study.fault_record(_PRESET)
    conclusion, residuals, chart = monitor_record(record, _OUTPUT)
    if chart is None:
        return Finding(f"The chart ended before a model: {conclusion.branches[-1].why}.")
    out = out_of(chart, residuals)
    over_time, spread = panels(drawing, 1, 2, sharey=True, gridspec_kw={"width_ratios": (4, 1)})
    draw_residuals(over_time, record.time_min, residuals, chart, out)
    edge = record.time_min[TRAINING_ROWS]
    over_time.axvspan(0.0, edge, color=GREEN, alpha=0.1)
    over_time.text(0.5 * edge, chart.lower_limit * 1.3, "model and limits\nfrom these rows", ha="center", fontsize=8.5)
    over_time.set_ylim(1.5 * chart.lower_limit, 1.5 * chart.upper_limit)
    label(over_time, "time, min", f"residual of {_OUTPUT}, {UNITS[_OUTPUT]}", f"third-order ARX, {_PRESET} record")
    later = residuals[TRAINING_ROWS:]
    later = later[np.isfinite(later)]
    sigma = (chart.upper_limit - chart.mean) / 3.0
    spread.hist(later, bins=40, orientation="horizontal", density=True, color=BLUE, alpha=0.55)
    grid = np.linspace(chart.mean - 4 * sigma, chart.mean + 4 * sigma, 200)
    normal = np.exp(-0.5 * ((grid - chart.mean) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
    spread.plot(normal, grid, color=BLACK, linewidth=1.2)
    label(spread, "density, 1/K", "", "against normal")
    count, expected = int(out[TRAINING_ROWS:].sum()), probability_out(3.0) * later.size
    text = (
        f"Mean {chart.mean:.1e} K, sigma {sigma:.4f} K over {TRAINING_ROWS} rows; limits {chart.lower_limit:.3f} to "
        f"{chart.upper_limit:.3f} K. Of the {later.size} rows after them {count} are out; {expected:.1f} are to be "
        f"expected of independent, normal residuals (0.27 %). The chart concludes: {conclusion.verdict}."
    )
    return Finding(text, verdict(conclusion.verdict == "fault free"))
