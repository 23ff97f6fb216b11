"""Sensors whose noise remembers: what is off in one row is partly still off in the next.

Such a noise is white noise and a part that wanders about zero, v <- phi v + white, with phi = exp(-h / tau) over a row
of length h: from row to row an autoregression of first order, and between rows far apart nothing. To the filter each is
one more state, at rest at nothing, that is added to what its sensor shows (Bryson & Johansen 1965, Linear filtering for
time-varying systems using measurements containing colored noise, IEEE Trans. Automatic Control 10). How large it is and
how long it remembers is learned with the other noise, by likelihood.

A filter with more states is slower, so they are there only where the record calls for them. A quick look tells: what a
model lacks, and what moves the process at random, has nearly no power at high frequencies, and of white noise there is
as much at one as at the other. So what a free run leaves is compared there, `LOW` with `HIGH`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import exp, sqrt

import casadi as ca
import msgspec
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.kalman.ekf import NoiseLevels
from reactorwatch.process.model import ProcessModel, parameter, variable

LOW, HIGH = (0.375, 0.625), (0.75, 1.0)
"""Bands of frequency, in shares of the highest that a record shows."""

SUSPICIOUS = 1.25
"""Times as much power in the first as in the second. An autoregression of 0.2 has 1.3, one of 0.5 has 1.6."""

CUT = 4.0
"""Standard deviations beyond which it does not matter how far off a value is."""

SHORTEST_ROWS, LONGEST_ROWS, FIRST_ROWS = 0.3, 10.0, 1.5
"""How long a sensor's noise may remember, in rows, and where the search begins."""

SHORTEST_MIN = 0.03
"""A step of the integrator is 0.05 min at most and follows nothing that is much quicker."""

_FEWEST_ROWS = 200
_SCALES = 10.0  # of a sensor's noise: by that the state's moves in a minute are measured


class Wandering(msgspec.Struct, frozen=True):
    """The part of a sensor's noise that remembers.

    Attributes:
        output: that the sensor shows.
        sd: standard deviation, in the output's unit.
        time_min: after which a share of 1/e is left of it.
        rate_sd: that of the white noise that moves it, in the output's unit per square root of a minute.
        scale: standard deviation of the sensor's whole noise, were it white.
    """

    output: str
    sd: float
    time_min: float
    rate_sd: float
    scale: float


class Noise(NoiseLevels, frozen=True):
    """The noise of a plant and of its sensors.

    Attributes:
        wandering: what of the sensors' noise remembers; `measurement_sd` is of the rest.
    """

    wandering: tuple[Wandering, ...] = ()

    def sensor_sd(self, outputs: Sequence[str]) -> Array:
        """Standard deviation of each sensor's whole noise, shape (n_y,)."""
        of = {item.output: item.sd for item in self.wandering}
        return np.hypot(self.measurement_sd, [of.get(name, 0.0) for name in outputs])

    @property
    def times(self) -> dict[str, float]:
        """As changes of parameters."""
        return {f"{item.output}.noise_min": item.time_min for item in self.wandering}


def suspected(noise: NoiseLevels, outputs: Sequence[str], residual: Array, period_min: float) -> tuple[Wandering, ...]:
    """Which sensors' noise may remember; half of it, to begin with.

    Args:
        noise: of the sensors, were it white.
        outputs: their names.
        residual: what a free run leaves, shape (rows, n_y); NaN where nothing was measured.
        period_min: usual distance of rows.
    """
    found = []
    for name, sd, column in zip(outputs, noise.measurement_sd, residual.T, strict=True):
        if _power_ratio(column) > SUSPICIOUS:
            found.append(Wandering(name, sd, _first_min(period_min), first_rate_sd(sd, period_min), sd))
    return tuple(found)


def first_rate_sd(sd: float, period_min: float) -> float:
    """Of a wandering of some standard deviation, with which a search for its numbers begins."""
    return _rate_sd(sd, _first_min(period_min), period_min)


def with_wandering(model: ProcessModel, wandering: Sequence[Wandering], period_min: float) -> ProcessModel:
    """The model with sensors whose noise remembers; as it is where there are none."""
    for item in wandering:
        place = model.output_names.index(item.output)
        output = model.outputs[place]
        scale = _SCALES * item.scale
        noise = variable(
            f"{item.output}.noise", output.unit, (-1e3 * scale, 1e3 * scale), scale, "noise that remembers"
        )
        shortest = max(SHORTEST_ROWS * period_min, SHORTEST_MIN)
        bounds = (shortest, max(LONGEST_ROWS * period_min, 2.0 * shortest))
        time = parameter(f"{item.output}.noise_min", _first_min(period_min), "min", bounds, "how long it remembers")
        model = model.with_state(noise, -noise.symbol / time.symbol, ca.SX(0.0))
        shown = replace(output, expression=output.expression + noise.symbol)
        outputs = (*model.outputs[:place], shown, *model.outputs[place + 1 :])
        model = replace(model, outputs=outputs, parameters=(*model.parameters, time))
    return model


def learned(
    wandering: Sequence[Wandering], rate_sd: Sequence[float], times: Mapping[str, float], period_min: float
) -> tuple[Wandering, ...]:
    """The same with other numbers.

    Args:
        wandering: of which sensors.
        rate_sd: of each, see `Wandering`.
        times: as `Noise.times`.
        period_min: usual distance of rows.
    """
    found = []
    for item, rate in zip(wandering, rate_sd, strict=True):
        time_min = times[f"{item.output}.noise_min"]
        sd = rate / _rate_sd(1.0, time_min, period_min)
        found.append(Wandering(item.output, sd, time_min, rate, item.scale))
    return tuple(found)


def _first_min(period_min: float) -> float:
    return max(FIRST_ROWS * period_min, SHORTEST_MIN)


def _rate_sd(sd: float, time_min: float, period_min: float) -> float:
    """Of the white noise that keeps it at a standard deviation, as the filter adds it: its variance times the row."""
    return sd * sqrt((1.0 - exp(-2.0 * period_min / time_min)) / period_min)


def power_spectrum(residual: Array) -> tuple[Array, Array] | None:
    """Frequencies, in shares of the highest, and the power there: of white noise on average its variance.

    None if the residual is too short. What is missing is left out, and outliers are clipped.
    """
    differences = np.diff(residual[np.isfinite(residual)])  # so that the highest frequencies do not drown in the lowest
    if differences.size < _FEWEST_ROWS:
        return None
    limit = CUT * float(np.median(np.abs(differences))) / 0.6745
    power = np.abs(np.fft.rfft(np.clip(differences, -limit, limit))) ** 2 / differences.size
    share = np.linspace(0.0, 1.0, power.size)
    power[1:] /= 2.0 - 2.0 * np.cos(np.pi * share[1:])
    return share, power


def _power_ratio(residual: Array) -> float:
    """Power of a residual at the lower frequencies over that at the higher ones; 1 if it is too short to tell."""
    spectrum = power_spectrum(residual)
    if spectrum is None:
        return 1.0
    share, power = spectrum
    low, high = (float(np.mean(power[(share >= begin) & (share < end)])) for begin, end in (LOW, HIGH))
    return low / high if high > 0.0 else 1.0
