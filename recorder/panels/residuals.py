"""What the model could not predict, and the limits it stays between while the plant is as it was."""

import numpy as np

from recorder.panels.base import LIMIT, RESIDUAL, Panel, Series, TimePlot
from recorder.run import Estimated, Run


def draw(run: Run) -> tuple[TimePlot, ...]:
    """A plot for each signal that the model predicts."""
    return tuple(_plot(name, run.units.get(name, ""), estimated) for name, estimated in sorted(run.estimated.items()))


def _plot(name: str, unit: str, estimated: Estimated) -> TimePlot:
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
    values = np.concatenate([limits[0][watched], limits[1][watched], estimated.residual[watched]])
    room = 0.08 * float(np.ptp(values))
    return (float(values.min()) - room, float(values.max()) + room) if room > 0.0 else None


PANEL = Panel("Residuals", draw)
