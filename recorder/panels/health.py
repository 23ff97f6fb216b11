"""How the nodes do: their phase, how far behind they are, and what they lost, had too late or refused."""

from collections.abc import Callable, Iterator

import numpy as np

from recorder.columns.run import Report, Run
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


def draw(run: Run) -> tuple[View, ...]:
    """A lane for each node, the lag of all in one plot, and in another how many messages they had trouble with."""
    if not run.health:
        return ()
    lanes = tuple(
        StateLine(node, tuple(report.time_ns for report in reports), tuple(report.phase for report in reports))
        for node, reports in sorted(run.health.items())
    )
    return (
        StateLines("Node phases", lanes, _PHASES),
        TimePlot("Lag between receipt and the end of the work", "ms", tuple(_lines(run, lambda item: item.lag_ms))),
        TimePlot(
            "Lost, late, refused, twice there or out of order",
            "messages since the start",
            tuple(_lines(run, lambda item: float(sum(item.counts.values())), held=True)),
        ),
    )


def _lines(run: Run, of: Callable[[Report], float], *, held: bool = False) -> Iterator[Series]:
    for place, (node, reports) in enumerate(sorted(run.health.items())):
        time_ns = np.array([report.time_ns for report in reports], np.int64)
        yield Series(node, time_ns, np.array([of(item) for item in reports]), SEVERAL[place % len(SEVERAL)], held=held)


PANEL = Panel("Health", draw)
