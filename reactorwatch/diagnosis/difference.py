"""Difference between a simulation and a record, over time and operating points, and the share of noise in it.

The error of the simulation is grouped by time and by every input and output: `BINS` intervals of equal length in time,
and as many ranges of each signal that are equally frequent. Operating points are simulated ones, because the noise of
measured ones would sort errors by their own size.
"""

from collections.abc import Mapping
from typing import ClassVar

import msgspec
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.results.base import Result

BINS, LEAST_ROWS = 8, 20
"""Number of ranges along each axis, and minimum number of rows in one."""

TIME = "time"


class Range(Result, frozen=True):
    """Part of an axis.

    Attributes:
        lower: lower end, in the axis's unit; `from` in JSON.
        upper: upper end; `to` in JSON.
        mean: mean error, measured minus simulated.
        rmse: root mean square error.
        rows: number of rows in the range.
    """

    lower: float = msgspec.field(name="from")
    upper: float = msgspec.field(name="to")
    mean: float
    rmse: float
    rows: int


class Difference(Result, frozen=True):
    """Difference in one output.

    Attributes:
        rmse: root mean square error of the nominal simulation over the record; NaN if it diverged.
        noise_sd: standard deviation of the sensor's noise.
        noise_share: share of noise in the mean square error.
        one_step: root mean square of the nominal filter's innovations, in predicted standard deviations.
        unit: unit of the errors.
        along: ranges by axis: time in min, then inputs and outputs in their units; empty if the simulation diverged.
        units: units of the axes.
        tolerance: error beyond the noise that does not matter in practice.
    """

    rmse: float
    noise_sd: float
    noise_share: float
    one_step: float
    unit: str
    along: dict[str, tuple[Range, ...]]
    units: dict[str, str]
    tolerance: float

    python_only: ClassVar = ("units", "tolerance")

    @property
    def matters(self) -> bool:
        """True if the error beyond the noise exceeds the tolerance, or is unknown."""
        return not self.rmse**2 - self.noise_sd**2 <= self.tolerance**2

    def worst(self, axis: str) -> Range | None:
        """Range of an axis with the largest error; None if it has none."""
        return max(self.along[axis], key=lambda item: item.rmse, default=None)


def compute_difference(
    error: Array,
    innovations: Array,
    noise_sd: float,
    unit: str,
    time_min: Array,
    signals: Mapping[str, tuple[Array, str]],
    tolerance: float,
) -> Difference:
    """Difference in one output.

    Args:
        error: measured minus simulated, shape (rows,); NaN where either is missing.
        innovations: innovations in standard deviations, shape (rows,).
        noise_sd: standard deviation of the sensor's noise.
        unit: unit of the output.
        time_min: shape (rows,).
        signals: inputs and simulated outputs by name: values of shape (rows,), and their unit.
        tolerance: error beyond the noise that does not matter in practice.
    """
    edges = np.linspace(time_min[0], time_min[-1], BINS + 1)
    along, units = {TIME: _ranges(error, time_min, edges)}, {TIME: "min"}
    for name, (values, units[name]) in signals.items():
        finite = values[np.isfinite(values)]
        shares = np.linspace(0.0, 1.0, BINS + 1)
        along[name] = _ranges(error, values, np.unique(np.quantile(finite, shares))) if finite.size else ()
    rmse = _rms(error)
    noise_share = min((noise_sd / rmse) ** 2, 1.0) if rmse > 0.0 else 1.0
    return Difference(rmse, noise_sd, noise_share, _rms(innovations), unit, along, units, tolerance)


def _ranges(error: Array, values: Array, edges: Array) -> tuple[Range, ...]:
    result = []
    index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, max(edges.size - 2, 0))
    for number, (lower, upper) in enumerate(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)):
        inside = error[(index == number) & np.isfinite(error) & np.isfinite(values)]
        if inside.size >= LEAST_ROWS:
            result.append(Range(lower, upper, float(inside.mean()), _rms(inside), inside.size))
    return tuple(result)


def _rms(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")
