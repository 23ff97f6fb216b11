"""Health of the nodes: phase, lag, and messages lost, late or refused."""

from collections.abc import Callable, Iterator

import numpy as np

from recorder.columns.run import HealthReport, RunColumns
from recorder.panels.base import (
    ALARM,
    FAULT,
    INPUT,
    MEASURED,
    QUIET,
    SEVERAL,
    Panel,
    Series,
    StateLine,
    StateLines,
    TimePlot,
    View,
)

_PHASES = {
    "waiting": FAULT,
    "training": MEASURED,
    "watching": INPUT,
    "running": INPUT,
    "recording": INPUT,
    "not recording": ALARM,
    "stopped": QUIET,
}


def draw(run: RunColumns) -> tuple[View, ...]:
    """Lanes of the nodes' phases, and plots of their lags and of problem counts."""
    if not run.health:
        return ()
    lanes = tuple(
        StateLine(node, tuple(report.time_ns for report in reports), tuple(report.phase for report in reports))
        for node, reports in sorted(run.health.items())
    )
    return (
        StateLines("Node phases", lanes, _PHASES),
        TimePlot("Lag between receipt and the end of processing", "ms", tuple(_lines(run, lambda item: item.lag_ms))),
        TimePlot(
            "Lost, late, refused, duplicate or out of order",
            "messages since the start",
            tuple(_lines(run, lambda item: float(sum(item.counts.values())), held=True)),
        ),
    )


def _lines(run: RunColumns, of: Callable[[HealthReport], float], *, held: bool = False) -> Iterator[Series]:
    for index, (node, reports) in enumerate(sorted(run.health.items())):
        time_ns = np.array([report.time_ns for report in reports], np.int64)
        yield Series(node, time_ns, np.array([of(item) for item in reports]), SEVERAL[index % len(SEVERAL)], held=held)


PANEL = Panel("Health", draw)
