"""Where, when and at which operating points a simulation differs from a record, and how much of that is noise.

The error of a free run is set beside time and beside every input and output: `BINS` stretches of time of one length,
and as many ranges of each signal that occurred equally often. Operating points are those of the simulation, for in a
measured one there is noise, which would sort errors by their own size.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from reactorwatch.arrays import Array

BINS, LEAST_ROWS = 8, 20
"""Ranges along each axis, and how many rows one holds at least."""

TIME = "time"


@dataclass(frozen=True)
class Range:
    """Part of an axis.

    Attributes:
        lower: where it begins, in the axis's unit.
        upper: where it ends.
        mean: error of the simulation, measured minus simulated.
        rmse: root mean square of that.
        rows: that lie in it.
    """

    lower: float
    upper: float
    mean: float
    rmse: float
    rows: int


@dataclass(frozen=True)
class Difference:
    """Of one output.

    Attributes:
        rmse: of the nominal free run over the record; NaN if it ran away.
        noise_sd: of the sensor.
        one_step: root mean square of the nominal filter's innovations, in the standard deviations that it expects.
        along: ranges, by axis: time in min, then inputs and outputs in their units; without ranges if it ran away.
        units: of the axes.
        unit: of the errors.
    """

    rmse: float
    noise_sd: float
    one_step: float
    along: dict[str, tuple[Range, ...]]
    units: dict[str, str]
    unit: str

    @property
    def noise_share(self) -> float:
        """Of the mean square error."""
        return min((self.noise_sd / self.rmse) ** 2, 1.0) if self.rmse > 0.0 else 1.0

    def worst(self, axis: str) -> Range | None:
        """The range of an axis in which the simulation errs most; None if it has none."""
        return max(self.along[axis], key=lambda item: item.rmse, default=None)


def difference(
    error: Array,
    innovations: Array,
    noise_sd: float,
    unit: str,
    time_min: Array,
    signals: Mapping[str, tuple[Array, str]],
) -> Difference:
    """Of one output.

    Args:
        error: measured minus simulated, shape (rows,); NaN where there is neither.
        innovations: in standard deviations, likewise.
        noise_sd: of the sensor.
        unit: of the output.
        time_min: shape (rows,).
        signals: inputs, and outputs as simulated, by name: values of shape (rows,), and their unit.
    """
    edges = np.linspace(time_min[0], time_min[-1], BINS + 1)
    along, units = {TIME: _ranges(error, time_min, edges)}, {TIME: "min"}
    for name, (values, units[name]) in signals.items():
        known = values[np.isfinite(values)]
        shares = np.linspace(0.0, 1.0, BINS + 1)
        along[name] = _ranges(error, values, np.unique(np.quantile(known, shares))) if known.size else ()
    return Difference(_rms(error), noise_sd, _rms(innovations), along, units, unit)


def _ranges(error: Array, values: Array, edges: Array) -> tuple[Range, ...]:
    found = []
    place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, max(edges.size - 2, 0))
    for number, (lower, upper) in enumerate(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)):
        inside = error[(place == number) & np.isfinite(error) & np.isfinite(values)]
        if inside.size >= LEAST_ROWS:
            found.append(Range(lower, upper, float(inside.mean()), _rms(inside), inside.size))
    return tuple(found)


def _rms(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")
